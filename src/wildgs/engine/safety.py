"""Skips steps with a non-finite loss or gradient, and ends a run in which they do not stop."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from wildgs.errors import UserError, WildGSWarning
from wildgs.losses.objective import Losses

PATIENCE = 10
"""Bad steps in a row that end a run."""


class TrainingDivergedError(UserError):
    """The loss or its gradient was non-finite for `PATIENCE` steps in a row."""


class StepGuard:
    """Checks every step before the optimisers take it.

    Attributes:
        skipped: Steps skipped so far.
        in_a_row: Steps skipped since the last one taken.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self.in_a_row = 0
        self._photos: list[str] = []

    def judge(self, photo: str, losses: Losses, parameters: Iterable[Tensor]) -> str | None:
        """What is non-finite among losses and gradients, None if nothing is; call after the backward pass."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        norm = nn.utils.get_total_norm(gradients) if gradients else losses.total.new_zeros(())
        # One number, so that a GPU is waited for once.
        if bool(torch.isfinite(losses.total.detach() + norm.to(losses.total))):
            self.in_a_row = 0
            self._photos.clear()
            return None
        self.skipped += 1
        self.in_a_row += 1
        self._photos.append(photo)
        terms = [name for name, value in losses.as_floats().items() if not math.isfinite(value)]
        return f"loss term {terms[0]}" if terms else "gradient"

    def report(self, step: int, fault: str, method: nn.Module) -> None:
        """Warns of a skipped step whose fault `judge` found.

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
