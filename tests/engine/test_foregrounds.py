"""Foregrounds within a run: found once, when masks are trained by evidence."""

from __future__ import annotations

import pytest
import torch

from tests.engine.test_trainer import trainer_for
from wildgs.engine import foregrounds
from wildgs.losses.config import ObjectiveConfig
from wildgs.model.wildgs import WildGSConfig
from wildgs.scene import Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")


def test_depth_maps_are_compared_once(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer, seen = trainer_for(wall_scene, tiny_model, 3), []
    trainer.foregrounds.on_photo = lambda done, total: seen.append((done, total))
    trainer.run()
    photos = len(wall_scene.train_views)
    assert seen == [(done + 1, photos) for done in range(photos)]


@pytest.mark.parametrize(
    "objective", [ObjectiveConfig(free_space=False), ObjectiveConfig(mask_gradient="loss")]
)
def test_depth_maps_are_not_compared_where_nothing_reads_it(
    wall_scene: Scene, tiny_model: WildGSConfig, objective: ObjectiveConfig
) -> None:
    trainer, seen = trainer_for(wall_scene, tiny_model, 1, objective=objective), []
    trainer.foregrounds.on_photo = lambda done, total: seen.append(done)
    trainer.run()
    assert seen == []


def test_methods_without_a_mask_need_no_foregrounds(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer, seen = trainer_for(wall_scene, tiny_model, 1, "3dgs"), []
    trainer.foregrounds.on_photo = lambda done, total: seen.append(done)
    trainer.run()
    assert seen == []


def test_foregrounds_end_with_the_training_of_masks(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer = trainer_for(wall_scene, tiny_model, 3)
    name = wall_scene.train_views[0].name
    assert trainer.foregrounds.of(name, trainer.foregrounds.steps) is None


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_masks_hide_foregrounds(
    wall_scene: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    maps = {view.name: torch.full((8, 8), share) for view in wall_scene.train_views}
    monkeypatch.setattr(foregrounds, "find_foregrounds", lambda scene, on_photo: maps)
    trainer = trainer_for(wall_scene, tiny_model, 60)
    trainer.run()
    photo = wall_scene.train_views[0].load(torch.device("cpu"))[0]
    visibility = trainer.method.visibility(photo)
    assert visibility is not None
    assert (float(visibility.detach().mean()) < 0.5) == (share == 1)
