"""`python -m wildgs`: the command line, as torchrun starts it."""

from wildgs.cli import main

if __name__ == "__main__":
    main()
