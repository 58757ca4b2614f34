"""The basis of lights: it spans what it has seen, finds what a photo adds, and reads only what it may read."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.spherical_harmonics import sh_values
from wildgs.model.light_basis import BLENDED_AT_ONCE, LEAST_PIXELS, LightBasis, fit_weights
from wildgs.model.photo_match import FIT_SIDE, Sight
from wildgs.model.registry import restore_method
from wildgs.model.training_pass import SeenPhoto
from wildgs.model.wildgs import WildGS
from wildgs.rasterize import blend


@pytest.fixture
def lit(camera, make_wall_model) -> WildGS:
    """A grey wall of which six lights are known: brighter at the left, or bluer at the top, more or less."""
    model = make_wall_model()
    x, y, _ = model.gaussians.means.detach().unbind(1)
    grey = torch.zeros(model.num_gaussians, 16, 3)
    lights = []
    for left, top in ((-1, -1), (-1, 1), (0, 1), (1, 1), (1, -1), (0, -1)):
        light = grey.clone()
        light[:, 0] = (left * 0.5 * x)[:, None]
        light[:, 0, 2] += top * 0.5 * y
        lights.append(light)
    model.light_basis.learn(lights, model.gaussians, 4)
    return model


def photo_under(camera, left: float, top: float) -> torch.Tensor:
    x = torch.linspace(-0.3, 0.3, camera.width)[None, :, None].expand(camera.height, -1, 3)
    y = torch.linspace(-0.3, 0.3, camera.height)[:, None].expand(-1, camera.width)
    photo = 0.5 + left * x
    photo[..., 2] += top * y
    return photo


def error(model: WildGS, camera, look, photo: torch.Tensor) -> float:
    with torch.no_grad():
        return float((model.render(camera, model.shade(look)).colors - photo).abs().mean())


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_weights_that_made_a_picture_are_found_in_spite_of_passers_by(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randn(5, 24, 30, 3, generator=generator) * 0.2
    weights = torch.randn(5, generator=generator)
    residual = torch.einsum("b, bhwc -> hwc", weights, images)
    residual[:6, :6] = 3.0
    residual[12:, 20:] = torch.nan
    counts = torch.ones(24, 30)
    counts[12:, 20:] = 0
    torch.testing.assert_close(fit_weights(images, residual, counts), weights, atol=0.05, rtol=0)


def test_a_component_that_no_pixel_shows_keeps_weight_zero() -> None:
    images = torch.rand(2, 24, 30, 3, generator=torch.Generator().manual_seed(0))
    images[1] = 0
    weights = fit_weights(images, 0.7 * images[0], torch.ones(24, 30))
    assert abs(float(weights[0]) - 0.7) < 0.01
    assert float(weights[1]) == 0


def test_components_span_the_lights_with_unit_variance(make_wall_model) -> None:
    gaussians = make_wall_model().gaussians
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(2, len(gaussians), 4, 3, generator=generator)
    lights = [
        directions[0] * a + directions[1] * b for a, b in torch.randn(7, 2, generator=generator).tolist()
    ]
    basis = LightBasis()
    basis.learn(lights, gaussians, 5)
    assert basis.components is not None
    columns = basis.components.float().flatten(1)
    centred = torch.stack(lights).flatten(1) - torch.stack(lights).flatten(1).mean(dim=0)
    found = torch.linalg.lstsq(columns[:2].T, centred.T).solution
    torch.testing.assert_close(found.T @ columns[:2], centred, atol=0.02, rtol=0)
    torch.testing.assert_close(found.square().mean(dim=1), torch.ones(2), atol=0.02, rtol=0)
    assert columns[2:].abs().max() < 0.02
    rows = torch.tensor([4, 1, 100])
    weights = torch.randn(5, generator=generator)
    torch.testing.assert_close(basis.harmonics(weights, rows), basis.harmonics(weights)[rows])


@pytest.mark.parametrize("count", [1, BLENDED_AT_ONCE, BLENDED_AT_ONCE + 3])
def test_components_blended_together_are_those_blended_alone(camera, make_wall_model, count: int) -> None:
    model, basis = make_wall_model(), LightBasis()
    generator = torch.Generator().manual_seed(count)
    basis.components = torch.randn(count, model.num_gaussians, 4, 3, generator=generator).half()
    with torch.no_grad():
        projection, means = model.gaussians.project(camera), model.gaussians.means.detach()
        found = basis._images(projection, means)
        assert len(found) == count
        for image, component in zip(found, basis.components, strict=True):
            colors = sh_values(component.float(), means - camera.position)
            alone = blend(projection, colors, depth=False).colors
            torch.testing.assert_close(image, alone, atol=1e-5, rtol=1e-4)


def test_two_lights_are_no_basis(camera, make_wall_model) -> None:
    model = make_wall_model()
    photos = [SeenPhoto(photo_under(camera, a, 0), camera, None, str(a)) for a in (0, 1)]
    model.finish(photos)
    assert model.basis_size == 0
    assert model.encode(photos[0].photo, camera).basis_weights is None


def test_a_new_photos_light_is_fitted(camera, lit: WildGS) -> None:
    photo = photo_under(camera, 0.7, 0.3)
    look = lit.encode(photo, camera)
    assert error(lit, camera, look, photo) < 0.7 * error(
        lit, camera, replace(look, basis_weights=None), photo
    )
    assert lit.encode(photo, camera, trust_mask=False).basis_weights is None


def test_encoded_photos_keep_a_part_of_their_embedding(camera, lit: WildGS) -> None:
    photo = photo_under(camera, 0.7, 0.3)
    whole = lit.parse(photo).global_embedding
    assert whole is not None
    for scale in (0.5, 1.0):
        lit.config = replace(lit.config, embedding_scale=scale)
        torch.testing.assert_close(lit.encode(photo, camera).global_embedding, scale * whole)
    lit.config = replace(lit.config, embedding_scale=0.5, color_match=False)
    assert torch.equal(lit.encode(photo, camera).global_embedding, whole), (
        "no match replaces what is taken away"
    )


def test_the_basis_is_that_of_whole_embeddings(camera, lit: WildGS) -> None:
    photos = [
        SeenPhoto(photo_under(camera, a, 1 - a), camera, None, str(a)) for a in (0.0, 0.3, 0.5, 0.8, 1.0)
    ]
    with torch.no_grad():
        lit.fusion.output.weight.normal_(generator=torch.Generator().manual_seed(0))
    found = []
    for scale in (0.5, 1.0):
        lit.config = replace(lit.config, embedding_scale=scale)
        lit.finish(photos)
        found.append(lit.light_basis.components)
    assert torch.equal(*found)


def test_pixels_that_do_not_count_are_not_read(camera, lit: WildGS) -> None:
    photo = photo_under(camera, 1, 0)
    look = replace(lit.encode(photo, camera), visibility=None)
    keep = torch.ones(camera.height, camera.width, dtype=torch.bool)
    keep[:, : camera.width // 2] = False
    painted = photo.clone()
    painted[:, : camera.width // 2] = 1.0

    def sight(photo: torch.Tensor, keep: torch.Tensor) -> Sight:
        return Sight.reduced(lit.gaussians, photo, camera, None, keep)

    first, second = (
        lit.light_basis.fit(lit, sight(each, keep), look).basis_weights for each in (photo, painted)
    )
    assert torch.equal(first, second)
    nothing = keep & False
    nothing.view(-1)[: LEAST_PIXELS // 2] = True
    assert (
        lit.light_basis.fit(lit, sight(photo, nothing), replace(look, basis_weights=None)).basis_weights
        is None
    )


def test_a_checkpoint_brings_the_basis_back_and_training_forgets_it(camera, lit: WildGS) -> None:
    photo = photo_under(camera, 0.7, 0.3)
    back = restore_method("wildgs", lit.config, lit.state_dict())
    assert torch.equal(back.encode(photo, camera).basis_weights, lit.encode(photo, camera).basis_weights)
    before = lit.fingerprint()
    lit.finish(())
    assert lit.basis_size == 0
    assert lit.fingerprint() != before, "saved weights would mean something else"
    assert restore_method("wildgs", lit.config, lit.state_dict()).encode(photo, camera).basis_weights is None


def test_large_scenes_look_at_fewer_lights() -> None:
    assert LightBasis.affordable_lights(1000, 4) > LightBasis.affordable_lights(10_000_000, 16) > 1


def test_large_photos_are_matched_small(camera, lit: WildGS) -> None:
    large = camera.resized(16 * camera.width, 16 * camera.height)
    sight = Sight.reduced(
        lit.gaussians,
        photo_under(large, 1, 0),
        large,
        torch.ones(large.height, large.width),
        torch.ones(large.height, large.width, dtype=torch.bool),
    )
    assert sight.photo.shape == (FIT_SIDE * 4 // 5, FIT_SIDE, 3)
    assert (sight.projection.camera.width, sight.projection.camera.height) == (FIT_SIDE, FIT_SIDE * 4 // 5)
    assert sight.visibility.shape == sight.keep.shape == sight.photo.shape[:2]
    assert sight.keep.all()
    same = Sight.reduced(lit.gaussians, photo_under(camera, 1, 0), camera, None, None)
    assert torch.equal(same.photo, photo_under(camera, 1, 0))
    photo = photo_under(camera, 1, 0)
    assert error(lit, camera, lit.encode(photo_under(large, 1, 0), large), photo) < 0.03


def test_training_shows_no_more_photos_than_the_basis_takes(lit: WildGS) -> None:
    assert lit.final_photos() == 96
    lit.config = replace(lit.config, light_components=0)
    assert lit.final_photos() == 0
    lit.config = replace(lit.config, light_components=32, color_match=False)
    assert lit.final_photos() == 0
