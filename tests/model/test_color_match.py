"""Colours matched to a photo: exact where the photo is an affine map of the scene, and hard to fool."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.spherical_harmonics import C0
from wildgs.model.color_match import (
    LEAST_PIXELS,
    SKY_COLUMNS,
    changed_harmonics,
    elevation_powers,
    mapped,
    match_photo,
)
from wildgs.model.sky import Sky
from wildgs.rasterize import Rendering


def match_colors(
    render: torch.Tensor,
    photo: torch.Tensor,
    weights: torch.Tensor,
    training: bool = False,
    codes: torch.Tensor | None = None,
    sky: Sky | None = None,
) -> torch.Tensor:
    """The match where the mask is these weights."""
    picture = Rendering(render, torch.ones_like(weights), torch.ones_like(weights))
    codes = render[..., :0] if codes is None else codes
    return match_photo(photo, picture, weights, None, threshold=0.0, sky=sky, codes=codes, training=training)


def match_sky(
    render: torch.Tensor, photo: torch.Tensor, sine: torch.Tensor, training: bool = False
) -> torch.Tensor:
    """The match of a picture that is all sky."""
    sky = Sky(torch.ones_like(sine, dtype=torch.bool), sine)
    found = match_colors(render, photo, torch.ones_like(sine), training, sky=sky)
    assert not found[:, :4].any()
    return found[:, 4:]


def changed(colors: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    return colors + colors @ change[:, :3].T + change[:, 3]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_finds_the_map_that_made_the_photo(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    render = torch.rand(24, 30, 3, generator=generator)
    change = 0.2 * (torch.rand(3, 4, generator=generator) - 0.5)
    photo = changed(render, change)
    found = match_colors(render, photo, torch.ones(24, 30))
    torch.testing.assert_close(changed(render, found), photo, atol=0.01, rtol=0)


def changed_colors(
    colors: torch.Tensor, change: torch.Tensor, sky: Sky | None, codes: torch.Tensor
) -> torch.Tensor:
    """A picture's colours changed pixel by pixel."""
    own, by_code, of_sky, by_elevation = change.tensor_split(
        (4, 4 + codes.shape[-1], 8 + codes.shape[-1]), dim=1
    )
    below = changed(colors, own) + codes @ by_code.T
    if sky is None:
        return below
    above = changed(colors, of_sky) + elevation_powers(sky.sine) @ by_elevation.T
    return torch.where(sky.which[..., None], above, below)


def test_weights_of_zero_are_not_looked_at() -> None:
    render = torch.rand(24, 30, 3, generator=torch.Generator().manual_seed(0))
    photo, weights = 0.8 * render, torch.ones(24, 30)
    expected = match_colors(render[:, :15], photo[:, :15], weights[:, :15])
    photo[:, 15:], weights[:, 15:] = torch.nan, 0
    torch.testing.assert_close(match_colors(render, photo, weights), expected)


def test_passers_by_that_the_mask_missed_count_little() -> None:
    render = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    photo = 0.9 * render
    photo[25:, 25:] = torch.tensor([1.0, 0.0, 1.0])
    found = changed(render, match_colors(render, photo, torch.ones(40, 40)))
    assert float((found - 0.9 * render)[:25].abs().max()) < 0.03


@pytest.mark.parametrize("colors", [torch.zeros(20, 20, 3), torch.full((20, 20, 3), 1.7)])
def test_one_colour_says_little_and_breaks_nothing(colors: torch.Tensor) -> None:
    photo = torch.full_like(colors, 0.4)
    found = match_colors(colors, photo, torch.ones(20, 20))
    torch.testing.assert_close(changed(colors.clamp(0, 1), found), photo, atol=0.01, rtol=0)
    assert float(found.abs().max()) < 1


def test_too_few_pixels_and_no_numbers_change_nothing() -> None:
    render, photo = torch.rand(20, 20, 3), torch.rand(20, 20, 3)
    weights = torch.zeros(20, 20)
    weights.view(-1)[: LEAST_PIXELS - 1] = 1
    assert not match_colors(render, photo, weights).any()
    assert not match_colors(torch.full_like(render, torch.nan), photo, torch.ones(20, 20)).any()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_skys_map_may_vary_with_the_elevation(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    render = torch.rand(24, 30, 3, generator=generator)
    sine = torch.linspace(0.8, 0.0, 24)[:, None].expand(24, 30)
    change = 0.2 * (torch.rand(3, SKY_COLUMNS, generator=generator) - 0.5)
    photo = changed(render, change[:, :4]) + elevation_powers(sine) @ change[:, 4:].T
    found = match_sky(render, photo, sine)
    matched = changed(render, found[:, :4]) + elevation_powers(sine) @ found[:, 4:].T
    torch.testing.assert_close(matched, photo, atol=0.03, rtol=0)


def test_mapped_harmonics_are_those_of_mapped_colours() -> None:
    harmonics, change = torch.randn(50, 4, 3), 0.3 * torch.randn(3, 4)
    basis, offset = torch.randn(4), 0.1 * torch.randn(50, 3)
    basis[0] = C0
    colors = torch.einsum("k, vkc -> vc", basis, harmonics) + 0.5
    found = torch.einsum("k, vkc -> vc", basis, mapped(harmonics, change, offset)) + 0.5
    torch.testing.assert_close(found, changed(colors, change) + offset)


def test_changed_colors_are_those_of_changed_harmonics() -> None:
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(24, 30, 3, generator=generator)
    codes = torch.rand(24, 30, 2, generator=generator)
    sine = torch.linspace(0.8, 0.0, 24)[:, None].expand(24, 30)
    sky = Sky(sine > 0.4, sine)
    change = 0.2 * (torch.rand(3, 6 + SKY_COLUMNS, generator=generator) - 0.5)
    flat = ((colors - 0.5) / C0).reshape(-1, 1, 3)
    rows = Sky(sky.which.reshape(-1), sky.sine.reshape(-1))
    for of_picture, of_rows in ((sky, rows), (None, None)):
        harmonics = changed_harmonics(flat, change, of_rows, codes.reshape(-1, 2))
        expected = (C0 * harmonics + 0.5).reshape(colors.shape)
        torch.testing.assert_close(changed_colors(colors, change, of_picture, codes), expected)
    expected = changed(colors, change[:, :4]) + codes @ change[:, 4:6].T
    torch.testing.assert_close(changed_colors(colors, change, None, codes), expected)


def test_light_that_follows_the_codes_is_found() -> None:
    """Sun on one side of the scene, shade on the other: the codes say which side is which."""
    generator = torch.Generator().manual_seed(0)
    render, codes = torch.rand(24, 30, 3, generator=generator), torch.zeros(24, 30, 1)
    codes[:, :15] = 1
    photo = 0.8 * render + 0.15 * codes
    for training in (False, True):
        found = match_colors(render, photo, torch.ones(24, 30), training, codes)
        torch.testing.assert_close(changed_colors(render, found, None, codes), photo, atol=0.01, rtol=0)


def test_codes_are_shrunk_more_in_training() -> None:
    """Three times the ridge: what faint codes seem to explain may be passers-by."""
    generator = torch.Generator().manual_seed(0)
    render = torch.rand(40, 50, 3, generator=generator)
    codes = 0.02 * torch.randn(40, 50, 1, generator=generator)
    photo = render + 0.5 * codes
    kept = [
        float(match_colors(render, photo, torch.ones(40, 50), training, codes)[0, 4]) / 0.5
        for training in (False, True)
    ]
    variance = 0.02**2
    assert kept[0] == pytest.approx(variance / (variance + 3e-4), abs=0.05)
    assert kept[1] == pytest.approx(variance / (variance + 9e-4), abs=0.05)


def test_in_training_channels_do_not_mix() -> None:
    """However little a render's hue says about the photo's, the match must not take it away."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(24, 30, 1, generator=generator)
    render = grey + 0.05 * torch.randn(24, 30, 3, generator=generator)
    photo = torch.tensor([0.8, 1.0, 0.6]) * grey.expand(24, 30, 3) + 0.1
    weights, sine = torch.ones(24, 30), torch.linspace(0.8, 0.0, 24)[:, None].expand(24, 30)
    for found in (match_colors(render, photo, weights, True), match_sky(render, photo, sine, True)):
        off_diagonal = ~torch.eye(3, dtype=torch.bool)
        assert not found[:, :3][off_diagonal].any()
        assert float((changed(render, found[:, :4]) - photo).abs().mean()) < 0.06
    free = match_colors(render, photo, weights)
    hue = torch.tensor([1.0, -1.0, 0.0])
    kept = (hue + free[:, :3] @ hue).norm() / hue.norm()
    assert float(kept) < 0.5, "the full map does take it away"


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("codes", [0, 1, 5])
def test_landmark_and_sky_are_matched_as_each_alone(training: bool, codes: int) -> None:
    """They are solved together, with terms that the other has not."""
    generator = torch.Generator().manual_seed(0)
    render = torch.rand(24, 30, 3, generator=generator)
    photo = torch.rand(24, 30, 3, generator=generator)
    light = torch.rand(24, 30, codes, generator=generator)
    sine = torch.linspace(0.8, 0.0, 24)[:, None].expand(24, 30)
    which = sine > 0.4
    found = match_colors(render, photo, torch.ones(24, 30), training, light, Sky(which, sine))
    own = match_colors(render, photo, (~which).float(), training, light)
    above = match_sky(render[:12], photo[:12], sine[:12], training)
    torch.testing.assert_close(found, torch.cat([own, above], dim=1), atol=1e-6, rtol=1e-5)
    assert int(which.sum()) == 12 * 30


def test_ground_in_the_distance_does_not_colour_the_sky() -> None:
    """A photo from above, whose distant pixels are dark green, is no reason for a dark green sky."""
    render = 0.6 + 0.05 * torch.rand(24, 30, 3, generator=torch.Generator().manual_seed(0))
    sine = torch.linspace(-0.2, -0.9, 24)[:, None].expand(24, 30)
    photo = torch.tensor([0.1, 0.25, 0.1]).expand(24, 30, 3)
    found = match_sky(render, photo, sine)

    def matched(elevation: float) -> torch.Tensor:
        colors, sines = torch.full((1, 1, 3), 0.62), torch.full((1, 1), elevation)
        return (changed(colors, found[:, :4]) + elevation_powers(sines) @ found[:, 4:].T)[0, 0]

    assert float((matched(-0.5) - photo[0, 0]).abs().max()) < 0.1
    assert float((matched(0.6) - 0.62).abs().max()) < 0.65 * float((matched(-0.5) - 0.62).abs().max())


def test_the_sky_that_a_photo_does_not_show_follows_the_one_it_shows() -> None:
    """A hue that changes within a strip of sky says little about the zenith: extrapolated, it would be pink."""
    generator = torch.Generator().manual_seed(0)
    render = torch.tensor([0.5, 0.6, 0.7]) + 0.02 * torch.randn(24, 30, 3, generator=generator)
    sine = torch.linspace(0.45, 0.3, 24)[:, None].expand(24, 30)
    photo = render + 0.1 + (sine - 0.375)[..., None] * torch.tensor([1.0, -1.0, 0.0])
    found = match_sky(render, photo, sine)

    def matched(color: torch.Tensor, elevation: float) -> torch.Tensor:
        offset = elevation_powers(torch.full((1, 1), elevation)) @ found[:, 4:].T
        return (changed(color[None, None], found[:, :4]) + offset)[0, 0]

    shown = torch.tensor([0.5, 0.6, 0.7])
    assert float((matched(shown, 0.375) - shown - 0.1).abs().max()) < 0.03
    assert float((matched(shown, 0.8) - shown).abs().max()) < 0.3
