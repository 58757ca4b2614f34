"""`python -m demo_generator`: renders the scene that ships with the package, or checks the one that does."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.progress import Progress

from demo_generator.archive import pack, share_of_differences
from demo_generator.photos import SyntheticConfig, make_landmark

README = """The landmark of `wildgs demo`: a made-up place, rendered by demo_generator/ of the Wild-GS sources.
It shows no real place and no real person. It is licensed as Wild-GS is, under the Apache License 2.0.
"""


@dataclass(frozen=True)
class Command:
    """Renders the demo's scene and packs it into one archive. Takes about a minute on two cores.

    Examples:
        python -m demo_generator --output src/wildgs/scene/demo.zip
        python -m demo_generator --check src/wildgs/scene/demo.zip
    """

    output: Path | None = None
    """Archive to write."""
    check: Path | None = None
    """Archive to compare with the scene as it is rendered now; exit code 1 if they differ."""


def main(command: Command) -> int:
    """Makes the scene; returns the exit code."""
    if command.output is None and command.check is None:
        print("give --output, --check or both", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        _render(folder)
        if command.output is not None:
            pack(folder, command.output)
            print(f"{command.output}: {command.output.stat().st_size / 1e6:.2f} MB")
        return 0 if command.check is None else _compare(folder, command.check)


def _render(folder: Path) -> None:
    with Progress() as progress:
        task = progress.add_task("rendering photos")
        make_landmark(
            folder,
            SyntheticConfig(),
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    (folder / "README.txt").write_text(README, encoding="utf-8")


def _compare(folder: Path, archive: Path) -> int:
    differences = share_of_differences(folder, archive)
    different = {name: share for name, share in differences.items() if share > 0.0}
    for name, share in different.items():
        print(f"{name}: {share:.3%} of its values differ")
    print(f"{len(differences) - len(different)} of {len(differences)} files are the same in every value")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
