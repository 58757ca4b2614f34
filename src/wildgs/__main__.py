"""`python -m wildgs`: the command line, also for `torchrun -m wildgs`."""

from wildgs.cli import main

if __name__ == "__main__":
    main()
