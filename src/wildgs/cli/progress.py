"""Progress of long work: a bar on a terminal, plain lines anywhere else."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from wildgs.engine.trainer import StepReport

LINE_SECONDS = 10.0
REFRESH_STEPS = 10

console = Console(highlight=False, soft_wrap=True)


class TrainingProgress:
    """An observer of training that shows steps per second, loss, Gaussians and time left."""

    def __init__(self, label: str, steps: int, done: int = 0) -> None:
        """Sets up a `TrainingProgress`.

        Args:
            label: Stands before the bar.
            steps: Of the whole run.
            done: Steps done before (a resumed run).
        """
        self.label, self.steps, self.done = label, steps, done
        self._started = time.monotonic()
        self._last_line = self._started
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._loss = float("nan")

    def __enter__(self) -> TrainingProgress:
        if console.is_terminal:
            self._bar = _bar(TextColumn("{task.fields[detail]}"))
            self._task = self._bar.add_task(
                self.label, total=self.steps, completed=self.done, detail="starting"
            )
            self._bar.start()
        else:
            console.print(f"{self.label}: {self.steps - self.done} steps")
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, report: StepReport) -> None:
        """Shows a step."""
        last = report.step == self.steps
        if report.step % REFRESH_STEPS and not last:
            return
        self._loss = float(report.losses.total.detach())
        rate = (report.step - self.done) / max(time.monotonic() - self._started, 1e-6)
        detail = f"{rate:.1f} steps/s  loss {self._loss:.4f}  {report.num_gaussians:,} Gaussians"
        if self._bar is not None:
            self._bar.update(self._task, completed=report.step, detail=detail)
        elif last or time.monotonic() - self._last_line >= LINE_SECONDS:
            self._last_line = time.monotonic()
            left = (self.steps - report.step) / max(rate, 1e-6)
            console.print(f"{self.label}: step {report.step}/{self.steps}  {detail}  {_clock(left)} left")


class Counter:
    """A callback `(done, total)` for work that counts pieces."""

    def __init__(self, label: str, bar: Progress | None) -> None:
        self.label = label
        self._bar = bar
        self._task = bar.add_task(label, total=None) if bar is not None else None

    def __call__(self, done: int, total: int) -> None:
        """Shows that `done` of `total` pieces are finished."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total)
        elif done == total:
            console.print(f"{self.label}: {total} done")


@contextmanager
def counting(label: str) -> Iterator[Counter]:
    """Shows progress over countable pieces while the block runs."""
    if not console.is_terminal:
        yield Counter(label, None)
        return
    with _bar(MofNCompleteColumn()) as bar:
        yield Counter(label, bar)


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A callback `(stage, done, total)` that shows a bar, or a line, for each stage of long work."""
    current: tuple[str, Counter] | None = None
    with ExitStack() as stack:

        def show(stage: str, done: int, total: int) -> None:
            nonlocal current
            if current is None or current[0] != stage:
                stack.close()
                current = stage, stack.enter_context(counting(stage))
            if total:
                current[1](done, total)

        yield show


def _bar(detail: TextColumn | MofNCompleteColumn) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        detail,
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=False,
    )


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
