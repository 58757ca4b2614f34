"""Training end to end on a scene in memory: it learns, it observes, it resumes to the same bits."""

from __future__ import annotations

import json
import weakref
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wildgs.engine import schedule
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint, save_checkpoint
from wildgs.engine.config import DensityConfig, Strategy
from wildgs.engine.density import SeenView
from wildgs.engine.density.control import ViewStatistics
from wildgs.engine.density.relocation import RelocationDensity
from wildgs.engine.recorder import Recorder
from wildgs.engine.report import StepReport
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.model.config import SQUEEZENET
from wildgs.model.registry import MethodName, create_method, restore_method
from wildgs.model.vanilla import VanillaConfig
from wildgs.model.wildgs import WildGSConfig
from wildgs.scene import Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")


def trainer_for(
    scene: Scene, model: WildGSConfig, steps: int, method: MethodName = "wildgs", **config
) -> Trainer:
    torch.manual_seed(0)
    made = create_method(method, model if method == "wildgs" else None, scene)
    return Trainer(made, scene, TrainConfig(steps=steps, precision="float32", **config))


@pytest.mark.parametrize("method", ["wildgs", "3dgs"])
def test_loss_falls(wall_scene: Scene, tiny_model: WildGSConfig, method: MethodName) -> None:
    bright = replace(wall_scene, views=wall_scene.views[1::2])
    trainer = trainer_for(bright, tiny_model, 100, method)
    losses: list[float] = []
    trainer.run([lambda report: losses.append(float(report.losses.image.detach()))])
    assert trainer.step == 100
    assert len(losses) == 100
    assert sum(losses[-14:]) < 0.6 * sum(losses[:14])


def test_wildgs_separates_lights_that_the_baseline_averages(
    wall_scene: Scene, tiny_model: WildGSConfig
) -> None:
    errors = {}
    for method in ("wildgs", "3dgs"):
        # Three of three seeds have a ratio of 0.13.
        trainer = trainer_for(wall_scene, tiny_model, 100, method)
        trainer.run()
        view = wall_scene.test_views[0]
        photo = view.read_photo().float() / 255
        with torch.no_grad():
            sh = trainer.method.shade(trainer.method.encode(photo, view.camera))
            errors[method] = float((trainer.method.render(view.camera, sh).colors - photo).square().mean())
    assert errors["wildgs"] < 0.5 * errors["3dgs"]


def test_growth_ignores_pixels_that_may_be_transient(
    wall_scene: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares: list[float] = []
    measure = RelocationDensity.measure

    def recording(
        self: RelocationDensity, view: SeenView, sound: torch.Tensor | None = None
    ) -> ViewStatistics:
        assert view.counts is not None
        shares.append(float(view.counts.float().mean()))
        return measure(self, view, sound)

    monkeypatch.setattr(RelocationDensity, "measure", recording)
    for least in (0.0, 1.0):
        config = DensityConfig(min_visibility=least)
        trainer_for(wall_scene, tiny_model, steps=1, density=config).run()
    assert shares == [1.0, 0.0]


def test_first_stage_has_neither_triplane_nor_depth_loss(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer = trainer_for(wall_scene, tiny_model, 30, schedule=ScheduleConfig(first_stage=15_000))
    depth: list[float] = []
    planes = next(trainer.method.wrapping.unet.parameters())  # pyright: ignore[reportAttributeAccessIssue]
    before = planes.detach().clone()
    untouched: list[bool] = []

    def watch(report: StepReport) -> None:
        depth.append(float(report.losses.depth.detach()))
        untouched.append(torch.equal(planes.detach(), before))

    trainer.run([watch])
    assert depth[:15] == [0.0] * 15
    assert any(value != 0 for value in depth[15:])
    assert untouched[14]
    assert not untouched[-1]


@pytest.mark.parametrize("trainable", [False, True])
def test_final_masks_still_hide_but_no_longer_change(
    wall_scene: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch, trainable: bool
) -> None:
    """Where the encoder goes on learning, so do the masks, since they depend on it."""
    monkeypatch.setattr(schedule, "LEAST_MASK_STEPS", 4)
    encoder = "None" if trainable else SQUEEZENET
    model = replace(tiny_model, parsing=replace(tiny_model.parsing, encoder=encoder))
    trainer = trainer_for(wall_scene, model, 12, schedule=ScheduleConfig(mask_visits=1))
    photo = wall_scene.train_views[0].read_photo().float() / 255
    masks = {}

    def look(report: StepReport) -> None:
        masks[report.step] = trainer.method.visibility(photo)

    trainer.run([look])
    first = max(4, len(wall_scene.train_views))
    assert not torch.equal(masks[1], masks[first])
    assert torch.equal(masks[first], masks[12]) != trainable


def test_without_depth_there_is_no_depth_loss(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer = trainer_for(wall_scene, replace(tiny_model, without=("depth",)), 10)
    depth: list[float] = []
    trainer.run([lambda report: depth.append(float(report.losses.depth.detach()))])
    assert set(depth) == {0.0}


SCHEDULE = ScheduleConfig(
    densify_from=10 * 500, densify_every=5 * 500, reset_every=15 * 500, first_stage=2000
)


def differences(expected: dict[str, torch.Tensor], got: dict[str, torch.Tensor]) -> list[str]:
    assert expected.keys() == got.keys()
    return [n for n in expected if n != "progress.seconds" and not torch.equal(expected[n], got[n])]


@pytest.mark.parametrize(("method", "strategy"), [("3dgs", None), ("wildgs", None), ("3dgs", "mcmc")])
def test_a_resumed_run_ends_in_the_same_bits(
    wall_scene: Scene,
    tiny_model: WildGSConfig,
    tmp_path: Path,
    method: MethodName,
    strategy: Strategy | None,
) -> None:
    density = DensityConfig(strategy=strategy, max_gaussians=700)
    whole = trainer_for(wall_scene, tiny_model, 60, method, schedule=SCHEDULE, density=density)
    whole.run([lambda r: save_checkpoint(tmp_path, r.step, whole.state(), {}) if r.step == 35 else None])
    again = trainer_for(wall_scene, tiny_model, 60, method, schedule=SCHEDULE, density=density)
    again.run()
    assert differences(whole.state(), again.state()) == [], "two undisturbed runs"
    checkpoint = load_checkpoint(list_checkpoints(tmp_path)[0])
    torch.manual_seed(123)  # whatever happened before must not matter
    model = tiny_model if method == "wildgs" else VanillaConfig()
    resumed = Trainer(restore_method(method, model, checkpoint.method), wall_scene, whole.config)
    resumed.restore(checkpoint.state)
    assert resumed.step == 35
    resumed.run()
    assert differences(whole.state(), resumed.state()) == []


def test_checkpoint_holds_all_that_training_needs(
    wall_scene: Scene, tiny_model: WildGSConfig, tmp_path: Path
) -> None:
    """The state comes back bit for bit, networks and moments in their layout, and training continues from it."""
    first = trainer_for(wall_scene, tiny_model, 30, schedule=SCHEDULE)
    first.run([lambda r: save_checkpoint(tmp_path, r.step, first.state(), {}) if r.step == 15 else None])
    checkpoint = load_checkpoint(list_checkpoints(tmp_path)[0])
    resumed = Trainer(restore_method("wildgs", tiny_model, checkpoint.method), wall_scene, first.config)
    resumed.restore(checkpoint.state)
    assert differences(checkpoint.state, resumed.state()) == []
    for parameter, optimizer in ((p, o) for _, _, p, o in resumed.optimizers._parameters()):
        assert optimizer.state[parameter]["exp_avg"].stride() == parameter.stride()
    views: list[str] = []
    resumed.run([lambda report: views.append(report.view.name)])
    assert resumed.step == 30
    assert len(set(views)) == len(wall_scene.train_views)


def test_a_scene_without_training_photos_is_a_users_mistake(
    wall_scene: Scene, tiny_model: WildGSConfig
) -> None:
    with pytest.raises(UserError, match="no training photo"):
        trainer_for(replace(wall_scene, views=wall_scene.test_views), tiny_model, 10)


def test_recorder_leaves_lines_and_a_board(
    wall_scene: Scene, tiny_model: WildGSConfig, tmp_path: Path
) -> None:
    trainer = trainer_for(wall_scene, tiny_model, 20)
    with Recorder(tmp_path, scalars_every=5, pictures_every=20) as recorder:
        trainer.run([recorder])
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 15, 20]
    assert {"image", "mask", "depth", "total", "num_gaussians", "steps_per_second", "visibility"} <= set(
        lines[0]
    )
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert "train/total" in board.Tags()["scalars"]
    assert {"train/photo", "train/render", "train/visibility", "train/depth"} <= set(board.Tags()["images"])


def test_missing_pretrained_weights_do_not_stop_training(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    missing = replace(tiny_model, parsing=replace(tiny_model.parsing, encoder="nobody/no-such-network"))
    with pytest.warns(WildGSWarning, match="learnt from scratch"):
        trainer = trainer_for(wall_scene, missing, 2)
    trainer.run()
    assert trainer.step == 2


def test_no_graph_of_a_step_lives_on_into_the_next(
    wall_scene: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What an observer holds must not: its gradient accumulators would invalidate the capture of a CUDA graph."""
    trainer = trainer_for(wall_scene, tiny_model, 4)
    forward, last, alive = trainer.method.training_pass, [], []

    def watched(*args, **kwargs):
        alive.extend(reference() is not None for reference in last)
        output = forward(*args, **kwargs)
        last[:] = [weakref.ref(tensor) for tensor in (output.rendering.colors, output.projection.means2d)]
        return output

    monkeypatch.setattr(trainer.method, "training_pass", watched)
    reports: list[StepReport] = []
    trainer.run([reports.append])
    assert alive == [False] * 6
    for report in reports:
        tensors = [*vars(report.losses).values(), *vars(report.rendering).values(), report.visibility]
        assert all(tensor.grad_fn is None for tensor in tensors)
