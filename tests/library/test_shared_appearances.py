"""Appearances of the training are used again by what follows it in the same process."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from wildgs.config import RunConfig
from wildgs.engine.config import DensityConfig, TrainConfig
from wildgs.library.day import find_day
from wildgs.library.loaded import LoadedScene
from wildgs.library.training import train
from wildgs.light import photos
from wildgs.light.photos import encode_view
from wildgs.runs import load_run
from wildgs.scene import load_scene


def test_the_day_of_a_new_run_encodes_no_photo(
    landmark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    density = DensityConfig(max_gaussians=2000)
    config = RunConfig(landmark.resolve(), train=TrainConfig(steps=5, density=density))
    scene = load_scene(config.scene, config.data)
    trained = train(scene, config, output=tmp_path / "run")
    loaded = LoadedScene(load_run(tmp_path / "run"), trained.appearances)
    view = scene.train_views[2]
    expected = encode_view(loaded.run.method, view)
    monkeypatch.setattr(photos, "encode_view", lambda *_: pytest.fail("encoded again"))
    found = loaded.encode(view)
    for name in ("global_embedding", "visibility", "color_map", "basis_weights", "sky_profile"):
        # Sums of other threads are rounded differently.
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-4, atol=1e-4)
    assert set(find_day(loaded).phases) == {view.name for view in scene.train_views}
    assert loaded.appearance(view.name).embeddings.global_embedding is found.global_embedding
