"""`wildgs doctor`: checks what works on this machine."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wildgs.library.doctor import Check


@dataclass(frozen=True)
class Command:
    """Reports what works on this machine and how to install what does not. Downloads nothing.

    Example: wildgs doctor --report --run runs/gate
    """

    json: bool = False
    """Print JSON instead of a table."""
    report: bool = False
    """Print a text for bug reports, without the names of user, machine and home folder."""
    run: Path | None = None
    """Run folder whose configuration and last log lines are added to the report."""
    build_gsplat: bool = False
    """Build gsplat's CUDA extension now (2 to 15 minutes) instead of at the first training."""


def run(command: Command) -> None:
    """Prints the report.

    Raises:
        UserError: The extension cannot be built (with --build-gsplat).
    """
    from wildgs.library.doctor import build_gsplat, examine, write_report

    if command.build_gsplat:
        build_gsplat()
    checks = examine()
    if command.json:
        print(json.dumps([asdict(check) for check in checks], indent=2))
    elif command.report or command.run is not None:
        print(write_report([(check.name, check.state, check.detail) for check in checks], command.run))
    else:
        _print_table(checks)


def _print_table(checks: list[Check]) -> None:
    from rich.table import Table
    from rich.text import Text

    from wildgs.cli.screen import PipedConsole

    console = PipedConsole(markup=False, emoji=False, highlight=False)
    table = Table("", "", "", show_header=False, box=None, padding=(0, 2, 0, 0))
    colors = {"works": "green", "missing": "yellow", "broken": "red"}
    for check in checks:
        table.add_row(check.name, Text(check.state, colors[check.state]), check.detail)
    console.print(table)
    remedies = [check for check in checks if check.remedy is not None]
    if remedies:
        console.print("\nTo install what is missing:")
    for check in remedies:
        console.print(f"  # {check.name}", style="dim")
        console.print(f"  {check.remedy}", soft_wrap=True)  # on one line, so that it can be copied
