"""`wildgs.benchmark`: compares methods, ablations and seeds on scenes in one table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from wildgs import processes
from wildgs.config import ExecutionConfig, RunConfig, validated
from wildgs.engine.checkpoint import list_checkpoints
from wildgs.engine.distributed import assign_device
from wildgs.engine.report import Observer
from wildgs.errors import UserError
from wildgs.evaluation.benchmark import Row, Score, summarize
from wildgs.evaluation.benchmark_table import LABELS as PUBLISHED_LABELS
from wildgs.evaluation.benchmark_table import published_figures, to_csv, to_markdown, to_records
from wildgs.evaluation.lpips import load_lpips
from wildgs.evaluation.pictures import write_json
from wildgs.evaluation.protocol import Protocol
from wildgs.files import check_regular, read_json, written_aside
from wildgs.library.benchmark_plan import (
    PHOTOTOURISM_DOWNSCALE,
    Job,
    find_phototourism,
    label_of,
    make_jobs,
    parse_variant,
)
from wildgs.library.config import Suite, default_bench_methods, reference_preset
from wildgs.library.evaluation import PROTOCOLS, check_lpips, evaluate
from wildgs.library.logs import logger
from wildgs.library.training import read_scene, train
from wildgs.progress import Progress
from wildgs.runs import CHECKPOINT_FOLDER, holding, load_run
from wildgs.scene import Scene
from wildgs.version import __version__

MOST_NOTES = 12
CLAIM_FILE = ".bench.lock"
FAILURE_FILE = "bench_failure.txt"
"""Holds the reason, in the folder of a run that failed. The next benchmark tries the run again."""
POLL_SECONDS = 2.0


@dataclass(frozen=True)
class Benchmark:
    """A finished benchmark.

    Attributes:
        folder: The folder with table.md, table.csv, table.json and the runs.
        rows: Rows of the table.
        runs: Number of runs that the table consists of.
        failures: Reasons why runs failed, by the runs' titles.
    """

    folder: Path
    rows: list[Row]
    runs: int
    failures: Mapping[str, str]


@dataclass(frozen=True)
class _Request:
    """Arguments of `benchmark` that all runs share."""

    output: Path
    suite: Suite | None
    variants: Sequence[str]
    lpips: Path | None
    execution: ExecutionConfig
    progress: Progress | None
    observers: Sequence[Observer]
    announce: Callable[[str], None]


def benchmark(
    scenes: Sequence[str | Path],
    config: RunConfig | None = None,
    *,
    output: str | Path = "wildgs-bench",
    methods: Sequence[str] | None = None,
    variants: Sequence[str] = (),
    seeds: Sequence[int] = (0, 1, 2),
    suite: Suite | None = None,
    lpips: str | Path | None = None,
    execution: ExecutionConfig | None = None,
    progress: Progress | None = None,
    observers: Sequence[Observer] = (),
    announce: Callable[[str], None] | None = None,
) -> Benchmark:
    """Trains and scores methods on scenes with several seeds and both protocols, and writes one table.

    Finished runs are skipped, so the same call continues after an interruption. A run that fails does not stop the
    others.

    Args:
        scenes: Scene folders; for a suite, the folder that contains its scenes.
        config: Base configuration of all runs.
        output: Folder for the runs and the table.
        methods: Rows of the table; None takes all.
        variants: Additional rows, ``NAME:KEY=VALUE[,KEY=VALUE...]``: Wild-GS with entries of config.yaml changed.
        seeds: Random seeds; each is a separate run.
        suite: `phototourism` compares with the paper's figures on its three scenes; Wild-GS, its ablations and
            variants then use the preset `paper`, and so do the training options of other methods.
        lpips: Folder with other LPIPS weights, for example AlexNet's, than the package's SqueezeNet.
        execution: How runs are executed.
        progress: Called during all stages of all runs.
        observers: Called with a `StepReport` after every training step.
        announce: Called, on every process, with a line for each run that starts or fails.

    Raises:
        UserError: A scene, method or variant does not exist, or the output contains runs with other settings.
    """
    check_lpips(lpips)
    lpips, execution = None if lpips is None else Path(lpips), execution or ExecutionConfig()
    announce = announce or logger.info
    request = _Request(Path(output), suite, variants, lpips, execution, progress, observers, announce)
    if processes.world_size() > 1:
        assign_device()
    base = validated(config or RunConfig())
    methods = default_bench_methods(suite) if methods is None else methods
    jobs = _plan(request, [Path(s) for s in scenes], base, methods, seeds)
    bench = _Bench(request, jobs)
    done = sum(map(bench.is_done, jobs))
    if processes.rank() == 0:
        logger.info("%d runs, %d of them done already -> %s", len(jobs), done, request.output)
    for number, job in bench.open_jobs():
        request.announce(f"run {number + 1} of {len(jobs)}: {job.title}")
        bench.do(job)
        bench.write_table()
    return Benchmark(request.output, bench.write_table(), len(jobs), bench.failures())


def _plan(
    request: _Request, scenes: Sequence[Path], base: RunConfig, methods: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    if not scenes or not seeds or not (methods or request.variants):
        raise UserError(
            "a benchmark needs at least one scene, one of --methods or --variant, and one of --seeds"
        )
    if request.suite == "phototourism":
        scenes = find_phototourism(scenes)
        if base.data.downscale == 1 and base.data.max_side is None:
            base = replace(base, data=replace(base.data, downscale=PHOTOTOURISM_DOWNSCALE))
    parsed = [parse_variant(text) for text in request.variants]
    reference = reference_preset(request.suite)
    return make_jobs(scenes, base, methods, parsed, seeds, request.output, reference)


class _Bench:
    """Runs jobs and collects their scores. The state of a job is stored in its run folder only."""

    def __init__(self, request: _Request, jobs: Sequence[Job]) -> None:
        self.request = request
        self.jobs = jobs
        self._began = time.time()
        lpips, _ = load_lpips(request.lpips)
        self._network = None if lpips is None else lpips.network
        self._scene: tuple[RunConfig, Scene] | None = None

    def is_done(self, job: Job) -> bool:
        """Whether a job is trained, and scored under both protocols with the current LPIPS network."""
        return all(self._is_scored(job, protocol) for protocol in PROTOCOLS)

    def _is_scored(self, job: Job, protocol: Protocol) -> bool:
        metrics = read_metrics(job.folder, protocol)
        if metrics is None or metrics["step"] != job.config.train.steps:
            return False
        same_network = self._network is None or metrics.get("lpips_network") == self._network
        # A finished run whose checkpoints were deleted keeps its scores.
        return same_network or not list_checkpoints(job.folder / CHECKPOINT_FOLDER)

    def open_jobs(self) -> Iterator[tuple[int, Job]]:
        """Yields number and job of those neither done nor failed; waits for those of other processes.

        If the process that works on a job ends early, another process takes the job over.
        """
        tried: set[int] = set()
        while True:
            waiting = False
            for number, job in enumerate(self.jobs):
                if number in tried or self._is_closed(job):
                    continue
                with holding(
                    job.folder / CLAIM_FILE
                ) as held:  # without locks, processes may repeat each other's work
                    waiting |= held is False
                    if held is not False and not self._is_closed(job):
                        tried.add(number)
                        yield number, job
            if not waiting:
                return
            time.sleep(POLL_SECONDS)

    def _is_closed(self, job: Job) -> bool:
        return self.is_done(job) or self.failure(job) is not None

    def failure(self, job: Job) -> str | None:
        """The reason why a job failed in any process since this benchmark started; None if it did not."""
        file = job.folder / FAILURE_FILE
        try:
            check_regular(file)
            return file.read_text(encoding="utf-8") if file.stat().st_mtime >= self._began else None
        except OSError:
            return None

    def failures(self) -> dict[str, str]:
        """The reasons of all failed jobs, by title."""
        found = {job.title: self.failure(job) for job in self.jobs}
        return {title: reason for title, reason in found.items() if reason is not None}

    def do(self, job: Job) -> None:
        """Trains and scores a job as far as it is not done; writes the reason of a failure to the run folder."""
        try:
            scene = self._read_scene(job.config)
            train(
                scene,
                job.config,
                output=job.folder,
                execution=self.request.execution,
                resume="auto",
                progress=self.request.progress,
                observers=self.request.observers,
            )
            self._score(job, scene)
            (job.folder / FAILURE_FILE).unlink(missing_ok=True)
        except (UserError, MemoryError, torch.OutOfMemoryError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            _write_text(job.folder / FAILURE_FILE, reason)
            self.request.announce(f"failed: {reason}")

    def _read_scene(self, config: RunConfig) -> Scene:
        """The scene of a run, cached for the next run on the same scene."""
        if self._scene is None or (self._scene[0].scene, self._scene[0].data) != (config.scene, config.data):
            self._scene = None  # frees its photos before the next scene's are read
            self._scene = config, read_scene(config, self.request.execution, self.request.progress)
        scene = self._scene[1]
        if not scene.test_views:
            raise UserError(
                f"{scene.root} has no held-out photos to score: mark some as 'test' in its split .tsv"
            )
        return scene

    def _score(self, job: Job, scene: Scene) -> None:
        missing: list[Protocol] = [protocol for protocol in PROTOCOLS if not self._is_scored(job, protocol)]
        if missing:
            loaded = load_run(job.folder)
            evaluate(loaded, missing, scene=scene, lpips=self.request.lpips, progress=self.request.progress)

    def write_table(self) -> list[Row]:
        """Writes the table of all finished jobs."""
        done = [job for job in self.jobs if self.is_done(job)]
        scores = [
            Score(job.scene, job.method, job.seed, metrics)
            for job in done
            for protocol in PROTOCOLS
            if (metrics := read_metrics(job.folder, protocol)) is not None
        ]
        labels = dict.fromkeys([job.method for job in self.jobs])
        names = {name: label_of(name) for name in labels}
        published = self.request.suite is not None
        rows = summarize(
            scores,
            (PUBLISHED_LABELS if published else {}) | names,
            published=published_figures if published else None,
        )
        output = self.request.output
        heading = f"{len(done)} of {len(self.jobs)} runs, wildgs {__version__}."
        _write_text(output / "table.md", to_markdown(rows, heading, self._remarks(scores)))
        _write_text(output / "table.csv", to_csv(rows))
        runs = [self._record(job) for job in done]
        write_json(output / "table.json", {"wildgs": __version__, "runs": runs, "rows": to_records(rows)})
        return rows

    def _remarks(self, scores: Sequence[Score]) -> list[str]:
        reference = reference_preset(self.request.suite)
        lines = [] if reference == "default" else [f"Preset of all rows except other presets: {reference}."]
        for name, _, entries in (variant.partition(":") for variant in self.request.variants):
            lines.append(f"{name}: `{entries}`.")
        return [*lines, *_notes(scores)]

    def _record(self, job: Job) -> dict[str, Any]:
        scores = {
            protocol: {name: value for name, value in metrics.items() if name != "images"}
            for protocol in PROTOCOLS
            if (metrics := read_metrics(job.folder, protocol)) is not None
        }
        folder = job.folder.relative_to(self.request.output).as_posix()
        return {
            "scene": job.scene,
            "method": job.method,
            "seed": job.seed,
            "folder": folder,
            "scores": scores,
        }


def read_metrics(folder: Path, protocol: Protocol) -> dict[str, Any] | None:
    """The scores of a run; None if they do not exist or cannot be read."""
    try:
        content = read_json(folder / "eval" / protocol / "metrics.json")
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and "step" in content and "mean" in content else None


def _notes(scores: Sequence[Score]) -> list[str]:
    """The distinct notes of the scores, without the LPIPS network, which the legend names."""
    notes = dict.fromkeys(note for score in scores for note in score.metrics.get("notes", ()))
    lines = [note for note in notes if not note.startswith("LPIPS v0.1")]
    more = len(lines) - MOST_NOTES
    return lines[:MOST_NOTES] + ([f"{more} more notes in the runs' metrics.json."] if more > 0 else [])


def _write_text(file: Path, text: str) -> None:
    with written_aside(file) as aside:
        aside.write_text(text, encoding="utf-8")
