"""Console output: progress bars, log lines and tables. Output errors never stop the work."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.cells import cell_len
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segments
from rich.table import Table

from wildgs import processes
from wildgs.cli.streams import discard_output

if TYPE_CHECKING:
    from wildgs.engine.report import StepReport
    from wildgs.library.evaluation import Scores
    from wildgs.library.pipeline import FinishedRun
    from wildgs.light.look import Look

LINE_SECONDS, STAGE_SECONDS = 10.0, 60.0
"""Intervals of lines in files and pipes, in training and in other stages, which may take many minutes."""
REFRESH_STEPS = 10
NAME_WIDTH = 8
"""Least width of a table's column of names in characters."""
UNLIMITED = 10_000
"""More characters than any table is wide."""
_SCORES = (("PSNR", "psnr", 2), ("SSIM", "ssim", 3), ("LPIPS", "lpips", 3))
_PARTS = (
    ("PSNR landmark", "landmark", 2),
    ("elsewhere", "elsewhere", 2),
    ("detail", "detail_energy", 2),
    ("correlation", "detail_correlation", 3),
)
"""Columns of the printed tables: header, key of the means in `metrics.json`, digits."""


class SafeStream:
    """Wraps stdout or stderr and drops output that cannot be written.

    A full disk behind a redirection, a closed pipe and a closed terminal must not stop training.
    """

    def __init__(self, name: str) -> None:
        """Wraps a stream.

        Args:
            name: `stdout` or `stderr`, looked up at every write because tests and notebooks replace the streams.
        """
        self._name = name

    @property
    def _stream(self) -> Any:
        stream = getattr(sys, self._name)
        # While a progress bar is shown, rich replaces both streams by proxies that write to the console.
        return getattr(stream, "rich_proxied_file", stream) if self._name == "stdout" else stream

    def write(self, text: str) -> int:
        """Writes text if possible."""
        try:
            try:
                return self._stream.write(text)
            except UnicodeEncodeError:  # file names need not be valid UTF-8
                return self._stream.write(text.encode("ascii", "backslashreplace").decode("ascii"))
        except BrokenPipeError:
            discard_output(self._stream)
            return len(text)
        except (OSError, ValueError, RuntimeError, AttributeError):  # full disk, closed, reentered, no stream
            return len(text)

    def flush(self) -> None:
        """Flushes the stream if possible."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            discard_output(self._stream)
        except (OSError, ValueError, RuntimeError, AttributeError):
            return

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        try:
            return self._stream.isatty()
        except (OSError, ValueError, AttributeError):
            return False

    def __getattr__(self, name: str) -> Any:
        if name == "rich_proxied_file":  # otherwise rich would bypass this class
            raise AttributeError(name)
        return getattr(self._stream, name)


class PipedConsole(Console):
    """A console whose closed pipe `wildgs.cli.main` reports, as that of all other output."""

    def on_broken_pipe(self) -> None:
        """Continues with the error that was raised, where rich would exit with code 1."""
        raise BrokenPipeError


OUT, ERR = SafeStream("stdout"), SafeStream("stderr")

# No markup: names of files and photos may contain square brackets.
console = Console(file=OUT, highlight=False, soft_wrap=True, markup=False, emoji=False)  # pyright: ignore[reportArgumentType]


class Lines(logging.Handler):
    """Prints the library's log messages, one per line."""

    def emit(self, record: logging.LogRecord) -> None:
        """Prints a record of level INFO; `warnings.showwarning` prints warnings."""
        if record.levelno == logging.INFO and not processes.rank():
            console.print(record.getMessage())


class Screen:
    """Shows progress. It is a `Progress` callback; its method `step` is an observer of training."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._detail = ""
        self._first, self._started, self._last_line = 0, 0.0, 0.0

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Shows that `done` of `total` items of a stage are finished, by a bar on a terminal, else by lines."""
        if stage != self._stage:
            self._begin(stage, done, total)
        if self._bar is not None:
            self._bar.update(
                self._task, completed=done, total=total or None, detail=self._detail or f"{done}/{total}"
            )
        elif self._detail:
            self._line(done, total)
        elif total and not stage.startswith("training"):
            self._stage_line(done, total)
        if total and done == total:
            self.close()

    def step(self, report: StepReport) -> None:
        """Updates speed, loss and number of Gaussians."""
        if not report.falls_on(REFRESH_STEPS):
            return
        rate = (report.step - self._first) / max(time.monotonic() - self._started, 1e-6)
        loss = float(report.losses.total.detach())
        self._detail = f"{rate:.1f} steps/s  loss {loss:.4f}  {report.num_gaussians:,} Gaussians"

    def close(self) -> None:
        """Closes the current progress bar."""
        if self._bar is not None:
            self._bar.stop()
        self._bar, self._stage, self._detail = None, "", ""

    def _begin(self, stage: str, done: int, total: int) -> None:
        self.close()
        self._stage, self._first = stage, done
        self._started = self._last_line = time.monotonic()
        if console.is_terminal and not console.quiet:
            self._bar = _bar()
            self._task = self._bar.add_task(stage, total=total or None, completed=done, detail="")
            self._bar.start()
        elif stage.startswith("training") and done < total:
            console.print(f"{stage}: {total - done} steps")

    def _stage_line(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done == total:
            console.print(f"{self._stage}: {total} done")
        elif now - self._last_line >= STAGE_SECONDS:
            self._last_line = now
            console.print(f"{self._stage}: {done} of {total}")

    def _line(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done != total and now - self._last_line < LINE_SECONDS:
            return
        self._last_line = now
        left = (total - done) * (now - self._started) / max(done - self._first, 1)
        console.print(f"{self._stage}: step {done}/{total}  {self._detail}  {_clock(left)} left")


@contextmanager
def progress_shown() -> Iterator[Screen]:
    """Gives a `Screen` and closes it at the end of the block."""
    screen = Screen()
    try:
        yield screen
    finally:
        screen.close()


def print_notes(looks: Iterable[Look]) -> None:
    """Prints the notes of appearances, such as how a new photo was localised."""
    for look in looks:
        if look.note:
            console.print(f"{look.name}: {look.note}")


def print_finished(finished: FinishedRun) -> None:
    """Prints the scores and the paths of the web pages."""
    if finished.scores:
        print_scores(finished.scores)
    console.print(f"open {finished.report.resolve()} in a browser: scores and comparisons")
    console.print(f"open {finished.page.resolve()} in a browser: the 3D scene under several lights")


def print_scores(runs: Mapping[str, Scores]) -> None:
    """Prints tables of the scores, and notes on scores that could not be computed."""
    table = Table("run", "protocol", *(header for header, _, _ in _SCORES), "Gaussians", "frames/s")
    parts = Table("run", "protocol", *(header for header, _, _ in _PARTS), "static hidden", "worst photo")
    notes: dict[str, None] = {}
    for name, protocols in runs.items():
        for protocol, metrics in protocols.items():
            mean = metrics["mean"]
            cells = [_number(mean[key], digits) for _, key, digits in _SCORES]
            table.add_row(
                name, protocol, *cells, f"{metrics['num_gaussians']:,}", _number(metrics["render_fps"], 0)
            )
            cells = [_number(mean.get(key), digits) for _, key, digits in _PARTS]
            cells += [_percent(metrics.get(key)) for key in ("static_hidden", "static_hidden_worst")]
            parts.add_row(name, protocol, *cells)
            notes |= dict.fromkeys(metrics.get("notes", ()))
    print_table(table)
    print_table(parts)
    for note in notes:
        console.print(note, style="dim")


def print_table(table: Table) -> None:
    """Prints a table, of which nothing is cut: on a narrow terminal, text continues on the next line."""
    options = console.options.update(width=UNLIMITED)
    if console.is_terminal and console.measure(table, options=options).maximum > console.width:
        _squeeze(table, console.width)
    # As segments, because `print` would limit the width to the terminal's.
    console.print(Segments(console.render(table, options)))


def _squeeze(table: Table, width: int) -> None:
    """Makes columns as narrow as their longest word; the first, of names, gets what is left and breaks anywhere."""
    first, *others = table.columns
    table.padding = (0, 0)
    for column in others:
        words = " ".join(map(str, (column.header, *column.cells))).split()
        column.width = max(map(cell_len, words), default=1)
    left = width - sum((column.width or 0) + 1 for column in others) - 2
    longest = max(cell_len(str(cell)) for cell in (first.header, *first.cells))
    first.width, first.overflow = max(min(left, longest), NAME_WIDTH), "fold"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2%}"


def _bar() -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=False,
    )


def _clock(left: float) -> str:
    minutes, seconds = divmod(round(left), 60)
    return f"{minutes}:{seconds:02d}"
