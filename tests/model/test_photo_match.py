"""The colour match within the method: in training, in encoding, and for checkpoints that have no light codes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from wildgs.geometry.spherical_harmonics import C0
from wildgs.model.config import SkyConfig, WildGSConfig
from wildgs.model.method import Stage
from wildgs.model.photo_match import PhotoMatch
from wildgs.model.registry import restore_method
from wildgs.model.sky import sine_of_elevation


def grey_photo(camera, value: float) -> torch.Tensor:
    return torch.full((camera.height, camera.width, 3), value)


@pytest.mark.parametrize("share", [0.0, 0.8, 1.0])
def test_a_training_render_comes_near_the_exposure_of_its_photo(
    camera, make_wall_model, share: float
) -> None:
    model = make_wall_model()
    for value in (0.2, 0.8):
        means = []
        for matched in (0.0, share):
            model.config = model.photo_match.config = replace(model.config, matched_loss=matched)
            rendering = model.training_pass(grey_photo(camera, value), camera, Stage()).rendering
            means.append(float(rendering.colors.detach()[8:-8, 8:-8].mean()))
        assert means[1] == pytest.approx(means[0] + share * (value - means[0]), abs=0.02)


def test_the_match_takes_no_gradient_and_the_codes_do(camera, make_wall_model) -> None:
    model = make_wall_model()
    x = torch.linspace(0.2, 0.8, camera.width)[None, :, None]
    photo = x.expand(camera.height, -1, 3).contiguous()
    output = model.training_pass(photo, camera, Stage())
    (output.rendering.colors - photo).square().mean().backward()
    assert model.photo_match.codes.weight.grad.abs().sum() > 0
    assert output.rendering.colors.shape == photo.shape


def test_a_colour_map_has_columns_for_the_codes(camera, make_wall_model) -> None:
    model = make_wall_model()
    assert model.map_columns == 4 + model.config.light_codes
    assert model.encode(grey_photo(camera, 0.3), camera).color_map.shape == (3, model.map_columns)


def test_checkpoints_without_codes_are_read(camera, make_wall_model) -> None:
    model = make_wall_model()
    state = {name: value for name, value in model.state_dict().items() if not name.startswith("photo_match.")}
    back = restore_method("wildgs", model.config, state)
    assert back.map_columns == 4
    photo = grey_photo(camera, 0.3)
    with torch.no_grad():
        rendered = back.render(camera, back.shade(back.encode(photo, camera))).colors[8:-8, 8:-8]
    torch.testing.assert_close(rendered, photo[8:-8, 8:-8], atol=0.05, rtol=0)


@pytest.mark.parametrize("without", [("intrinsic",), ()])
def test_codes_need_intrinsic_features(without, make_wall_model) -> None:
    config = replace(make_wall_model().config, without=without)
    assert (PhotoMatch(config).codes is None) == bool(without)


@pytest.mark.parametrize("value", [-0.6, 0.2, 0.9])
def test_scenes_below_black_are_matched(camera, make_wall_model, value: float) -> None:
    """Also those that are below black everywhere, and are rendered as if they were black."""
    model = make_wall_model()
    with torch.no_grad():
        model.fusion.output.bias[:3] += (value - 0.5) / 0.28209479177387814
        photo = grey_photo(camera, 0.7)
        rendered = model.render(camera, model.shade(model.encode(photo, camera))).colors[8:-8, 8:-8]
    torch.testing.assert_close(rendered, photo[8:-8, 8:-8], atol=0.03, rtol=0)


@pytest.mark.parametrize("points", [0, 60])
@pytest.mark.parametrize("light_codes", [0, 3])
def test_colours_change_in_training_as_harmonics_do(points: int, light_codes: int) -> None:
    torch.manual_seed(0)
    match = PhotoMatch(WildGSConfig(light_codes=light_codes, sky=SkyConfig(points=points, radius=10.0)))
    change = 0.2 * torch.randn(3, match.columns)
    for first in (0, 4 + light_codes)[: 2 if points else 1]:  # in training, channels do not mix
        change[:, first : first + 3] = change[:, first : first + 3].diagonal().diag()
    means, centre = torch.randn(50, 3) * torch.linspace(0.1, 20, 50)[:, None], torch.zeros(3)
    colors, intrinsic = torch.rand(50, 3), torch.randn(50, 32)
    harmonics = ((colors - 0.5) / C0)[:, None]
    sky = match.sky(means, centre)
    expected = 0.5 + C0 * match.harmonics(harmonics, change, intrinsic, sky)[:, 0]
    above = torch.zeros(50, dtype=torch.bool) if sky is None else sky.which
    codes = match.light_codes(intrinsic[~above])
    ordered = torch.cat([colors[~above], colors[above]])
    changed = match.changed(ordered, change, codes, sine_of_elevation(means[above], centre))
    torch.testing.assert_close(changed, torch.cat([expected[~above], expected[above]]))


@pytest.mark.parametrize("light_codes", [0, 3])
def test_a_scene_without_light_codes_has_no_weights_of_them(light_codes: int) -> None:
    """An empty tensor instead would be on the CPU, also when training is on a GPU."""
    weights = PhotoMatch(WildGSConfig(light_codes=light_codes)).code_weights
    assert (weights is None) == (light_codes == 0)
