"""A slanted wall before a farther one, seen by six cameras in different light; a passer-by and a blank sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.memory_views import make_view, with_photos
from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.priors.config import StereoConfig
from wildgs.priors.stereo.depth import fill_metric_folder, stereo_depth
from wildgs.priors.stereo.neighbours import choose_neighbours
from wildgs.scene import Alignment, DataConfig, Scene, load_scene
from wildgs.scene.residuals import Residuals
from wildgs.threads import limited

WIDTH, HEIGHT, FOCAL, SKY = 64, 48, 70.0, 8
PASSER_BY = (slice(20, 34), slice(24, 34))


def camera(index: int) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -0.28 * (index - 2.5)
    viewmat[1, 3] = 0.1 * (index % 2)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(viewmat, K, WIDTH, HEIGHT)


def true_depth(view: Camera) -> torch.Tensor:
    """Left, a wall with z = 2 + x / 2; right of x = 0.3, one at z = 2.6."""
    rays, position = view.pixel_rays(), view.position
    near = (2 + position[0] / 2 - position[2]) / (rays[..., 2] - rays[..., 0] / 2)
    far = (2.6 - position[2]) / rays[..., 2]
    return torch.where(position[0] + near * rays[..., 0] < 0.3, near, far)


def texture(points: np.ndarray) -> np.ndarray:
    """Blots of several sizes, by position."""
    waves = np.random.default_rng(3).normal(size=(40, 3)) * 9
    shifts = np.random.default_rng(4).uniform(0, 2 * np.pi, 40)
    return 0.5 + 0.35 * np.tanh(np.cos(points @ waves.T + shifts).sum(axis=-1) / 5)


def photo(index: int) -> torch.Tensor:
    rng = np.random.default_rng(index)
    value = texture(camera(index).unproject(true_depth(camera(index))).numpy())
    value = rng.uniform(0.5, 1.0) * value + rng.uniform(0.0, 0.1)
    value[:SKY] = 0.9
    if index == 2:
        value[PASSER_BY] = rng.uniform(size=value[PASSER_BY].shape)
    return torch.from_numpy((value[..., None] * [255, 250, 240]).clip(0, 255).astype(np.uint8))


def scene(mask: torch.Tensor | None = None) -> Scene:
    views = [
        make_view(
            f"{i}.png", camera(i), "test" if i == 5 else "train", photo(i), mask=mask if i == 3 else None
        )
        for i in range(6)
    ]
    seen = camera(2).unproject(true_depth(camera(2)))[SKY + 4 :: 8, 2::8].reshape(-1, 3)
    observations = torch.cartesian_prod(torch.arange(6), torch.arange(len(seen))).int()
    colors = torch.zeros(len(seen), 3, dtype=torch.uint8)
    return Scene(Path("walls"), tuple(views), seen, colors, Alignment.identity(), observations)


@pytest.fixture(scope="module")
def depths() -> dict[str, np.ndarray]:
    return stereo_depth(scene(), StereoConfig())


def test_depth_is_right_where_it_is_known(depths: dict[str, np.ndarray]) -> None:
    assert sorted(depths) == [f"{index}.png" for index in range(5)]  # the sixth photo tests
    for index in range(1, 4):
        found, truth = depths[f"{index}.png"], true_depth(camera(index)).numpy()
        known = found[SKY + 4 :] > 0
        error = np.abs(found / truth - 1)[SKY + 4 :][known]
        assert known.mean() > 0.4
        assert (error < 0.02).mean() > 0.85


def test_photos_are_displaced_to_where_residuals_show_them() -> None:
    """Every second photo is a pixel off to the right."""
    whole = scene()
    views = [
        view if row % 2 == 0 else with_photos(view, pixels=np.roll(view.read_photo().numpy(), 1, axis=1))
        for row, view in enumerate(whole.views)
    ]
    places = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1, HEIGHT / WIDTH]
    )
    residuals = {
        view.name: Residuals(places, torch.tensor([(row % 2) / WIDTH, 0]).expand(200, 2))
        for row, view in enumerate(views)
    }

    def median_error(residuals: dict[str, Residuals]) -> float:
        found = stereo_depth(replace(whole, views=tuple(views), residuals=residuals), StereoConfig())
        errors = [np.abs(found[f"{row}.png"] / true_depth(camera(row)).numpy() - 1) for row in (1, 2, 3)]
        return float(np.median(np.concatenate([error[SKY + 4 :][error[SKY + 4 :] < 1] for error in errors])))

    assert median_error(residuals) < 0.006
    assert median_error({}) > 0.01


def test_sky_and_passers_by_have_no_depth(depths: dict[str, np.ndarray]) -> None:
    assert all((found[: SKY - 3] == 0).all() for found in depths.values())
    inner = depths["2.png"][22:32, 26:32]
    assert (inner > 0).mean() < 0.2


def test_it_does_not_depend_on_threads_nor_on_photos_that_test(depths: dict[str, np.ndarray]) -> None:
    changed = scene()
    views = (*changed.views[:5], make_view("5.png", camera(5), "test", 255 - photo(5)))
    with limited(2):
        again = stereo_depth(replace(changed, views=views), StereoConfig())
    assert all((depths[name] == again[name]).all() for name in depths)


def test_what_the_user_masks_has_no_depth() -> None:
    mask = torch.full((HEIGHT, WIDTH), 255, dtype=torch.uint8)
    mask[:, :20] = 0
    found = stereo_depth(scene(mask), StereoConfig(max_side=64))["3.png"]
    assert (found[:, :20] == 0).all()
    assert (found[SKY + 4 :, 20:] > 0).mean() > 0.3


def test_neighbours_are_the_photos_that_see_the_same_points_from_elsewhere() -> None:
    neighbours = choose_neighbours(scene(), 2)
    assert set(neighbours[0]) <= {1, 2, 3}
    assert all(index not in others and 5 not in others for index, others in enumerate(neighbours))


def test_photos_that_share_nothing_have_no_depth() -> None:
    whole = scene()
    alone = Scene(whole.root, whole.views[:1], whole.points, whole.point_colors, whole.alignment)
    found = stereo_depth(alone, StereoConfig())
    assert (found["0.png"] == 0).all()


def write_walls(make_scene, **model: object) -> Path:
    """The walls as a COLMAP scene whose frame is turned, shifted and four times as large."""
    turn = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    poses = []
    for index in range(6):
        pose = camera(index).viewmat[:3].double().clone()
        pose[:, :3] = pose[:, :3] @ turn
        pose[:, 3] = 4 * pose[:, 3]
        poses.append(pose.numpy())
    root = make_scene(6, points=(4 * scene().points.double() @ turn).numpy(), poses=poses, **model)
    for index in range(6):
        Image.fromarray(photo(index).numpy()).save(root / f"images/p{index:02d}.png")
    return root


def test_files_hold_depth_in_units_of_the_model_and_are_read_in_those_of_the_scene(make_scene) -> None:
    pinhole = {"model": "PINHOLE", "width": WIDTH, "height": HEIGHT, "params": [FOCAL, FOCAL, 32, 24]}
    root = write_walls(make_scene, camera=pinhole)
    assert fill_metric_folder(root, StereoConfig(), holdout=6) == (5, 0)
    stored = np.array(Image.open(root / "depth/p02.tiff"))
    known = stored > 0
    assert known.mean() > 0.3
    assert np.median(np.abs(stored / (4 * true_depth(camera(2)).numpy()) - 1)[known]) < 0.01
    loaded = load_scene(root, DataConfig(holdout=6))
    depth = next(view for view in loaded.views if view.name == "p02.png").read_depth()
    assert depth is not None
    torch.testing.assert_close(depth, torch.from_numpy(stored) * loaded.alignment.scale)
    assert fill_metric_folder(root, StereoConfig(), holdout=6) == (0, 5)
    assert not (root / "depth/p00.tiff").exists()  # held out


@pytest.mark.parametrize(
    "wrong",
    [{"max_side": 10**6}, {"agreeing": 7}, {"max_cost": float("nan")}, {"tolerance": 0.0}, {"seed": -1}],
)
def test_options_with_which_nothing_agrees_are_refused(wrong: dict) -> None:
    (name,) = wrong
    with pytest.raises(UserError, match=f"--stereo.{name.replace('_', '-')} "):
        StereoConfig(**wrong)
