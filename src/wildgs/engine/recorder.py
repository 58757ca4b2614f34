"""Logs of training: metrics.jsonl and TensorBoard."""

from __future__ import annotations

import contextlib
import json
import warnings
from pathlib import Path
from types import TracebackType

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from wildgs.engine.report import StepReport
from wildgs.errors import UserError, WildGSWarning
from wildgs.files import check_regular, is_there, printable, written_aside


class Recorder:
    """An observer of training that writes logs; a context manager that closes its files."""

    def __init__(
        self, folder: Path, *, scalars_every: int = 50, pictures_every: int = 500, step: int = 0
    ) -> None:
        """Opens the logs in a run folder.

        Args:
            folder: The run folder.
            scalars_every: Steps between log entries.
            pictures_every: Steps between images on TensorBoard.
            step: Number of steps done; log entries of later steps are dropped.

        Raises:
            UserError: The folder cannot be written to.
        """
        self.scalars_every = scalars_every
        self.pictures_every = pictures_every
        lines = folder / "metrics.jsonl"
        if printable(str(folder)) != str(folder):
            raise UserError(
                f"{printable(str(folder))}: TensorBoard cannot write to paths that are not UTF-8 or contain "
                "control characters; choose another --output"
            )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if is_there(lines):
                check_regular(lines)  # opening a pipe would wait for its reader
            _keep_until(lines, step)
            self._lines = lines.open("a", encoding="utf-8")
            self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)
        except OSError as error:
            raise UserError(
                f"{folder} cannot be written to ({error}); free disk space or fix permissions"
            ) from error
        self._failed = False

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for file in (self._lines, self._board):
            with contextlib.suppress(OSError):  # a full disk has been reported already
                file.close()

    def __call__(self, report: StepReport) -> None:
        """Logs a step if it is due; if the files cannot be written, training continues without logs."""
        try:
            if report.falls_on(self.scalars_every) or report.skipped is not None:
                self._record_scalars(report)
            if report.falls_on(self.pictures_every):
                self._record_pictures(report)
        except OSError as error:
            if not self._failed:
                warnings.warn(
                    f"metrics.jsonl and tensorboard cannot be written ({error}); training continues",
                    WildGSWarning,
                    stacklevel=2,
                )
            self._failed = True

    def _record_scalars(self, report: StepReport) -> None:
        values = report.losses.as_floats()
        values["num_gaussians"] = report.num_gaussians
        values["steps_per_second"] = report.step / max(report.seconds, 1e-9)
        if report.visibility is not None:
            values["visibility"] = float(report.visibility.mean())
        for name, value in values.items():
            self._board.add_scalar(f"train/{name}", value, report.step)
        line = {"step": report.step, "seconds": round(report.seconds, 3), "view": report.view.name, **values}
        if report.skipped is not None:
            line["skipped"] = report.skipped
        self._lines.write(json.dumps(line) + "\n")
        self._lines.flush()

    def _record_pictures(self, report: StepReport) -> None:
        pictures = {
            "photo": report.view.read_photo().float() / 255,
            "render": report.rendering.colors.clamp(0, 1),
            "depth": _grey(report.rendering.depth),
        }
        if report.visibility is not None:
            pictures["visibility"] = report.visibility[..., None]
        for name, picture in pictures.items():
            self._board.add_image(f"train/{name}", picture, report.step, dataformats="HWC")


def _grey(depth: Tensor) -> Tensor:
    """Inverse depth, scaled to [0, 1]: near is bright, empty is black."""
    disparity = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    limit = (
        disparity[disparity > 0].quantile(0.98) if bool((disparity > 0).any()) else disparity.new_tensor(1)
    )
    return (disparity / limit).clamp(0, 1)[..., None]


def _keep_until(lines: Path, step: int) -> None:
    """Drops log entries of steps that a resumed run repeats, and truncated lines."""
    if not lines.is_file():
        return
    kept = []
    for line in lines.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue
    with written_aside(lines) as aside:
        aside.write_text("".join(kept), encoding="utf-8")
