"""`wildgs bench`: methods x ablations x seeds on any scenes, one table."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import filelock
import torch
import tyro
from rich.table import Table

from wildgs import processes
from wildgs.cli.bench_plan import (
    LABELS,
    METHODS,
    PHOTOTOURISM_DOWNSCALE,
    BenchMethod,
    Job,
    find_phototourism,
    make_jobs,
    parse_variant,
)
from wildgs.cli.eval import evaluate_run
from wildgs.cli.progress import console
from wildgs.cli.training import read_scene, train_or_go_on
from wildgs.config import RunConfig
from wildgs.engine.checkpoint import list_checkpoints
from wildgs.engine.distributed import settle
from wildgs.engine.trainer import TrainConfig
from wildgs.errors import ReportedError, UserError
from wildgs.evaluation.benchmark import Row, Score, summarize
from wildgs.evaluation.benchmark_table import sections, to_csv, to_markdown, to_records
from wildgs.evaluation.lpips_weights import load_lpips
from wildgs.evaluation.pictures import write_json
from wildgs.evaluation.protocol import Protocol
from wildgs.evaluation.published import LABELS as PUBLISHED_LABELS
from wildgs.evaluation.published import published_figures
from wildgs.files import written_aside
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import CHECKPOINT_FOLDER, load_run
from wildgs.scene import DataConfig, Scene
from wildgs.version import __version__

PROTOCOLS: tuple[Protocol, ...] = ("full", "half")
MOST_NOTES = 12
CLAIM_FILE = ".bench.lock"
FAILURE_FILE = "bench_failure.txt"
"""In the folder of a run that failed: why. A later bench tries the run again."""
POLL_SECONDS = 2.0
RANK_0_REPORTS = 10.0
"""Seconds that other ranks wait before they end with a mistake that rank 0 reports."""
WIDTH_IN_FILES = 240
"""Characters that the printed table may take where no terminal has to show it."""


@dataclass(frozen=True)
class Command:
    """Trains and scores methods on scenes, for several seeds and under both protocols, and writes one table.

    The same command goes on where it stopped and skips what is done; with more scenes, methods, variants or
    seeds it does what is new. The table (table.md, table.csv, table.json) is written anew after every run.
    Several processes with one --output share the work: those that torchrun started, or this command started
    several times. Each takes the next run that no other one trains.

    Example: wildgs bench scenes/gate --output bench --steps 3000 --downscale 2 --methods 3dgs wildgs
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders; with --preset phototourism, the folder that holds its scenes."""
    output: Path = Path("wildgs-bench")
    """Folder for the runs and the table."""
    preset: Literal["phototourism"] | None = None
    """phototourism: brandenburg_gate, sacre_coeur and trevi_fountain at half resolution, beside the paper's
    figures."""
    methods: tuple[BenchMethod, ...] = METHODS
    """3dgs, wildgs, wildgs-half-steps (the paper's †), and the ablations."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME:KEY=VALUE[,KEY=VALUE...], a further line of the table: Wild-GS with entries of config.yaml changed,
    as in slow:train.optimizer.networks=5e-4. May be repeated."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    lpips: Path | None = None
    """Folder with LPIPS weights, where they are not in torch's cache."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    model: Annotated[WildGSConfig, tyro.conf.arg(name="")] = field(default_factory=WildGSConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)


def run(command: Command) -> None:
    """Does what is not done yet; a run that fails is named, and the others go on.

    Raises:
        UserError: The command makes no sense, or some runs failed.
    """
    if processes.world_size() > 1:
        settle()
    first = processes.rank() == 0
    console.quiet = not first
    jobs = _plan_alike(command)
    bench = _Bench(command, jobs)
    done = sum(map(bench.is_done, jobs))
    console.print(f"{len(jobs)} runs, {done} of them done already -> {command.output}")
    for number, job in bench.open_jobs():
        print(f"{_speaker()}run {number + 1} of {len(jobs)}: {job.title}", flush=True)
        bench.do(job)
        bench.write_table()
    rows = bench.write_table()
    if first:
        _print_table(rows)
    console.print(f"{command.output / 'table.md'}, table.csv and table.json hold the table")
    failures = bench.failures()
    if failures:
        _report_failures(failures, len(jobs))


def _plan_alike(command: Command) -> list[Job]:
    """The jobs; a mistake in the command is reported by rank 0 alone."""
    try:
        return _plan(command)
    except UserError as error:
        if processes.rank():
            time.sleep(RANK_0_REPORTS)  # torchrun ends all processes with the first that fails
            raise ReportedError(str(error)) from error
        raise


def _report_failures(failures: Mapping[str, str], count: int) -> None:
    if processes.rank():
        time.sleep(RANK_0_REPORTS)
        raise ReportedError("a run of the bench failed")
    title, reason = next(iter(failures.items()))
    raise UserError(
        f"{len(failures)} of {count} runs failed, the first of them {title} ({reason}); the same "
        "command tries them again"
    )


def _speaker() -> str:
    return f"rank {processes.rank()}: " if processes.world_size() > 1 else ""


def _plan(command: Command) -> list[Job]:
    if command.train.seed != TrainConfig().seed:
        raise UserError("--seed: a bench takes its seeds from --seeds")
    if not command.scenes or not command.seeds or not (command.methods or command.variant):
        raise UserError("a bench needs at least one scene, one of --methods or --variant, and one of --seeds")
    base = RunConfig(Path(), "wildgs", command.data, command.model, command.train)
    scenes: Sequence[Path] = command.scenes
    if command.preset == "phototourism":
        scenes = find_phototourism(scenes)
        if base.data.downscale == 1:
            base = replace(base, data=replace(base.data, downscale=PHOTOTOURISM_DOWNSCALE))
    variants = [parse_variant(text) for text in command.variant]
    return make_jobs(scenes, base, command.methods, variants, command.seeds, command.output)


class _Bench:
    """Runs jobs and gathers their scores; what is known of a job is what its folder holds."""

    def __init__(self, command: Command, jobs: Sequence[Job]) -> None:
        self.command = command
        self.jobs = jobs
        self._began = time.time()
        lpips, _ = load_lpips(command.lpips)
        self._network = None if lpips is None else lpips.network
        self._scene: tuple[RunConfig, Scene] | None = None

    def is_done(self, job: Job) -> bool:
        """Whether a job is trained and scored under both protocols, with the LPIPS network at hand."""
        return all(self._is_scored(job, protocol) for protocol in PROTOCOLS)

    def _is_scored(self, job: Job, protocol: Protocol) -> bool:
        metrics = read_metrics(job.folder, protocol)
        if metrics is None or metrics["step"] != job.config.train.steps:
            return False
        same_network = self._network is None or metrics.get("lpips_network") == self._network
        # A finished run whose checkpoints were deleted keeps its scores.
        return same_network or not list_checkpoints(job.folder / CHECKPOINT_FOLDER)

    def open_jobs(self) -> Iterator[tuple[int, Job]]:
        """Jobs that are neither done nor failed, with their numbers, until none is left; waits for other processes.

        A process that ends without finishing its job leaves it open, and one of the others takes it.
        """
        tried: set[int] = set()
        while True:
            waiting = False
            for number, job in enumerate(self.jobs):
                if number in tried or self._is_closed(job):
                    continue
                with _claim(job.folder) as claimed:
                    waiting |= not claimed
                    if claimed and not self._is_closed(job):
                        tried.add(number)
                        yield number, job
            if not waiting:
                return
            time.sleep(POLL_SECONDS)

    def _is_closed(self, job: Job) -> bool:
        return self.is_done(job) or self.failure(job) is not None

    def failure(self, job: Job) -> str | None:
        """Why a job failed since this bench began, in whatever process; None where it did not."""
        file = job.folder / FAILURE_FILE
        try:
            return file.read_text(encoding="utf-8") if file.stat().st_mtime >= self._began else None
        except OSError:
            return None

    def failures(self) -> dict[str, str]:
        """All jobs that failed, by title."""
        found = {job.title: self.failure(job) for job in self.jobs}
        return {title: reason for title, reason in found.items() if reason is not None}

    def do(self, job: Job) -> None:
        """Trains and scores what is left of a job; notes its failure where it lies with this run."""
        try:
            scene = self._read_scene(job.config)
            train_job(job, scene)
            self._score(job, scene)
            (job.folder / FAILURE_FILE).unlink(missing_ok=True)
        except (UserError, MemoryError, torch.OutOfMemoryError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            _write_text(job.folder / FAILURE_FILE, reason)
            print(f"{_speaker()}failed: {reason}", flush=True)

    def _read_scene(self, config: RunConfig) -> Scene:
        """The scene of a run, kept for the next run where that reads it alike."""
        if self._scene is None or (self._scene[0].scene, self._scene[0].data) != (config.scene, config.data):
            self._scene = None  # frees its photos before the next scene's are read
            self._scene = config, read_scene(config)
        scene = self._scene[1]
        if not scene.test_views:
            raise UserError(
                f"{scene.root} holds out no photo to score: mark some as 'test' in its split .tsv"
            )
        return scene

    def _score(self, job: Job, scene: Scene) -> None:
        loaded = load_run(job.folder)
        for protocol in PROTOCOLS:
            if not self._is_scored(job, protocol):
                evaluate_run(loaded, scene, protocol, lpips_folder=self.command.lpips)

    def write_table(self) -> list[Row]:
        """The table of all jobs that are done, on disk."""
        done = [job for job in self.jobs if self.is_done(job)]
        scores = [
            Score(job.scene, job.method, job.seed, metrics)
            for job in done
            for protocol in PROTOCOLS
            if (metrics := read_metrics(job.folder, protocol)) is not None
        ]
        labels = dict.fromkeys([job.method for job in self.jobs])
        names = {name: LABELS.get(name, name) for name in labels}
        preset = self.command.preset is not None
        rows = summarize(
            scores,
            (PUBLISHED_LABELS if preset else {}) | names,
            published=published_figures if preset else None,
        )
        output = self.command.output
        heading = f"{len(done)} of {len(self.jobs)} runs, wildgs {__version__}."
        _write_text(output / "table.md", to_markdown(rows, heading, [*self._variants(), *_notes(scores)]))
        _write_text(output / "table.csv", to_csv(rows))
        runs = [self._record(job) for job in done]
        write_json(output / "table.json", {"wildgs": __version__, "runs": runs, "rows": to_records(rows)})
        return rows

    def _variants(self) -> list[str]:
        return [
            f"{name}: `{entries}`." for name, _, entries in (v.partition(":") for v in self.command.variant)
        ]

    def _record(self, job: Job) -> dict[str, Any]:
        scores = {
            protocol: {name: value for name, value in metrics.items() if name != "images"}
            for protocol in PROTOCOLS
            if (metrics := read_metrics(job.folder, protocol)) is not None
        }
        folder = job.folder.relative_to(self.command.output).as_posix()
        return {
            "scene": job.scene,
            "method": job.method,
            "seed": job.seed,
            "folder": folder,
            "scores": scores,
        }


def train_job(job: Job, scene: Scene) -> None:
    """Trains a run from where it stands to its end."""
    train_or_go_on(job.folder, job.config, scene)


def read_metrics(folder: Path, protocol: Protocol) -> dict[str, Any] | None:
    """The scores of a run, None where there are none that can be read."""
    try:
        content = json.loads((folder / "eval" / protocol / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and "step" in content and "mean" in content else None


def _notes(scores: Sequence[Score]) -> list[str]:
    """What the scores' own notes say, each once; the legend has said already which network LPIPS has."""
    notes = dict.fromkeys(note for score in scores for note in score.metrics.get("notes", ()))
    lines = [note for note in notes if not note.startswith("LPIPS v0.1")]
    more = len(lines) - MOST_NOTES
    return lines[:MOST_NOTES] + ([f"{more} more notes in the runs' metrics.json."] if more > 0 else [])


@contextmanager
def _claim(folder: Path) -> Iterator[bool]:
    """Whether this process may work in a run folder while the block runs; the claim ends with the process."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder / CLAIM_FILE, timeout=0)
        lock.acquire()
    except filelock.Timeout:
        yield False
        return
    except NotImplementedError:  # a disk without locks; processes that share it may repeat each other's work
        yield True
        return
    except OSError as error:
        raise UserError(f"{folder} cannot be written to ({error}); choose another --output") from error
    try:
        yield True
    finally:
        lock.release()


def _write_text(file: Path, text: str) -> None:
    with written_aside(file) as aside:
        aside.write_text(text, encoding="utf-8")


def _print_table(rows: Sequence[Row]) -> None:
    for section in sections(rows):
        table = Table(*section.header, title=section.title, title_justify="left")
        for line in section.lines:
            table.add_row(*line)
        console.print(table, width=None if console.is_terminal else WIDTH_IN_FILES)
