"""Losses and gradients that are no numbers, photos that vanish, and when to save."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.memory_views import GonePhotos
from wildgs.engine.autosave import Autosave
from wildgs.engine.checkpoint import Checkpoint
from wildgs.engine.report import StepReport
from wildgs.engine.safety import PATIENCE, TrainingDivergedError
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.model.registry import create_method, restore_method
from wildgs.model.vanilla import VanillaConfig
from wildgs.scene import Scene


def trainer_for(scene: Scene, steps: int) -> Trainer:
    torch.manual_seed(0)
    method = create_method("3dgs", VanillaConfig(), scene)
    return Trainer(method, scene, TrainConfig(steps=steps, precision="float32"))


def spoil_losses(trainer: Trainer, bad: set[int], monkeypatch: pytest.MonkeyPatch, *, gradient: bool = False):
    """Makes the loss (or only its gradient) of some steps no number."""
    forward = trainer._forward

    def spoiled(*arguments):
        output, losses = forward(*arguments)
        if trainer.step in bad:
            if gradient:
                zero = trainer.method.gaussians.means.sum() * 0
                losses.total = losses.total + torch.sqrt(zero)  # a gradient of 0 * infinity
            else:
                losses.image = losses.image * float("nan")
                losses.total = losses.total + losses.image
        return output, losses

    monkeypatch.setattr(trainer, "_forward", spoiled)


@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("gradient", [False, True])
def test_a_bad_step_is_skipped_and_named(
    wall_scene: Scene, monkeypatch, gradient: bool, on_device: bool
) -> None:
    trainer = trainer_for(wall_scene, 6)
    trainer.skips_on_device = on_device
    spoil_losses(trainer, {2, 4}, monkeypatch, gradient=gradient)
    seen: list[tuple[int, str | None]] = []
    means = []

    def watch(report: StepReport) -> None:
        seen.append((report.step, report.skipped))
        means.append(trainer.method.gaussians.means.detach().clone())

    with pytest.warns(
        WildGSWarning, match=r"step \d, photo \d\.jpg: the .*(gradient|loss term image)"
    ) as caught:
        trainer.run([watch])
    assert len(caught) == 2
    assert [step for step, skipped in seen if skipped] == ([4, 6] if on_device else [3, 5])
    assert {str(w.message).partition(",")[0] for w in caught} == {"step 3", "step 5"}
    assert torch.equal(means[1], means[2]), "nothing is learnt from it"
    assert not torch.equal(means[2], means[3])
    assert trainer.guard.skipped == 2
    assert all(bool(torch.isfinite(p).all()) for p in trainer.method.parameters())
    again = trainer_for(wall_scene, 6)
    again.restore(trainer.state())
    assert again.guard.skipped == 2


@pytest.mark.parametrize("on_device", [False, True])
def test_ten_bad_steps_in_a_row_end_the_run(wall_scene: Scene, monkeypatch, on_device: bool) -> None:
    trainer = trainer_for(wall_scene, 40)
    trainer.skips_on_device = on_device
    spoil_losses(trainer, set(range(5, 40)), monkeypatch)
    saved: list[int] = []
    autosave = Autosave(lambda: saved.append(trainer.step), every=1)
    with (
        pytest.warns(WildGSWarning),
        pytest.raises(TrainingDivergedError, match=r"10 steps in a row.*newest checkpoint"),
    ):
        trainer.run([autosave])
    assert trainer.guard.in_a_row == PATIENCE
    assert saved == [*range(1, 6 + on_device)], "nothing is saved while steps are known to fail"


@pytest.mark.parametrize("bad", [set(), {2, 3, 7}])
def test_adam_that_skips_by_itself_learns_what_a_judged_one_learns(
    wall_scene: Scene, monkeypatch, bad: set[int]
) -> None:
    states = []
    for on_device in (False, True):
        trainer = trainer_for(wall_scene, 9)
        trainer.skips_on_device = on_device
        trainer.schedule.densify_from, trainer.schedule.densify_every = 3, 2
        spoil_losses(trainer, bad, monkeypatch)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", WildGSWarning)
            trainer.run([])
        states.append(trainer.state())
    for name, wanted in states[0].items():
        if name != "progress.seconds":
            assert torch.equal(states[1][name], wanted), name


def test_a_bad_step_counts_before_the_host_has_heard_of_it(wall_scene: Scene, monkeypatch) -> None:
    trainer = trainer_for(wall_scene, 6)
    trainer.skips_on_device = True
    spoil_losses(trainer, {1}, monkeypatch)
    trainer.begin()
    for _ in range(2):
        trainer.advance()
    assert int(trainer.state()["progress.skipped"]) == 1
    with pytest.warns(WildGSWarning, match="step 2, photo"):
        trainer.advance()
    assert trainer.guard.skipped == 1
    trainer.end()


def test_the_diagnosis_names_broken_parameters(wall_scene: Scene) -> None:
    trainer = trainer_for(wall_scene, 40)
    with torch.no_grad():
        trainer.method.gaussians.rows["sh0"].fill_(float("nan"))
    with pytest.warns(WildGSWarning), pytest.raises(TrainingDivergedError, match=r"gaussians\.rows\.sh0"):
        trainer.run()


def test_the_diagnosis_names_the_only_photo(wall_scene: Scene, monkeypatch) -> None:
    trainer = trainer_for(replace(wall_scene, views=wall_scene.views[:1]), 40)
    spoil_losses(trainer, set(range(40)), monkeypatch)
    with pytest.warns(WildGSWarning), pytest.raises(TrainingDivergedError, match=r"on the photo 0\.jpg"):
        trainer.run()


def test_a_photo_that_vanishes_is_passed_over(wall_scene: Scene) -> None:
    views = [
        replace(view, photos=GonePhotos()) if view.name == "2.jpg" else view for view in wall_scene.views
    ]
    trainer = trainer_for(replace(wall_scene, views=tuple(views)), 20)
    names: list[str] = []
    with pytest.warns(WildGSWarning, match=r"2\.jpg: no such file.*continues without it") as caught:
        trainer.run([lambda report: names.append(report.view.name)])
    assert len(caught) == 1
    assert len(names) == 20
    assert "2.jpg" not in names


def test_no_photo_left_is_a_users_mistake(wall_scene: Scene, monkeypatch) -> None:
    trainer = trainer_for(wall_scene, 20)
    trainer.feed.views = tuple(replace(view, photos=GonePhotos()) for view in trainer.views)
    monkeypatch.setattr(trainer, "_prepare", lambda: None)
    with pytest.warns(WildGSWarning), pytest.raises(UserError, match="cannot be read any more"):
        trainer.run()


def report_at(step: int) -> StepReport:
    report = object.__new__(StepReport)  # the rest of it does not matter here
    object.__setattr__(report, "step", step)
    return report


def test_saving_by_steps_and_by_time(monkeypatch) -> None:
    now = [0.0]
    monkeypatch.setattr("wildgs.engine.autosave.time.monotonic", lambda: now[0])
    saved: list[float] = []
    autosave = Autosave(lambda: saved.append(now[0]), every=100, minutes=1.0)
    for step in range(1, 251):
        now[0] += 1.0  # seconds
        autosave(report_at(step))
    assert saved == [60.0, 100.0, 160.0, 200.0]
    assert autosave.saved_step == 200


def test_a_full_disk_does_not_end_training(monkeypatch) -> None:
    now = [0.0]
    monkeypatch.setattr("wildgs.engine.autosave.time.monotonic", lambda: now[0])
    attempts: list[float] = []

    def save() -> None:
        attempts.append(now[0])
        if len(attempts) < 3:
            raise UserError("step_1 cannot be written (No space left on device)")

    autosave = Autosave(save, every=10**6, minutes=1.0)

    def train() -> None:
        for step in range(1, 300):
            now[0] += 1.0
            autosave(report_at(step))

    with pytest.warns(WildGSWarning, match="training continues and tries again") as caught:
        train()
    assert len(caught) == 2
    assert attempts[:3] == [60.0, 120.0, 180.0]
    assert autosave.saved_step >= 180


def test_records_that_cannot_be_written_do_not_end_training(
    wall_scene: Scene, tmp_path: Path, monkeypatch
) -> None:
    from wildgs.engine.recorder import Recorder

    trainer = trainer_for(wall_scene, 6)

    def full(_: str) -> int:
        raise OSError(28, "No space left on device")

    with Recorder(tmp_path, scalars_every=1, pictures_every=100) as recorder:
        recorder._lines.close()
        monkeypatch.setattr(recorder, "_lines", SimpleNamespace(write=full, close=lambda: None))
        with pytest.warns(WildGSWarning, match=r"metrics\.jsonl.*training continues") as caught:
            trainer.run([recorder])
    assert trainer.step == 6
    assert len(caught) == 1


def test_records_of_steps_taken_again_are_dropped(wall_scene: Scene, tmp_path: Path) -> None:
    from wildgs.engine.recorder import Recorder

    lines = tmp_path / "metrics.jsonl"
    lines.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"ste')
    with Recorder(tmp_path, step=2):
        pass
    assert lines.read_text() == '{"step": 1}\n{"step": 2}\n'


def test_a_resumed_run_with_other_photos_draws_a_new_round(wall_scene: Scene) -> None:
    trainer = trainer_for(wall_scene, 10)
    trainer.run([])
    checkpoint = Checkpoint(trainer.state(), {})
    method = restore_method("3dgs", VanillaConfig(), checkpoint.method)
    fewer = Trainer(method, replace(wall_scene, views=wall_scene.views[:3]), TrainConfig(steps=20))
    with pytest.warns(WildGSWarning, match="photos have changed.*continues with the current 3"):
        fewer.restore(checkpoint.state)
    names: list[str] = []
    fewer.run([lambda report: names.append(report.view.name)])
    assert set(names) == {"0.jpg", "1.jpg", "2.jpg"}


def test_a_run_without_steps_is_refused() -> None:
    with pytest.raises(UserError, match="steps 0"):
        TrainConfig(steps=0)
