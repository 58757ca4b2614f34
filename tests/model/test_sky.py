import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import C0
from wildgs.model.encoder import load_encoder
from wildgs.model.initial import sky_rows
from wildgs.model.parsing import ParsingConfig
from wildgs.model.sky import SkyConfig, shell_directions
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.model.wrapping import WrappingConfig


@settings(deadline=None)
@given(count=st.integers(8, 400), lowest=st.floats(-90, 60))
def test_directions_are_units_above_the_lowest_elevation(count: int, lowest: float) -> None:
    directions = shell_directions(count, lowest)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(count), atol=1e-5, rtol=0)
    assert float(directions[:, 2].min()) > math.sin(math.radians(lowest)) - 1e-5


def test_directions_are_even() -> None:
    """No direction is much further from its nearest neighbour than any other."""
    directions = shell_directions(1000, -10.0)
    nearest = torch.cdist(directions, directions).fill_diagonal_(9).min(dim=1).values
    assert float(nearest.max() / nearest.min()) < 3


def test_shell_lies_beyond_the_points() -> None:
    torch.manual_seed(0)
    points = torch.randn(500, 3) * 20 + torch.tensor([100.0, 0, 0])
    rows = sky_rows(SkyConfig(points=200), points)
    distances = (rows["means"] - points.median(dim=0).values).norm(dim=1)
    assert float(distances.min()) > float((points - points.median(dim=0).values).norm(dim=1).quantile(0.98))
    assert {name: len(values) for name, values in rows.items()} == dict.fromkeys(rows, 200)


def test_no_camera_is_outside_the_shell() -> None:
    """A photo from far away, with a long lens, would show the sky in front of the scene."""
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    far = torch.tensor([[0.0, -20.0, 1.0], [1.0, 0.0, 0.0]])
    distances = sky_rows(SkyConfig(points=200), points, far)["means"].norm(dim=1)
    assert float(distances.min()) > 25
    wrong = torch.tensor([[0.0, -1e6, 1.0]])
    assert float(sky_rows(SkyConfig(points=200), points, wrong)["means"].norm(dim=1).max()) < 110
    near = far[1:]
    assert torch.equal(
        sky_rows(SkyConfig(points=200), points, near)["means"],
        sky_rows(SkyConfig(points=200), points)["means"],
    )


def test_sky_covers_what_a_camera_sees_above_the_horizon() -> None:
    """Neighbours overlap: no direction of the sky is further than two standard deviations from a Gaussian."""
    rows = sky_rows(SkyConfig(), torch.zeros(10, 3))
    probes = 10 * shell_directions(333, 0.0)
    distance, nearest = torch.cdist(probes, rows["means"]).min(dim=1)
    assert bool((distance < 2 * rows["log_scales"].exp()[nearest, 0]).all())


def test_models_start_with_a_sky_unless_told_otherwise() -> None:
    points, colors = torch.rand(30, 3), torch.full((30, 3), 128, dtype=torch.uint8)
    parsing = ParsingConfig(max_side=32)
    with_sky = WildGS.from_points(
        WildGSConfig(parsing=parsing, sky=SkyConfig(points=50)), points, colors, encoder=load_encoder(None)
    )
    bare = WildGS.from_points(
        WildGSConfig(parsing=parsing, sky=SkyConfig(points=0)), points, colors, encoder=load_encoder(None)
    )
    assert (len(with_sky.gaussians), len(bare.gaussians)) == (80, 30)
    torch.testing.assert_close(with_sky.wrapping.low, bare.wrapping.low)


GREY, BLUE, PINK = torch.full((3,), 0.45), torch.tensor([0.1, 0.3, 0.9]), torch.tensor([0.9, 0.6, 0.5])


@pytest.fixture
def tower() -> tuple[WildGS, Camera]:
    """A grey tower before a sky, and a camera that sees half of each."""
    torch.manual_seed(0)
    x, z = torch.meshgrid(torch.linspace(-0.5, 0.5, 30), torch.linspace(-1, 1, 60), indexing="ij")
    points = torch.stack([x, torch.full_like(x, 1.0), z], dim=-1).reshape(-1, 3)
    config = WildGSConfig(
        eps2d=0.3,  # Gaussians a pixel apart, which are not trained, would let the sky through with less
        parsing=ParsingConfig(max_side=64),
        wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8), crop_ratio=1.0),
        sky=SkyConfig(points=3000),
    )
    model = WildGS.from_points(config, points, torch.full((1800, 3), 128, dtype=torch.uint8))
    with torch.no_grad():
        model.gaussians.rows["opacity_logits"].fill_(4.0)
    viewmat = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 1.0], [0, 0, 0, 1.0]])
    K = torch.tensor([[60.0, 0, 30.0], [0, 60.0, 20.0], [0, 0, 1.0]])
    return model, Camera(viewmat, K, 60, 40)


def photo_before(camera: Camera, landmark: torch.Tensor, sky: torch.Tensor) -> torch.Tensor:
    photo = sky.expand(camera.height, camera.width, 3).clone()
    photo[:, 15:45] = landmark + 0.05 * torch.rand(40, 30, 1, generator=torch.Generator().manual_seed(0))
    return photo


def test_the_landmark_keeps_its_colour_under_any_sky(tower: tuple[WildGS, Camera]) -> None:
    """The match of the landmark reads its own pixels; that of the sky reads the sky's."""
    model, camera = tower
    renders = []
    with torch.no_grad():
        for sky in (BLUE, PINK):
            photo = photo_before(camera, GREY, sky)
            renders.append(model.render(camera, model.shade(model.encode(photo, camera))))
            torch.testing.assert_close(renders[-1].colors[:, :12], photo[:, :12], atol=0.05, rtol=0)
    first, second = renders
    torch.testing.assert_close(first.colors[5:35, 20:40], second.colors[5:35, 20:40], atol=0.04, rtol=0)
    assert torch.equal(first.depth, second.depth)
    assert torch.equal(first.alpha, second.alpha)


def test_the_sky_does_not_grow_unless_configured(tower: tuple[WildGS, Camera]) -> None:
    model, _ = tower
    growable = model.growable()
    assert growable is not None
    assert torch.equal(growable, torch.arange(len(growable)) < 1800)
    model.config = replace(model.config, sky=replace(model.config.sky, densify=True))
    assert model.growable() is None


@pytest.mark.parametrize("complete", [True, False])
def test_behind_the_camera_the_sky_is_that_of_the_photo(complete: bool, tower: tuple[WildGS, Camera]) -> None:
    model, camera = tower
    model.config = replace(model.config, sky=replace(model.config.sky, complete=complete))
    sky = model.sky()
    assert sky is not None
    with torch.no_grad():
        for color in (BLUE, PINK):
            harmonics = model.shade(model.encode(photo_before(camera, GREY, color), camera))
            towards = model.gaussians.means - camera.position
            behind = sky & (towards[:, 1] < -0.5 * towards.norm(dim=1)) & (towards[:, 2] > 2.0)
            found = 0.5 + C0 * harmonics[behind, 0]
            agrees = bool(((found - color).abs().amax(dim=1) < 0.05).all())
            assert agrees or not complete
    look = model.encode(photo_before(camera, GREY, BLUE), camera)
    assert (look.sky_profile is not None) == complete
