"""Skips steps with a non-finite loss or gradient, and stops a run after several in a row."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wildgs.errors import UserError, WildGSWarning
from wildgs.losses.objective import Losses

PATIENCE = 10
"""Number of consecutive skipped steps after which a run stops."""


class TrainingDivergedError(UserError):
    """The loss or its gradient was non-finite in `PATIENCE` consecutive steps."""


@dataclass(frozen=True)
class _Mark:
    """A step on a GPU that the host has not checked yet.

    Attributes:
        step: Number of the step.
        photo: Name of its photo.
        numbers: Its losses, and 1 if it is skipped, being copied to the CPU.
        arrived: Event at the end of the copy.
    """

    step: int
    photo: str
    numbers: Tensor
    arrived: torch.cuda.Event | None

    def read(self) -> list[float]:
        """Waits for the copy and returns the numbers."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return self.numbers.tolist()


class StepGuard:
    """Checks every step before the optimisers take it.

    Attributes:
        in_a_row: Number of steps skipped since the last one taken.
    """

    def __init__(self) -> None:
        self.in_a_row = 0
        self._skipped = 0
        self._photos: list[str] = []
        self._mark: _Mark | None = None

    @property
    def skipped(self) -> int:
        """Number of steps skipped so far."""
        return self._skipped + (self._mark is not None and self._mark.read()[-1] != 0)

    @skipped.setter
    def skipped(self, count: int) -> None:
        self._skipped = count
        self._mark = None

    def judge(self, photo: str, losses: Losses, parameters: Iterable[Tensor]) -> str | None:
        """Checks a step after its backward pass. Synchronises with a GPU.

        Args:
            photo: Name of the photo.
            losses: Losses of the step.
            parameters: Parameters with gradients.

        Returns:
            None if the step may be taken, else what is non-finite.
        """
        faulty = bool(_is_faulty(losses, parameters))
        return self._count(photo, faulty, losses.as_floats() if faulty else {})

    def mark(self, step: int, photo: str, losses: Losses, parameters: Iterable[Tensor]) -> Float[Tensor, ""]:
        """Checks a step without synchronisation; `judge_marked` gives the result after the next forward pass.

        Args:
            step: Number of the step.
            photo: Name of the photo.
            losses: Losses of the step.
            parameters: Parameters with gradients.

        Returns:
            1 if the step must be skipped, else 0, for `Optimizers.step`.
        """
        faulty = _is_faulty(losses, parameters).float()
        values = torch.stack([*losses.terms().values(), faulty])
        numbers = torch.empty(len(values), pin_memory=values.is_cuda).copy_(values, non_blocking=True)
        arrived = torch.cuda.Event() if values.is_cuda else None
        if arrived is not None:
            arrived.record()
        self._mark = _Mark(step, photo, numbers, arrived)
        return faulty

    def judge_marked(self) -> tuple[int, str] | None:
        """The result for the last step given to `mark`: None, or its number and what is non-finite."""
        mark, self._mark = self._mark, None
        if mark is None:
            return None
        *values, faulty = mark.read()
        fault = self._count(mark.photo, faulty != 0, dict(zip(Losses.NAMES, values, strict=True)))
        return None if fault is None else (mark.step, fault)

    def _count(self, photo: str, faulty: bool, terms: dict[str, float]) -> str | None:
        if not faulty:
            self.in_a_row = 0
            self._photos.clear()
            return None
        self._skipped += 1
        self.in_a_row += 1
        self._photos.append(photo)
        non_finite = [name for name, value in terms.items() if not math.isfinite(value)]
        return f"loss term {non_finite[0]}" if non_finite else "gradient"

    def report(self, step: int, fault: str, method: nn.Module) -> None:
        """Warns that a step was skipped.

        Args:
            step: Number of the step.
            fault: From `judge`.
            method: Searched for non-finite parameters if the run has to stop.

        Raises:
            TrainingDivergedError: `PATIENCE` consecutive steps were skipped.
        """
        photo = self._photos[-1]
        if self.in_a_row >= PATIENCE:
            raise TrainingDivergedError(_diagnosis(step, fault, self._photos, method))
        if self.in_a_row == 1 or self.skipped <= PATIENCE:
            warnings.warn(
                f"step {step}, photo {photo}: the {fault} is non-finite; the step is skipped "
                f"({self.skipped} so far)",
                WildGSWarning,
                stacklevel=2,
            )


def _is_faulty(losses: Losses, parameters: Iterable[Tensor]) -> Bool[Tensor, ""]:
    """Whether the loss or a gradient is non-finite, as one tensor: at most one synchronisation."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = nn.utils.get_total_norm(gradients) if gradients else losses.total.new_zeros(())
    return ~torch.isfinite(losses.total.detach() + norm.to(losses.total))


def _diagnosis(step: int, fault: str, photos: list[str], method: nn.Module) -> str:
    broken = [name for name, value in method.named_parameters() if not bool(torch.isfinite(value).all())]
    names = sorted(set(photos))
    if broken:
        cause = f"the parameters {', '.join(broken[:3])} contain non-finite values"
    elif len(names) == 1:
        cause = f"all of them on the photo {names[0]}; check it and its camera, or remove it from the scene"
    else:
        cause = f"on {len(names)} photos ({', '.join(names[:3])}, ...), with finite parameters"
    return (
        f"training diverged at step {step}: {PATIENCE} steps in a row had a non-finite {fault}: {cause}. "
        "--resume continues from the newest checkpoint, which was saved before; lower learning rates "
        "(--optimizer.*) in a new run may help"
    )
