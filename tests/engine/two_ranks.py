"""What each of two processes does for test_distributed.py, which starts it with torchrun; never collected.

    torchrun --nproc-per-node 2 two_ranks.py OUTPUT

Every rank leaves what it computed and what it heard as files in OUTPUT.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from conftest import build_tiny_model, build_wall_scene
from wildgs.engine.checkpoint import Checkpoint
from wildgs.engine.config import DensityConfig, WarpConfig
from wildgs.engine.density import SeenView
from wildgs.engine.distributed import join
from wildgs.engine.report import StepReport
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.losses.objective import Losses
from wildgs.model.registry import MethodName, create_method
from wildgs.scene import View

METHODS: tuple[MethodName, ...] = ("3dgs", "wildgs")
STEPS = 101
SCHEDULE = ScheduleConfig(first_stage=20 * 300, densify_from=1, densify_every=20 * 300, densify_until=30_000)


def trainer_for(method: MethodName, team: Team, schedule: ScheduleConfig) -> Trainer:
    scene = build_wall_scene()
    torch.manual_seed(0)
    model = build_tiny_model()
    # What is lifted is drawn at random, by two processes in another order than by one.
    model = replace(model, wrapping=replace(model.wrapping, partial_lifts=0.0))
    made = create_method(method, model if method == "wildgs" else None, scene)
    density = DensityConfig(grow_gradient=2e-5)
    warp = WarpConfig(residuals=False, photos=0)
    config = TrainConfig(steps=STEPS, precision="float32", schedule=schedule, density=density, warp=warp)
    return Trainer(made, scene, config, team)


EVERY_STEP = ScheduleConfig(first_stage=0, mask_every=1, planes_every=1)
"""All parts learn on all steps."""


def found_in(trainer: Trainer, losses: list[Losses]) -> dict:
    return {
        "gradients": {n: p.grad for n, p in trainer.method.named_parameters() if p.grad is not None},
        "density": trainer.density.state(),
        "total": sum(float(each.total.detach()) for each in losses) / len(losses),
    }


def step_forward(trainer: Trainer, view: View) -> tuple[SeenView, Losses]:
    """A step up to its losses."""
    photo, keep = trainer.feed.photo(view)
    sky = trainer._sky(view)
    output, losses = trainer._forward(view, photo, keep, sky)
    static = trainer._static_pixels(output, keep, sky)
    seen = SeenView(output.projection, output.rendering.colors, output.painted, photo, static)
    return trainer.density.before_backward(seen), losses


def first_gradients(output: Path, team: Team) -> None:
    """Both photos in two processes, and both in one, all parts of the method on."""
    for method in METHODS:
        together = trainer_for(method, team, EVERY_STEP)
        together.begin()
        seen, losses = step_forward(together, together.feed.next_view())
        losses.total.backward()
        mean = team.average(together.method.parameters(), losses)
        together.density.gather(seen, team.pool)

        alone = trainer_for(method, Team(), EVERY_STEP)
        alone.begin()
        both = []
        for index in alone.sampler.take(2):
            seen, losses = step_forward(alone, alone.views[index])
            (losses.total / 2).backward()
            seen.projection.means2d.grad *= 2
            alone.density.gather(seen)
            both.append(losses)
        found = {"together": found_in(together, [mean]), "alone": found_in(alone, both)}
        torch.save(found, output / f"gradients_{method}_{team.rank}.pt")


def training(output: Path, team: Team) -> None:
    """A short training with densification: what rank 0 would save, and what this rank saw."""
    for method in METHODS:
        trainer = trainer_for(method, team, SCHEDULE)
        reports: list[StepReport] = []
        trainer.run([reports.append])
        state = {name: value for name, value in trainer.state().items() if name != "progress.seconds"}
        found = {
            "fingerprint": Checkpoint(state, {}).fingerprint,
            "photos": [report.view.name for report in reports],
            "displaced": [bool(grid.any()) for grid in trainer.warps.grids],
            "counts": [report.num_gaussians for report in reports],
            "steps": [report.step for report in reports],
            "losses": [float(report.losses.total) for report in reports],
        }
        torch.save(found, output / f"trained_{method}_{team.rank}.pt")


def mistakes(output: Path, team: Team) -> None:
    """What one rank does wrong, all ranks have to hear of."""
    heard: dict[str, object] = {}

    def listen(name: str, function: Callable[[], object]) -> None:
        try:
            heard[name] = function()
        except UserError as error:
            heard[name] = (type(error).__name__, str(error))

    def fail(message: str, only: int | None = None) -> None:
        if only in (None, team.rank):
            raise UserError(message)

    def one_fails() -> None:
        with team.propagate_errors():
            fail("no such folder", only=1)

    def both_warn() -> int:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            with team.propagate_errors():
                warnings.warn("of both", WildGSWarning, stacklevel=1)
        return len(caught)

    def unlike_sizes() -> None:
        zero = torch.zeros(())
        team.average([torch.nn.Parameter(torch.zeros(3 + team.rank))], Losses(zero, zero, zero, zero))

    def stop() -> tuple[int, int]:
        before = team.stop_signal
        team.received_signal = 15 if team.rank == 1 else 0
        zero = torch.zeros(())
        team.average([], Losses(zero, zero, zero, zero))
        team.received_signal = 0
        return before, team.stop_signal

    def partly_without_gradient() -> list[object]:
        here, nowhere = torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(2))
        if team.rank == 1:
            here.grad = torch.tensor([4.0, 2.0])
        zero = torch.zeros(())
        team.average([here, nowhere], Losses(zero, zero, zero, zero))
        return [here.grad, nowhere.grad]

    listen("one_fails", one_fails)
    listen("both_warn", both_warn)
    listen("first_fails", lambda: team.from_first(lambda: fail("the disk is full")))
    listen("from_first", lambda: team.from_first(lambda: f"by {team.rank}"))
    listen("least", lambda: team.least(5 - team.rank))
    listen("unlike_facts", lambda: team.require_same({"photos": f"{8 + team.rank}"}))
    listen("unlike_sizes", unlike_sizes)
    listen("partly_without_gradient", partly_without_gradient)
    own = torch.tensor([team.rank / 2])
    listen("exchange", lambda: [(n, float(x)) for n, x in team.exchange(7 + team.rank, own)])
    listen("stop", stop)
    torch.save(heard, output / f"heard_{team.rank}.pt")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    with join() as joined:
        for part in (mistakes, first_gradients, training):
            part(Path(sys.argv[1]), joined)
