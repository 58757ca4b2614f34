"""The sky in directions that a photo does not show."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from wildgs.geometry.spherical_harmonics import C0, rgb_to_sh0
from wildgs.model.appearance import Embeddings, blend_embeddings, mean_embeddings
from wildgs.model.sky import shell_directions
from wildgs.model.sky_profile import complete_sky, fit_sky_profile

LOW, HIGH = torch.tensor([0.8, 0.5, 0.4]), torch.tensor([0.3, 0.3, 0.6])


def directions_around(azimuth: float, width: float, count: int = 900) -> torch.Tensor:
    """Directions within `width` degrees of an azimuth, from 2 to 30 degrees above the horizon."""
    generator = torch.Generator().manual_seed(0)
    turn = math.radians(azimuth) + math.radians(width) * (2 * torch.rand(count, generator=generator) - 1)
    up = torch.deg2rad(2 + 28 * torch.rand(count, generator=generator))
    return torch.stack([up.cos() * turn.cos(), up.cos() * turn.sin(), up.sin()], dim=1)


def graded(directions: torch.Tensor) -> torch.Tensor:
    """A sky that changes from `LOW` at the horizon to `HIGH` at 30 degrees."""
    return torch.lerp(LOW, HIGH, (directions[:, 2:] / 0.5).clamp(0, 1))


def painted(
    profile: torch.Tensor, directions: torch.Tensor, color: torch.Tensor | float = 0.1
) -> torch.Tensor:
    """Colours of a sky that the networks painted in one colour."""
    harmonics = torch.zeros(len(directions), 4, 3)
    harmonics[:, 0] = rgb_to_sh0(torch.as_tensor(color).expand(len(directions), 3))
    return 0.5 + C0 * complete_sky(harmonics, profile, directions)[:, 0]


@settings(deadline=None, max_examples=20)
@given(azimuth=st.floats(-180, 180), people=st.floats(0, 0.04), many=st.floats(0.04, 0.25))
def test_other_directions_take_the_colours_of_the_photo(azimuth: float, people: float, many: float) -> None:
    """Few dark pixels in front of the sky do not matter; many of them do not change what is right already."""
    seen = directions_around(azimuth, 25)
    behind = directions_around(azimuth + 180, 80)
    behind = behind[behind[:, 2] > 0.2]
    for share, predicted in ((people, torch.tensor(0.1)), (many, graded(behind))):
        colors = graded(seen)
        colors[: round(share * len(colors))] = 0.0
        profile = fit_sky_profile(colors, seen)
        assert profile is not None
        found = painted(profile, behind, predicted)
        torch.testing.assert_close(found, graded(behind), atol=0.04, rtol=0)


BLUE, CLOUD, PINK = (
    torch.tensor([0.3, 0.5, 0.9]),
    torch.tensor([0.9, 0.9, 0.95]),
    torch.tensor([0.9, 0.6, 0.7]),
)


@settings(deadline=None, max_examples=20)
@given(azimuth=st.floats(-180, 180), clouds=st.floats(0.15, 0.85), share=st.floats(0.1, 0.9))
def test_a_cloudy_sky_may_be_blue_or_white_elsewhere(azimuth: float, clouds: float, share: float) -> None:
    """What networks predict between the colours that the photo shows is kept, and no other hue."""
    seen = directions_around(azimuth, 25)
    cloudy = torch.rand(len(seen), generator=torch.Generator().manual_seed(1)) < clouds
    profile = fit_sky_profile(torch.where(cloudy[:, None], CLOUD, BLUE), seen)
    assert profile is not None
    behind = directions_around(azimuth + 180, 60)
    behind = behind[behind[:, 2] > 0.2]
    between = torch.lerp(BLUE, CLOUD, share)
    torch.testing.assert_close(
        painted(profile, behind, between), between.expand(len(behind), 3), atol=0.08, rtol=0
    )
    line = functional.normalize(CLOUD - BLUE, dim=0)
    found = painted(profile, behind, PINK) - BLUE
    away = found - (found @ line)[:, None] * line
    assert float(away.norm(dim=1).max()) < 0.05, "pink is moved onto the line from blue to white"


def test_shown_directions_and_the_ground_stay_as_predicted() -> None:
    seen = directions_around(40, 25)
    profile = fit_sky_profile(graded(seen), seen)
    assert profile is not None
    predicted = torch.full_like(seen, 0.1)
    torch.testing.assert_close(painted(profile, seen), predicted)
    below = shell_directions(2000, -90.0)
    below = below[below[:, 2] < 0]
    torch.testing.assert_close(painted(profile, below), torch.full_like(below, 0.1))


def test_elevations_that_are_not_shown_are_not_extrapolated() -> None:
    seen = directions_around(0, 25)
    profile = fit_sky_profile(graded(seen), seen)
    assert profile is not None
    top = functional.normalize(torch.tensor([[-1.0, 0.1, 3.0]]), dim=1)
    torch.testing.assert_close(painted(profile, top)[0], HIGH, atol=0.05, rtol=0)


def test_the_transition_is_smooth() -> None:
    seen = directions_around(0, 25)
    profile = fit_sky_profile(graded(seen), seen)
    assert profile is not None
    turn = torch.deg2rad(torch.linspace(0, 180, 721))
    around = torch.stack([turn.cos(), turn.sin(), torch.full_like(turn, 0.3)], dim=1)
    colors = painted(profile, functional.normalize(around, dim=1))
    assert float(colors.diff(dim=0).abs().max()) < 0.01
    assert float((colors[-1] - colors[0]).abs().max()) > 0.2


@pytest.mark.parametrize("elevation", [-20.0, 30.0])
def test_without_sky_there_is_no_profile(elevation: float) -> None:
    """Seen from above, distant ground has the depth of the sky."""
    count = 1000 if elevation < 0 else 20
    up = math.radians(elevation)
    directions = torch.tensor([[math.cos(up), 0.0, math.sin(up)]]).expand(count, 3)
    assert fit_sky_profile(torch.full((count, 3), 0.4), directions) is None


def test_a_mix_has_the_sky_of_those_that_have_one() -> None:
    seen = directions_around(0, 25)
    profile = fit_sky_profile(graded(seen), seen)
    parts = [Embeddings(torch.zeros(2), sky_profile=profile), Embeddings(torch.ones(2))]
    for weights in ([0.5, 0.5], [0.1, 0.9], [1.0, 0.0]):
        mixed = blend_embeddings(parts, weights).sky_profile
        assert mixed is not None
        assert profile is not None
        torch.testing.assert_close(mixed, profile)
    assert blend_embeddings(parts, [0.0, 1.0]).sky_profile is None
    neutral = mean_embeddings(parts, 2)
    assert neutral.sky_profile is not None
    assert neutral.response is None
