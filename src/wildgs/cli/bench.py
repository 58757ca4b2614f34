"""`wildgs bench`: compares methods, ablations and seeds on scenes in one table."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from wildgs import processes
from wildgs.cli.options import UNNAMED
from wildgs.cli.screen import OUT, console, print_table, progress_shown
from wildgs.config import ExecutionConfig, RunConfig
from wildgs.engine.config import TrainConfig
from wildgs.errors import ReportedError, UserError
from wildgs.library.config import Suite
from wildgs.model.config import WildGSConfig
from wildgs.scene.config import DataConfig

if TYPE_CHECKING:
    from wildgs.evaluation.benchmark import Row

RANK_0_REPORTS = 10.0
"""Seconds that other ranks wait before they exit with an error that rank 0 reports."""
REPEATABLE = ("--variant",)
"""Options whose values add up if they are given several times."""
SHOWN = (
    "output",
    "suite",
    "methods",
    "variant",
    "seeds",
    "lpips",
    "data.downscale",
    "data.max_side",
    "train.steps",
)


@dataclass(frozen=True)
class Command:
    """Trains and scores methods on scenes with several seeds and both protocols, and writes one table.

    Finished runs are skipped, so the same command continues after an interruption, and scenes, methods, variants or
    seeds can be added later. The table (table.md, table.csv, table.json) is updated after every run. Several
    processes with the same --output, started by torchrun or by hand, share the runs among them.

    Example: wildgs bench scenes/gate --output bench --steps 3000 --downscale 2 --methods 3dgs wildgs
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders; with --suite phototourism, the folder that contains its scenes."""
    output: Path = Path("wildgs-bench")
    """Folder for the runs and the table."""
    suite: Suite | None = None
    """phototourism: brandenburg_gate, sacre_coeur and trevi_fountain at half resolution, with the paper's figures
    for comparison. Wild-GS and its ablations then use the preset paper; `default` is a separate row."""
    methods: tuple[str, ...] | None = None
    """Methods of `wildgs train`, wildgs-half-steps (the paper's †), presets, and ablations (without-PART). Default:
    those that docs/bench.md lists for the suite."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME:KEY=VALUE[,KEY=VALUE...]: an additional row with Wild-GS and some entries of config.yaml changed, for
    example slow:model.learning_rates.networks=5e-4."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Random seeds; each is a separate run."""
    lpips: Path | None = None
    """Folder with other LPIPS weights, for example AlexNet's, than the package's SqueezeNet."""
    data: Annotated[DataConfig, UNNAMED] = field(default_factory=DataConfig)
    model: Annotated[WildGSConfig, UNNAMED] = field(default_factory=WildGSConfig)
    train: Annotated[TrainConfig, UNNAMED] = field(default_factory=TrainConfig)
    execution: Annotated[ExecutionConfig, UNNAMED] = field(default_factory=ExecutionConfig)


def run(command: Command) -> None:
    """Does the runs that are not done yet; when one fails, the others continue.

    Raises:
        UserError: The options are invalid, or some runs failed.
    """
    if not processes.rank():
        return _run(command)
    try:
        _run(command)
    except UserError as error:
        time.sleep(RANK_0_REPORTS)  # torchrun stops all processes when the first one fails
        raise ReportedError(str(error)) from error


def _run(command: Command) -> None:
    import wildgs

    if command.train.seed != TrainConfig().seed:
        raise UserError("--seed: use --seeds in a benchmark")
    first = not processes.rank()
    console.quiet = not first
    prefix = f"rank {processes.rank()}: " if processes.world_size() > 1 else ""
    with progress_shown() as screen:

        def announce(line: str) -> None:
            screen.close()
            print(f"{prefix}{line}", file=OUT, flush=True)  # pyright: ignore[reportArgumentType]

        done = wildgs.benchmark(
            command.scenes,
            RunConfig(data=command.data, model=command.model, train=command.train),
            output=command.output,
            methods=command.methods,
            variants=command.variant,
            seeds=command.seeds,
            suite=command.suite,
            lpips=command.lpips,
            execution=command.execution,
            progress=screen,
            observers=[screen.step],
            announce=announce,
        )
    if first:
        _print_table(done.rows)
    console.print(f"table written to {command.output / 'table.md'}, table.csv and table.json")
    if done.failures:
        title, reason = next(iter(done.failures.items()))
        raise UserError(
            f"{len(done.failures)} of {done.runs} runs failed, first {title} ({reason}); repeat the command to "
            "retry them"
        )


def _print_table(rows: Sequence[Row]) -> None:
    from rich.table import Table

    from wildgs.evaluation.benchmark_table import sections

    for section in sections(rows):
        table = Table(*section.header, title=section.title, title_justify="left")
        for line in section.lines:
            table.add_row(*line)
        print_table(table)
