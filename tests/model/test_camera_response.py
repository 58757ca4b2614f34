"""The camera's response: found where it made the photo, the identity where nothing asks for it, monotone always."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.camera import Camera
from wildgs.model.camera_response import (
    LEAST_PIXELS,
    RESPONSE_SIZE,
    fit_response,
    responded,
    squared_radius,
)
from wildgs.model.config import CameraResponseConfig
from wildgs.model.training_pass import Stage
from wildgs.model.wildgs import WildGS

BOTH = CameraResponseConfig(vignetting=True, curve=True)
DARK_CORNERS = torch.tensor([-0.3, -0.1] + [0.0] * 6)


def wide_camera(width: int = 60, height: int = 40) -> Camera:
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, width, height)


def colors_of(camera: Camera, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(camera.height, camera.width, 3, generator=generator) * 0.9


def test_radius_is_0_at_the_centre_and_1_in_the_corner_also_of_the_left_half() -> None:
    camera = wide_camera()
    radius = squared_radius(camera)
    assert float(radius.min()) < 0.01
    assert 0.9 < float(radius[0, 0]) < 1
    torch.testing.assert_close(radius, radius.flip(0).flip(1))
    torch.testing.assert_close(squared_radius(camera.cropped(0, 0, 30, 40)), radius[:, :30])


def test_the_zero_response_is_the_identity_for_all_colours() -> None:
    camera = wide_camera()
    colors = 3 * colors_of(camera) - 1
    assert torch.equal(responded(colors, squared_radius(camera), torch.zeros(RESPONSE_SIZE)), colors)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_response_that_made_a_photo_is_found_in_spite_of_passers_by(seed: int) -> None:
    camera, generator = wide_camera(), torch.Generator().manual_seed(seed)
    render, radius = colors_of(camera, seed), squared_radius(camera)
    response = 0.4 * (torch.rand(RESPONSE_SIZE, generator=generator) - 0.5)
    photo = responded(render, radius, response)
    photo[:6, :6] = 1.0
    photo[30:, 40:] = torch.nan
    weights = torch.ones(40, 60)
    weights[30:, 40:] = 0
    found = fit_response(BOTH, render, photo, radius, weights)
    error = (responded(render, radius, found) - responded(render, radius, response)).abs()
    assert error.mean() < 0.002  # the worst of all 10,001 seeds has 0.0014
    assert error.max() < 0.03  # and 0.022, in a corner


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), width=st.integers(1, 90), height=st.integers(1, 60))
def test_values_and_gradient_are_those_of_the_formula(seed: int, width: int, height: int) -> None:
    """Against automatic differentiation in double precision, also beyond [0, 1] and at sizes of any remainder."""
    generator, camera = torch.Generator().manual_seed(seed), wide_camera(width, height)
    radius, response = squared_radius(camera), 0.5 * (torch.rand(RESPONSE_SIZE, generator=generator) - 0.5)
    colors = (3 * colors_of(camera, seed) - 1).requires_grad_()
    pull = torch.rand(height, width, 3, generator=generator)
    shown = responded(colors, radius, response)
    (shown * pull).sum().backward()

    precise = colors.detach().double().requires_grad_()
    r, gain, curve = radius.double()[..., None], response[:2].double(), response[2:].double().reshape(3, 2)
    exposed = precise * (1 + gain[0] * r + gain[1] * r**2)
    x = exposed.clamp(0, 1)
    expected = exposed + curve[:, 0] * x * (1 - x) + curve[:, 1] * x * (1 - x) * (1 - 2 * x)
    (expected * pull).sum().backward()
    torch.testing.assert_close(shown.double(), expected, atol=1e-5, rtol=1e-5)
    assert colors.grad is not None
    assert precise.grad is not None
    torch.testing.assert_close(colors.grad.double(), precise.grad, atol=1e-5, rtol=1e-4)


def test_what_is_off_is_not_fitted() -> None:
    camera = wide_camera()
    render, radius = colors_of(camera), squared_radius(camera)
    photo = responded(render, radius, torch.full((RESPONSE_SIZE,), -0.15))
    gain = fit_response(CameraResponseConfig(vignetting=True), render, photo, radius, torch.ones(40, 60))
    curve = fit_response(CameraResponseConfig(curve=True), render, photo, radius, torch.ones(40, 60))
    assert gain[:2].any()
    assert not gain[2:].any()
    assert curve[2:].any()
    assert not curve[:2].any()


def test_a_photo_like_its_render_or_with_few_pixels_has_none() -> None:
    camera = wide_camera()
    render, radius = colors_of(camera), squared_radius(camera)
    same = fit_response(BOTH, render, render, radius, torch.ones(40, 60))
    torch.testing.assert_close(same, torch.zeros(RESPONSE_SIZE), atol=1e-5, rtol=0)
    few = torch.zeros(40, 60)
    few.view(-1)[: LEAST_PIXELS - 1] = 1
    assert not fit_response(BOTH, render, 0.5 * render, radius, few).any()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_photo_of_something_else_still_gives_a_monotone_response(seed: int) -> None:
    camera = wide_camera()
    render, photo = (0.9 - colors_of(camera, seed)).clamp_min(0), colors_of(camera, seed)
    found = fit_response(BOTH, render, photo, squared_radius(camera), torch.ones(40, 60))
    ramp = torch.linspace(0, 1, 200)[:, None].expand(-1, 3)
    for radius in (0.0, 0.5, 1.0):
        assert (responded(ramp, torch.full((200,), radius), found).diff(dim=0) >= -1e-6).all()


@pytest.fixture
def wall_seen(camera, make_wall_model) -> WildGS:
    model = make_wall_model()
    model.config = replace(model.config, camera_response=BOTH)
    model.photo_match.config = model.config
    return model


def photo_with(camera: Camera, response: torch.Tensor) -> torch.Tensor:
    grey = torch.full((camera.height, camera.width, 3), 0.5)
    return responded(grey, squared_radius(camera), response)


def error(
    model: WildGS, camera: Camera, photo: torch.Tensor, response: torch.Tensor | None, appearance
) -> float:
    with torch.no_grad():
        render = model.render(camera, model.shade(appearance), response=response).colors
    return float((render - photo)[4:-4, 4:-4].abs().mean())


def test_encoding_finds_dark_corners_and_rendering_shows_them(camera, wall_seen) -> None:
    photo = photo_with(camera, DARK_CORNERS)
    appearance = wall_seen.encode(photo, camera)
    errors = [error(wall_seen, camera, photo, each, appearance) for each in (appearance.response, None)]
    assert errors[0] < 0.5 * errors[1]
    assert torch.equal(wall_seen.embed(appearance).response, appearance.response)
    assert wall_seen.encode(photo, camera, trust_mask=False).response is None
    wall_seen.config = replace(wall_seen.config, camera_response=CameraResponseConfig())
    assert wall_seen.encode(photo, camera).response is None


def test_the_left_half_alone_tells_the_corners_of_the_right_half(camera, wall_seen) -> None:
    photo, half = photo_with(camera, DARK_CORNERS), camera.width // 2
    left = camera.cropped(0, 0, half, camera.height)
    appearance = wall_seen.encode(photo[:, :half].contiguous(), left)
    errors = [error(wall_seen, camera, photo, each, appearance) for each in (appearance.response, None)]
    assert errors[0] < 0.6 * errors[1]


def test_training_compares_the_photo_with_its_cameras_render(camera, wall_seen) -> None:
    photo = photo_with(camera, DARK_CORNERS)
    output = wall_seen.training_pass(photo, camera, Stage(explicit=False))
    assert output.developed is not None
    errors = [
        float((colors - photo)[4:-4, 4:-4].abs().mean().detach())
        for colors in (output.picture, output.rendering.colors)
    ]
    assert errors[0] < 0.6 * errors[1]
    output.picture.sum().backward()
    assert wall_seen.gaussians.rows["intrinsic"].grad.any()


def test_without_the_option_training_compares_the_blended_colours(camera, make_wall_model) -> None:
    output = make_wall_model().training_pass(photo_with(camera, DARK_CORNERS), camera, Stage(explicit=False))
    assert output.developed is None
    assert output.picture is output.rendering.colors
