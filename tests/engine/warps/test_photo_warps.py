"""Training photos are displaced to where they fit their renders, and nothing else moves them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from tests.engine.test_photo_counts import differences_after_resuming
from tests.memory_views import with_photos
from wildgs.engine.checkpoint import save_checkpoint
from wildgs.engine.config import WarpConfig
from wildgs.engine.report import StepReport
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.engine.warps import PhotoWarps
from wildgs.engine.warps.registration import displacement
from wildgs.model.registry import MethodName, create_method
from wildgs.model.wildgs import WildGSConfig
from wildgs.priors.resampling import warp
from wildgs.scene import Scene
from wildgs.scene.residuals import Residuals

HEIGHT, WIDTH, CELLS = 96, 128, 8
CPU = torch.device("cpu")


def texture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Float[np.ndarray, "H W"]:
    """Smooth grey noise of a few pixels, larger than a photo by 20 pixels on each side."""
    noise = np.random.default_rng(seed).normal(size=(height + 40, width + 40))
    smooth = gaussian_filter(noise, 1.5)
    return (0.5 + 0.12 * smooth / smooth.std()).clip(0, 1)


def crop(picture: Float[np.ndarray, "H W"], x: float = 0.0, y: float = 0.0) -> Float[Tensor, "h w 3"]:
    """The inside of a picture, shifted by pixels: pixel p shows what the picture has at p plus the shift."""
    height, width = picture.shape[0] - 40, picture.shape[1] - 40
    rows, columns = np.mgrid[20 : 20 + height, 20 : 20 + width].astype(float)
    grey = map_coordinates(picture, [rows + y, columns + x], order=5).astype(np.float32)
    return torch.from_numpy(grey)[..., None].expand(-1, -1, 3).contiguous()


def constant(x: float, y: float, side: float = WIDTH) -> Float[Tensor, "2 G G"]:
    """A grid of the same displacement everywhere, from pixels."""
    return torch.tensor([x, y])[:, None, None].expand(2, CELLS, CELLS) / side


def inside(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
    return picture[4:-4, 4:-4]


@given(x=st.floats(-2.5, 2.5), y=st.floats(-2.5, 2.5))
@settings(max_examples=25, deadline=None)
def test_a_warped_photo_is_the_photo_sampled_at_displaced_pixels(x: float, y: float) -> None:
    picture = texture(0)
    warped = warp(crop(picture), constant(x, y))
    torch.testing.assert_close(inside(warped), inside(crop(picture, x, y)), atol=0.02, rtol=0)


def test_without_displacements_a_photo_stays_as_it_is() -> None:
    photo = crop(texture(1, 61, 90))
    torch.testing.assert_close(warp(photo, torch.zeros(2, 5, 5)), photo, atol=1e-5, rtol=0)


@given(
    x=st.floats(-0.8, 0.8),
    y=st.floats(-0.8, 0.8),
    gain=st.floats(0.3, 1.5),
    offset=st.floats(-0.1, 0.2),
)
@settings(max_examples=25, deadline=None)
def test_a_shift_is_found_under_any_light(x: float, y: float, gain: float, offset: float) -> None:
    picture = texture(2)
    grid = constant(0, 0)
    for _ in range(6):
        moved = warp(crop(picture), grid)
        grid = grid + displacement(moved, gain * crop(picture, x, y) + offset, CELLS)
    found = WIDTH * grid[:, 1:-1, 1:-1]
    torch.testing.assert_close(found, WIDTH * constant(x, y)[:, 1:-1, 1:-1], atol=0.06, rtol=0)


def test_halves_of_a_photo_may_move_apart() -> None:
    picture = texture(3)
    left, right = crop(picture, 0.5), crop(picture, -0.5)
    render = torch.cat([left[:, : WIDTH // 2], right[:, WIDTH // 2 :]], dim=1)
    found = WIDTH * displacement(crop(picture), render, CELLS)[0]
    assert found[:, :2].min() > 0.25
    assert found[:, -2:].max() < -0.25


def test_a_large_photo_is_registered_like_a_small_one() -> None:
    """An enlargement to 1,280 pixels has the same displacement relative to its side."""
    small, shifted = crop(texture(4, 240, 320)), crop(texture(4, 240, 320), 0.5)
    large = [
        torch.nn.functional.interpolate(picture.permute(2, 0, 1)[None], scale_factor=4, mode="bicubic")[
            0
        ].permute(1, 2, 0)
        for picture in (small, shifted)
    ]
    found = displacement(large[0], large[1], CELLS)[0, 1:-1, 1:-1] * 320
    assert found.median() == pytest.approx(0.5, abs=0.1)


def test_passers_by_move_nothing() -> None:
    picture = texture(5)
    render, photo = crop(picture), crop(picture).clone()
    photo[24:72, 32:64] = crop(texture(6))[24:72, 32:64]
    assert WIDTH * displacement(photo, render, CELLS).abs().max() < 0.15


@pytest.mark.parametrize("kind", ["flat", "not finite", "tiny"])
def test_nothing_to_register_moves_nothing(kind: str) -> None:
    photo = crop(texture(7)) if kind == "not finite" else torch.full((HEIGHT, WIDTH, 3), 0.5)
    render = torch.full_like(photo, torch.nan if kind == "not finite" else 0.4)
    if kind == "tiny":
        photo, render = photo[:1, :2], render[:1, :2]
    found = displacement(photo, render, CELLS)
    torch.testing.assert_close(found, torch.zeros(2, CELLS, CELLS))
    warp(photo, found)


def warps_of(
    scene: Scene,
    config: WarpConfig,
    *,
    used: bool = True,
    begin: int = 0,
    few: int = 7,
    residuals: Mapping[str, Residuals] | None = None,
) -> PhotoWarps:
    """Displaced by renders alone unless there are residuals."""
    config = replace(config, photos=few, residuals=residuals is not None)
    return PhotoWarps(scene.train_views, config, begin, CPU, residuals or {}, used=used)


def residuals_of(scene: Scene, x: float, noise: float = 0.0) -> dict[str, Residuals]:
    """Of photos that are all displaced by x pixels along the first axis."""
    torch.manual_seed(0)
    return {
        view.name: Residuals(torch.rand(200, 2), (torch.tensor([x, 0]) + noise * torch.randn(200, 2)) / WIDTH)
        for view in scene.train_views
    }


@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_photos_begin_where_residuals_show_them(wall_scene: Scene, rate: float) -> None:
    residuals = residuals_of(wall_scene, 0.4, noise=0.05)
    warps = warps_of(wall_scene, WarpConfig(rate=rate, cells=CELLS), begin=100, residuals=residuals)
    view, picture = wall_scene.train_views[0], texture(13)
    assert WIDTH * warps.grids[:, 0].mean() == pytest.approx(0.4, abs=0.05)
    assert WIDTH * warps.grids[:, 1].square().mean().sqrt() < 0.1
    warped = warps.warped(view, crop(picture))
    torch.testing.assert_close(inside(warped), inside(crop(picture, 0.4)), atol=0.05, rtol=0)


@pytest.mark.parametrize("few", [0, 100])
def test_photos_return_to_where_residuals_show_them(wall_scene: Scene, few: int) -> None:
    """A photo without texture has no place of its own; fewer photos than `photos` are not registered at all."""
    residuals = residuals_of(wall_scene, 0.4)
    warps = warps_of(wall_scene, WarpConfig(cells=CELLS), few=few, residuals=residuals)
    view, first = wall_scene.train_views[0], warps.grids.clone()
    for step in range(20):
        warps.update(view, warps.warped(view, crop(texture(14))), crop(texture(14), -0.4), step, Team())
    moved = WIDTH * (warps.grids[0, 0] - first[0, 0]).median()
    assert moved == pytest.approx(0 if few else -0.7, abs=0.05)
    flat = torch.full((HEIGHT, WIDTH, 3), 0.5)
    for step in range(30):
        warps.update(view, flat, flat, step, Team())
    torch.testing.assert_close(warps.grids, first)


def test_photos_without_common_residuals_stay_as_they_are(wall_scene: Scene) -> None:
    residuals = residuals_of(wall_scene, 0.0, noise=0.3)
    warps = warps_of(wall_scene, WarpConfig(cells=CELLS), residuals=residuals)
    photo = crop(texture(15))
    warps.update(wall_scene.train_views[0], photo, crop(texture(15), 0.5), 0, Team())
    assert not warps.is_used
    assert not warps.grids.any()
    assert warps.warped(wall_scene.train_views[0], photo) is photo


def test_displacements_approach_the_shift_and_decrease_where_the_photo_fits(wall_scene: Scene) -> None:
    warps = warps_of(wall_scene, WarpConfig(rate=0.5, friction=0.05, cells=CELLS))
    view, picture = wall_scene.train_views[2], texture(8)

    def visit(render: Float[Tensor, "H W 3"], times: int) -> float:
        for step in range(times):
            warps.update(view, warps.warped(view, crop(picture)), render, step, Team())
        return float(WIDTH * warps.grids[2, 0].median())

    # In equilibrium, half of what is left is as much as friction: 0.5 of 0.6 pixels are found.
    assert visit(crop(picture, 0.6), 20) == pytest.approx(0.5, abs=0.03)
    assert visit(warps.warped(view, crop(picture)), 1) == pytest.approx(0.45, abs=0.03)
    assert not warps.grids[[0, 1, 3]].any()


def test_less_than_friction_moves_nothing(wall_scene: Scene) -> None:
    warps, view = warps_of(wall_scene, WarpConfig(cells=CELLS, friction=0.05)), wall_scene.train_views[0]
    for step in range(10):
        warps.update(
            view, warps.warped(view, crop(texture(11))), crop(texture(11), 0.06, -0.06), step, Team()
        )
    assert not warps.grids.any()


def test_displacements_are_bounded(wall_scene: Scene) -> None:
    warps, view = warps_of(wall_scene, WarpConfig(cells=CELLS, most=0.002)), wall_scene.train_views[0]
    for step in range(8):
        warps.update(view, crop(texture(9)), crop(texture(9), 0.9, -0.9), step, Team())
    assert warps.grids[0].abs().max() == pytest.approx(0.002)
    assert warps.grids[0, 0].median() == pytest.approx(0.002)
    assert warps.grids[0, 1].median() == pytest.approx(-0.002)


@pytest.mark.parametrize("reason", ["another method", "rate 0", "first stage", "few photos"])
def test_photos_stay_as_they_are(wall_scene: Scene, reason: str) -> None:
    config = WarpConfig(rate=0.0 if reason == "rate 0" else 0.5, cells=CELLS)
    begin = 10 if reason == "first stage" else 0
    few, used = 8 if reason == "few photos" else 7, reason != "another method"
    warps, view = warps_of(wall_scene, config, used=used, begin=begin, few=few), wall_scene.train_views[0]
    photo = crop(texture(10))
    warps.update(view, photo, crop(texture(10), 0.5), 9, Team())
    assert not warps.grids.any()
    torch.testing.assert_close(warps.warped(view, photo), photo, atol=1e-5, rtol=0)
    warps.update(view, photo, crop(texture(10), 0.5), 10, Team())
    assert bool(warps.grids.any()) == (reason == "first stage")


def test_displacements_of_another_collection_are_not_taken(wall_scene: Scene) -> None:
    before = warps_of(wall_scene, WarpConfig(cells=CELLS))
    before.grids += 0.001
    fewer = replace(wall_scene, views=wall_scene.views[2:])
    for scene, config in ((fewer, WarpConfig(cells=CELLS)), (wall_scene, WarpConfig(cells=CELLS + 1))):
        after = warps_of(scene, config, few=0)
        after.restore(before.state())
        assert not after.grids.any()
    same = warps_of(wall_scene, WarpConfig(cells=CELLS))
    same.restore(before.state())
    assert torch.equal(same.grids, before.grids)


def trainer_for(scene: Scene, model: WildGSConfig, steps: int, name: MethodName = "wildgs") -> Trainer:
    torch.manual_seed(0)
    method = create_method(name, model if name == "wildgs" else None, scene)
    schedule = ScheduleConfig(densify_every=0)
    warp = WarpConfig(residuals=bool(scene.residuals), cells=4, most=0.05, photos=0)
    config = TrainConfig(steps=steps, precision="float32", schedule=schedule, warp=warp)
    return Trainer(method, scene, config)


@pytest.mark.parametrize("measured", [False, True])
def test_a_resumed_run_ends_in_the_same_bits(
    wall_scene: Scene, tiny_model: WildGSConfig, tmp_path: Path, measured: bool
) -> None:
    if measured:
        wall_scene = replace(wall_scene, residuals=residuals_of(wall_scene, 0.4))
    whole = trainer_for(wall_scene, tiny_model, 24)

    def save(report: StepReport) -> None:
        if report.step == 15:
            assert whole.warps.grids.any()
            save_checkpoint(tmp_path, 15, whole.state(), {})

    whole.run([save])
    assert differences_after_resuming(whole, tmp_path, wall_scene, tiny_model) == []


def test_all_ranks_begin_with_the_same_displacements(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    """Those of rank 0, since other ranks may have another library of linear algebra."""
    shared: list[Tensor] = []

    class FirstRank(Team):
        def share(self, tensors: Iterable[Tensor]) -> None:
            shared.extend(tensors)

    trainer = trainer_for(replace(wall_scene, residuals=residuals_of(wall_scene, 0.4)), tiny_model, 2)
    trainer.team = FirstRank()
    trainer.begin()
    trainer.end()
    assert trainer.warps.grids.any()
    assert sum(any(tensor is other for other in shared) for tensor in trainer.warps.tensors()) == 2


def test_baselines_train_on_photos_as_they_are(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    trainer = trainer_for(wall_scene, tiny_model, 12, "3dgs")
    trainer.run()
    assert not trainer.warps.is_used
    assert not any(name.startswith("warps.") for name in trainer.state())


def test_training_finds_the_photo_that_is_not_where_its_camera_says(
    wall_scene: Scene, tiny_model: WildGSConfig
) -> None:
    """The second photo is a pixel off to the left."""
    views = list(wall_scene.views)
    photo = views[1].read_photo()
    views[1] = with_photos(views[1], pixels=torch.cat([photo[:, 1:], photo[:, -1:]], dim=1).numpy())
    trainer = trainer_for(replace(wall_scene, views=tuple(views)), tiny_model, 100)
    trainer.run()
    across = 32 * trainer.warps.grids[:, 0].mean(dim=(1, 2))
    assert across[1] < -0.3
    assert across[[0, 2, 3, 4, 5, 6]].abs().max() < 0.6 * across[1].abs()
