"""Skips steps with a non-finite loss or gradient, and ends a run in which they do not stop."""

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
"""Bad steps in a row that end a run."""


class TrainingDivergedError(UserError):
    """The loss or its gradient was non-finite for `PATIENCE` steps in a row."""


@dataclass(frozen=True)
class _Mark:
    """A step on a GPU that the host has not judged yet.

    Attributes:
        step: Its number.
        photo: That it trained on.
        numbers: Its losses, and 1 where it is not to be taken, on their way to main memory.
        arrived: When they are there.
    """

    step: int
    photo: str
    numbers: Tensor
    arrived: torch.cuda.Event | None

    def read(self) -> list[float]:
        """The numbers."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return self.numbers.tolist()


class StepGuard:
    """Checks every step before the optimisers take it.

    Attributes:
        in_a_row: Steps skipped since the last one taken.
    """

    def __init__(self) -> None:
        self.in_a_row = 0
        self._skipped = 0
        self._photos: list[str] = []
        self._mark: _Mark | None = None

    @property
    def skipped(self) -> int:
        """Steps not taken so far."""
        return self._skipped + (self._mark is not None and self._mark.read()[-1] != 0)

    @skipped.setter
    def skipped(self, count: int) -> None:
        self._skipped = count
        self._mark = None

    def judge(self, photo: str, losses: Losses, parameters: Iterable[Tensor]) -> str | None:
        """Whether a step may be taken; call after the backward pass. On a GPU, the host waits.

        Args:
            photo: Name of the photo that trains.
            losses: Of this step.
            parameters: With their gradients.

        Returns:
            None for a good step, else what is not finite.
        """
        faulty = bool(_is_faulty(losses, parameters))
        return self._count(photo, faulty, losses.as_floats() if faulty else {})

    def mark(self, step: int, photo: str, losses: Losses, parameters: Iterable[Tensor]) -> Float[Tensor, ""]:
        """As `judge`, but the host does not wait: `judge_marked` says the result after the next forward pass.

        Args:
            step: Its number.
            photo: Name of the photo that trains.
            losses: Of this step.
            parameters: With their gradients.

        Returns:
            1 where the step must not be taken, else 0, for `Optimizers.step`.
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
        """Judges the step that was marked last: its number and what is not finite; None where nothing is wrong."""
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
        wrong = [name for name, value in terms.items() if not math.isfinite(value)]
        return f"loss term {wrong[0]}" if wrong else "gradient"

    def report(self, step: int, fault: str, method: nn.Module) -> None:
        """Says that a step was not taken.

        Args:
            step: Its number.
            fault: From `judge`.
            method: Searched for parameters that are not finite, where the run has to end.

        Raises:
            TrainingDivergedError: `PATIENCE` steps in a row were skipped.
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
    """Whether the loss or a gradient is not finite, as one number: a GPU is waited for once at most."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = nn.utils.get_total_norm(gradients) if gradients else losses.total.new_zeros(())
    return ~torch.isfinite(losses.total.detach() + norm.to(losses.total))


def _diagnosis(step: int, fault: str, photos: list[str], method: nn.Module) -> str:
    broken = [name for name, value in method.named_parameters() if not bool(torch.isfinite(value).all())]
    names = sorted(set(photos))
    if broken:
        cause = f"the parameters {', '.join(broken[:3])} hold non-finite values"
    elif len(names) == 1:
        cause = f"all of them on the photo {names[0]}; look at it and its camera, or take it out of the scene"
    else:
        cause = f"on {len(names)} photos ({', '.join(names[:3])}, ...), with finite parameters"
    return (
        f"training diverged at step {step}: {PATIENCE} steps in a row had a non-finite {fault}: {cause}. "
        "The newest checkpoint was saved before; --resume continues from it, and lower learning rates "
        "(--optimizer.*) in a new run may help"
    )
