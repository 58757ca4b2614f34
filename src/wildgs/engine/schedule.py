"""Training schedules as functions of the step."""

from __future__ import annotations

from wildgs.engine.config import ScheduleConfig
from wildgs.model.training_pass import Stage

REFERENCE_STEPS = 30_000
"""The paper's training length; schedules below are stated for it and scale with the run's own length."""


_FLOORS = {
    "first_stage": 500,
    "densify_from": 250,
    "densify_every": 50,
    "reset_every": 1000,
    "mask_pause": 100,
    "sh_every": 100,
}
"""Least steps in a short run: a mask, for example, needs so many to become useful whatever the run's length."""
_FLOOR_SHARE = 5
"""A floor takes at most this part (one in five) of a run."""


class Schedule:
    """The schedules of one run."""

    def __init__(
        self, config: ScheduleConfig, steps: int, reset_every: int = 3000, until: float = 0.5
    ) -> None:
        """Scales a configuration in the paper's steps to a run.

        Args:
            config: In the paper's steps.
            steps: Length of the run.
            reset_every: The method's, where the configuration names none.
            until: Share of the run in which Gaussians are densified, likewise.
        """
        self.steps = steps
        self.encoder_every = config.encoder_every
        self.mask_every = config.mask_every
        self.planes_every = config.planes_every
        self._factor = steps / REFERENCE_STEPS
        self.first_stage = self._scaled(config.first_stage, "first_stage")
        self.densify_from = self._scaled(config.densify_from, "densify_from")
        last = round(until * REFERENCE_STEPS) if config.densify_until is None else config.densify_until
        self.densify_until = self._scaled(last, "densify_until")
        self.densify_every = (
            self._scaled(config.densify_every, "densify_every") if config.densify_every else 0
        )
        resets = reset_every if config.reset_every is None else config.reset_every
        self.reset_every = self._scaled(resets, "reset_every") if resets and config.densify_every else 0
        self.mask_pause = self._scaled(config.mask_pause, "mask_pause")
        self.sh_every = self._scaled(config.sh_every, "sh_every")

    def _scaled(self, paper_steps: int, name: str) -> int:
        scaled = round(paper_steps * self._factor)
        floor = min(_FLOORS.get(name, 1), paper_steps)
        if name != "reset_every":
            floor = min(floor, max(1, self.steps // _FLOOR_SHARE))
        return max(scaled, floor)

    def progress(self, step: int) -> float:
        """Share of the run that lies behind, in [0, 1]."""
        return min(step / max(self.steps - 1, 1), 1.0)

    def stage(self, step: int, sh_degree: int, taken: int = 1) -> Stage:
        """The stage at a step (from 0) that counts for `taken` steps; `sh_degree` is the method's full degree."""
        return Stage(
            explicit=step >= self.first_stage,
            learn_mask=not self.mask_paused(step) and falls_on(step + taken - 1, taken, self.mask_every),
            sh_degree=min(step // self.sh_every, sh_degree),
            learn_encoder=falls_on(step + taken - 1, taken, self.encoder_every),
            # On other steps than the mask, so that all steps take alike.
            learn_planes=falls_on(step + taken, taken, self.planes_every),
        )

    def mask_paused(self, step: int) -> bool:
        """Whether an opacity reset lies less than `mask_pause` steps back."""
        if not self.reset_every:
            return False
        last = min(step, self.densify_until - 1) // self.reset_every * self.reset_every
        return last > 0 and step - last < self.mask_pause

    def densifies(self, step: int, taken: int = 1) -> bool:
        """Whether the Gaussians are densified after this step, which counted for `taken`."""
        due = self.densify_every > 0 and falls_on(step, taken, self.densify_every)
        return self.densify_from < step < self.densify_until and due

    def resets(self, step: int, taken: int = 1) -> bool:
        """Whether opacities are reset after this step, which counted for `taken`."""
        due = self.reset_every > 0 and falls_on(step, taken, self.reset_every)
        return 0 < step < self.densify_until and due

    def gathers(self, step: int) -> bool:
        """Whether screen statistics are still needed."""
        return self.densify_every > 0 and step < self.densify_until


def falls_on(step: int, taken: int, every: int) -> bool:
    """Whether a multiple of `every` lies among the last `taken` steps up to `step`."""
    return step // every > (step - taken) // every


def exponential(start: float, end: float, progress: float) -> float:
    """Log-linear interpolation from `start` to `end` (3DGS's position learning rate)."""
    return start ** (1 - progress) * end**progress
