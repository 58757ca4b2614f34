"""Training schedule as functions of the step."""

from __future__ import annotations

from wildgs.engine.config import ScheduleConfig
from wildgs.model.training_pass import Stage

REFERENCE_STEPS = 30_000
"""The paper's number of training steps, for which schedules are configured; they scale with a run's length."""

_FLOORS = {
    "first_stage": 500,
    "densify_from": 250,
    "densify_every": 50,
    "reset_every": 1000,
    "mask_pause": 100,
    "sh_every": 100,
}
"""Smallest step counts in a short run; a mask, for example, needs this many to become useful."""
_FLOOR_SHARE = 5
"""Such a smallest step count is at most this part (one fifth) of a run."""

MASK_START = 0.3
"""Fraction of the mask's training in which it learns on every step, before `mask_every` takes effect. Otherwise the
Gaussians learn passers-by before the mask does."""

LEAST_MASK_STEPS = 1500
"""Smallest number of steps before masks are final."""


class Schedule:
    """The schedule of one run."""

    def __init__(
        self,
        config: ScheduleConfig,
        steps: int,
        reset_every: int = 3000,
        until: float = 0.5,
        photos: int | None = None,
        every: int = 100,
    ) -> None:
        """Scales a configuration to the length of a run.

        Args:
            config: Configuration for 30,000 steps.
            steps: Number of steps of the run.
            reset_every: Steps between opacity resets unless configured; the method's default.
            until: Fraction of the run in which Gaussians are densified unless configured; the strategy's default.
            photos: Number of training photos, if their masks may become final.
            every: Steps between densifications unless configured; the strategy's default.
        """
        self.steps = steps
        self.encoder_every = config.encoder_every
        self.mask_every = config.mask_every
        self.planes_every = config.planes_every
        self.mask_steps = steps
        if photos is not None and config.mask_visits:
            self.mask_steps = min(steps, max(LEAST_MASK_STEPS, config.mask_visits * photos))
        self._factor = steps / REFERENCE_STEPS
        self.first_stage = self._scaled(config.first_stage, "first_stage")
        self.densify_from = self._scaled(config.densify_from, "densify_from")
        last = round(until * REFERENCE_STEPS) if config.densify_until is None else config.densify_until
        self.densify_until = self._scaled(last, "densify_until")
        every = every if config.densify_every is None else config.densify_every
        self.densify_every = self._scaled(every, "densify_every") if every else 0
        resets = reset_every if config.reset_every is None else config.reset_every
        self.reset_every = self._scaled(resets, "reset_every") if resets and every else 0
        self.mask_pause = self._scaled(config.mask_pause, "mask_pause")
        self.sh_every = self._scaled(config.sh_every, "sh_every")

    def _scaled(self, paper_steps: int, name: str) -> int:
        scaled = round(paper_steps * self._factor)
        floor = min(_FLOORS.get(name, 1), paper_steps)
        if name != "reset_every":
            floor = min(floor, max(1, self.steps // _FLOOR_SHARE))
        return max(scaled, floor)

    def progress(self, step: int) -> float:
        """Fraction of the run that is done, 0 to 1."""
        return _share(step, self.steps)

    def mask_progress(self, step: int) -> float:
        """Fraction of the mask's training that is done, 0 to 1."""
        return _share(step, self.mask_steps)

    def stage(self, step: int, sh_degree: int, taken: int = 1) -> Stage:
        """The stage at a step (from 0) that counts as `taken` steps; `sh_degree` is the method's full degree."""
        return Stage(
            explicit=step >= self.first_stage,
            learn_mask=self.learns_mask(step, taken),
            sh_degree=min(step // self.sh_every, sh_degree),
            learn_encoder=falls_on(step + taken - 1, taken, self.encoder_every),
            # Not on the mask's steps, so that all steps take the same time.
            learn_planes=falls_on(step + taken, taken, self.planes_every),
        )

    def learns_mask(self, step: int, taken: int = 1) -> bool:
        """Whether the mask is trained at a step that counts as `taken` steps."""
        if step >= self.mask_steps or self.mask_paused(step):
            return False
        return step < MASK_START * self.mask_steps or falls_on(step + taken - 1, taken, self.mask_every)

    def mask_paused(self, step: int) -> bool:
        """Whether the last opacity reset is less than `mask_pause` steps ago."""
        if not self.reset_every:
            return False
        last = min(step, self.densify_until - 1) // self.reset_every * self.reset_every
        return last > 0 and step - last < self.mask_pause

    def densifies(self, step: int, taken: int = 1) -> bool:
        """Whether the Gaussians are densified after this step, which counts as `taken` steps."""
        due = self.densify_every > 0 and falls_on(step, taken, self.densify_every)
        return self.densify_from < step < self.densify_until and due

    def resets(self, step: int, taken: int = 1) -> bool:
        """Whether opacities are reset after this step, which counts as `taken` steps."""
        due = self.reset_every > 0 and falls_on(step, taken, self.reset_every)
        return 0 < step < self.densify_until and due

    def gathers(self, step: int) -> bool:
        """Whether view statistics are still needed for densification."""
        return self.densify_every > 0 and step < self.densify_until


def _share(step: int, steps: int) -> float:
    return min(step / max(steps - 1, 1), 1.0)


def falls_on(step: int, taken: int, every: int) -> bool:
    """Whether one of the last `taken` steps up to `step` is a multiple of `every`."""
    return step // every > (step - taken) // every


def exponential(start: float, end: float, progress: float) -> float:
    """Log-linear interpolation from `start` to `end` (3DGS's position learning rate)."""
    return start ** (1 - progress) * end**progress
