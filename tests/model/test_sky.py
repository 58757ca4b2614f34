import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from wildgs.model.encoder import load_encoder
from wildgs.model.initial import sky_rows
from wildgs.model.parsing import ParsingConfig
from wildgs.model.sky import SkyConfig, shell_directions
from wildgs.model.wildgs import WildGS, WildGSConfig


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
