"""`wildgs bench`: methods x ablations x seeds on any scenes, one table."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from wildgs import processes
from wildgs.cli.options import UNNAMED
from wildgs.cli.screen import OUT, console, progress_shown
from wildgs.config import ExecutionConfig, RunConfig
from wildgs.engine.config import TrainConfig
from wildgs.errors import ReportedError, UserError
from wildgs.library.config import Suite
from wildgs.model.config import WildGSConfig
from wildgs.scene.config import DataConfig

if TYPE_CHECKING:
    from wildgs.evaluation.benchmark import Row

RANK_0_REPORTS = 10.0
"""Seconds that other ranks wait before they end with a mistake that rank 0 reports."""
WIDTH_IN_FILES = 240
"""Characters that the printed table may take where no terminal has to show it."""
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
    """Trains and scores methods on scenes, for several seeds and under both protocols, and writes one table.

    The same command continues where it stopped and skips what is done; with more scenes, methods, variants or
    seeds it does what is new. The table (table.md, table.csv, table.json) is rewritten after every run.
    Several processes with one --output share the work, started by torchrun or by this command several times: each
    takes the next run that no other one trains.

    Example: wildgs bench scenes/gate --output bench --steps 3000 --downscale 2 --methods 3dgs wildgs
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders; with --suite phototourism, the folder that holds its scenes."""
    output: Path = Path("wildgs-bench")
    """Folder for the runs and the table."""
    suite: Suite | None = None
    """phototourism: brandenburg_gate, sacre_coeur and trevi_fountain at half resolution, beside the paper's
    figures. Wild-GS and its ablations are then trained with the preset paper; `default` is a line of its own."""
    methods: tuple[str, ...] | None = None
    """Methods of `wildgs train`, wildgs-half-steps (the paper's †), presets, and ablations (without-PART); by
    default all."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME:KEY=VALUE[,KEY=VALUE...], a further line of the table: Wild-GS with entries of config.yaml changed,
    as in slow:model.learning_rates.networks=5e-4. May be repeated."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    lpips: Path | None = None
    """Folder with other LPIPS weights (AlexNet's, say) than the package's SqueezeNet."""
    data: Annotated[DataConfig, UNNAMED] = field(default_factory=DataConfig)
    model: Annotated[WildGSConfig, UNNAMED] = field(default_factory=WildGSConfig)
    train: Annotated[TrainConfig, UNNAMED] = field(default_factory=TrainConfig)
    execution: Annotated[ExecutionConfig, UNNAMED] = field(default_factory=ExecutionConfig)


def run(command: Command) -> None:
    """Does what is not done yet; a run that fails is named, and the others continue.

    Raises:
        UserError: The command makes no sense, or some runs failed.
    """
    if not processes.rank():
        return _run(command)
    try:
        _run(command)
    except UserError as error:
        time.sleep(RANK_0_REPORTS)  # torchrun ends all processes with the first that fails
        raise ReportedError(str(error)) from error


def _run(command: Command) -> None:
    import wildgs

    if command.train.seed != TrainConfig().seed:
        raise UserError("--seed: a bench takes its seeds from --seeds")
    first = not processes.rank()
    console.quiet = not first
    speaker = f"rank {processes.rank()}: " if processes.world_size() > 1 else ""
    with progress_shown() as screen:

        def announce(line: str) -> None:
            screen.close()
            print(f"{speaker}{line}", file=OUT, flush=True)  # pyright: ignore[reportArgumentType]

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
    console.print(f"{command.output / 'table.md'}, table.csv and table.json hold the table")
    if done.failures:
        title, reason = next(iter(done.failures.items()))
        raise UserError(
            f"{len(done.failures)} of {done.runs} runs failed, the first of them {title} ({reason}); the same "
            "command tries them again"
        )


def _print_table(rows: Sequence[Row]) -> None:
    from rich.table import Table

    from wildgs.evaluation.benchmark_table import sections

    for section in sections(rows):
        table = Table(*section.header, title=section.title, title_justify="left")
        for line in section.lines:
            table.add_row(*line)
        console.print(table, width=None if console.is_terminal else WIDTH_IN_FILES)
