"""The method whole: encode, shade, render; crop and the outside vector; where gradients may and may not go."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from wildgs.model.appearance import Appearance, Embeddings, blend_embeddings
from wildgs.model.encoder import load_encoder
from wildgs.model.registry import restore_method
from wildgs.model.training_pass import Stage
from wildgs.model.vanilla import VanillaConfig, VanillaGS
from wildgs.model.wildgs import WildGS
from wildgs.model.wrapping import lift, liftable, random_part
from wildgs.rasterize import blend


def photo_of(camera, value: float = 0.5) -> torch.Tensor:
    generator = torch.Generator().manual_seed(int(value * 100))
    return value * torch.rand(camera.height, camera.width, 3, generator=generator)


def test_lifted_pixels_lie_on_the_wall(camera, make_wall_model) -> None:
    model = make_wall_model()
    with torch.no_grad():
        geometry = blend(model.gaussians.project(camera), None)
    photo = photo_of(camera)
    keep = liftable(None, geometry.alpha, 0.5)
    points, colors = (cloud[keep.reshape(-1)] for cloud in lift(photo, geometry.depth, camera))
    assert keep.float().mean() > 0.9
    torch.testing.assert_close(points[:, 2], torch.full_like(points[:, 2], 2.0), atol=0.02, rtol=0)
    assert torch.equal(colors, photo[keep])
    pixels = points @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    rows, columns = keep.nonzero(as_tuple=True)
    torch.testing.assert_close(pixels, torch.stack([columns, rows], 1) + 0.5, atol=1e-3, rtol=0)


def test_only_static_and_covered_pixels_are_lifted() -> None:
    visibility = torch.tensor([[0.9, 0.9, 0.2, 0.5]])
    alpha = torch.tensor([[0.9, 0.3, 0.9, 0.9]])
    assert liftable(visibility, alpha, 0.5).tolist() == [[True, False, False, False]]


def test_users_mask_keeps_pixels_from_the_triplane(camera, make_wall_model) -> None:
    model = make_wall_model()
    photo = photo_of(camera)
    nothing = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    painted = photo.clone()
    painted[:] = 0.9
    with torch.no_grad():
        parsed = model.parse(photo)
        projection = model.gaussians.project(camera)
        first = model.wrap(photo, parsed, projection, nothing)
        second = model.wrap(painted, parsed, projection, nothing)
        unmasked = model.wrap(painted, parsed, projection)
    assert torch.equal(first.planes, second.planes)
    assert not torch.equal(first.planes, unmasked.planes)


def test_outside_the_crop_every_gaussian_has_the_learnable_vector(camera, make_wall_model) -> None:
    model = make_wall_model()
    with torch.no_grad():
        model.wrapping.outside.copy_(torch.arange(16.0))
        embeddings = model.embed(model.encode(photo_of(camera), camera))
    inside = model.wrapping.box.contains(model.gaussians.means)
    assert 0.1 < inside.float().mean() < 0.9
    assert torch.equal(
        embeddings.local_embeddings[~inside], torch.arange(16.0).expand(int((~inside).sum()), 16)
    )
    assert (embeddings.local_embeddings[inside] != torch.arange(16.0)).any()


def test_without_crop_the_box_is_twice_as_wide(make_wall_model) -> None:
    cropped, whole = make_wall_model().wrapping.box, make_wall_model("crop").wrapping.box
    width = cropped.high - cropped.low
    torch.testing.assert_close((whole.high - whole.low)[:2], 2 * width[:2])


def test_first_stage_uses_the_vector_everywhere(camera, make_wall_model) -> None:
    model = make_wall_model()
    embeddings = model.embed(model.parse(photo_of(camera)))
    assert torch.equal(embeddings.local_embeddings, model.wrapping.outside.expand(len(model.gaussians), -1))
    output = model.training_pass(photo_of(camera), camera, Stage(explicit=False))
    output.rendering.colors.sum().backward()
    assert next(model.wrapping.unet.parameters()).grad is None
    assert model.wrapping.outside.grad is not None


def test_mask_takes_no_gradient_through_lifting(camera, make_wall_model) -> None:
    """M chooses pixels by a threshold; the triplane must not train it."""
    model = make_wall_model()
    output = model.training_pass(photo_of(camera), camera, Stage())
    output.rendering.colors.sum().backward()
    assert all(p.grad is None for p in model.parsing.decoder.parameters())
    assert model.parsing.mask_head.weight.grad is None
    assert any(p.grad is not None for p in model.parsing.encoder.parameters()), "Emb^g trains the encoder"


def test_paused_mask_is_cut_off_but_embedding_is_not(camera, make_wall_model) -> None:
    model = make_wall_model()
    output = model.training_pass(photo_of(camera), camera, Stage(learn_mask=False))
    assert output.visibility is not None
    assert not output.visibility.requires_grad
    loss = (output.rendering.colors * output.visibility[..., None]).sum()
    loss.backward()
    assert model.parsing.mask_head.weight.grad is None
    assert model.parsing.global_mlp[0].weight.grad is not None


def test_appearance_does_not_move_the_geometry(camera, make_wall_model) -> None:
    """Colours reach the centres through the view direction only, not through where they sample the planes."""
    model = make_wall_model()
    appearance = model.encode(photo_of(camera), camera)
    embeddings = model.embed(appearance)
    embeddings.local_embeddings.sum().backward()
    assert model.gaussians.means.grad is None


def test_training_starts_near_the_point_clouds_colour(camera, make_wall_model) -> None:
    model = make_wall_model()
    with torch.no_grad():
        rendering = model.render(camera, model.shade(model.parse(photo_of(camera))))
    covered = rendering.colors[rendering.alpha > 0.9]
    torch.testing.assert_close(covered.mean(dim=0), torch.full((3,), 128 / 255), atol=0.12, rtol=0)


def test_another_photo_changes_colours_and_nothing_else(camera, make_wall_model) -> None:
    model = make_wall_model()
    with torch.no_grad():
        bright, dark = (model.shade(model.encode(photo_of(camera, v), camera)) for v in (1.0, 0.1))
        first, second = model.render(camera, bright), model.render(camera, dark)
    assert not torch.equal(first.colors, second.colors)
    assert torch.equal(first.depth, second.depth)
    assert torch.equal(first.alpha, second.alpha)


def test_shading_some_gaussians_equals_shading_all(camera, make_wall_model) -> None:
    model = make_wall_model()
    rows = torch.tensor([5, 0, 77, 2999])
    with torch.no_grad():
        appearance = model.encode(photo_of(camera), camera)
        torch.testing.assert_close(model.shade(appearance, rows), model.shade(appearance)[rows])


def test_mix_is_linear_on_both_embeddings(camera, make_wall_model) -> None:
    model = make_wall_model()
    with torch.no_grad():
        a, b = (model.embed(model.encode(photo_of(camera, v), camera)) for v in (1.0, 0.1))
    middle = blend_embeddings([a, b], [0.75, 0.25])
    torch.testing.assert_close(middle.global_embedding, 0.75 * a.global_embedding + 0.25 * b.global_embedding)
    torch.testing.assert_close(middle.local_embeddings, 0.75 * a.local_embeddings + 0.25 * b.local_embeddings)
    assert torch.equal(blend_embeddings([a, b], [1.0, 0.0]).local_embeddings, a.local_embeddings)


@pytest.mark.parametrize("part", ["global", "mask", "intrinsic", "local", "reverse", "crop"])
def test_each_ablation_trains_and_lacks_what_it_says(camera, make_wall_model, part) -> None:
    model = make_wall_model(part)
    output = model.training_pass(photo_of(camera), camera, Stage())
    loss = output.rendering.colors.mean()
    if output.visibility is not None:
        loss = loss + output.visibility.mean()
    loss.backward()
    gradients = {
        name for name, p in model.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0
    }
    trained = {
        "global": any(name.startswith("parsing.global_mlp") for name in gradients),
        "mask": "parsing.mask_head.bias" in gradients,
        "intrinsic": "gaussians.rows.intrinsic" in gradients,
        "local": any(name.startswith("wrapping.unet") for name in gradients),
        "reverse": model.wrapping.unet.down[0].first.in_channels == 8,
        "crop": bool((~model.wrapping.box.contains(model.gaussians.means)).any()),
    }
    assert trained.pop(part) is False
    assert all(trained.values()), trained


def test_method_returns_from_its_state(camera, make_wall_model) -> None:
    model = make_wall_model()
    copy = restore_method("wildgs", model.config, model.state_dict())
    photo = photo_of(camera)
    with torch.no_grad():
        expected = model.render(camera, model.shade(model.encode(photo, camera))).colors
        got = copy.render(camera, copy.shade(copy.encode(photo, camera))).colors
    assert torch.equal(expected, got)


def test_baseline_ignores_the_photo(camera, wall) -> None:
    method = VanillaGS.from_points(VanillaConfig(), wall, torch.full((len(wall), 3), 200, dtype=torch.uint8))
    first = method.training_pass(photo_of(camera, 1.0), camera, Stage())
    second = method.training_pass(photo_of(camera, 0.1), camera, Stage())
    assert first.visibility is None
    assert torch.equal(first.rendering.colors, second.rendering.colors)
    assert method.encode(photo_of(camera), camera) == Appearance()
    with torch.no_grad():
        method.gaussians.rows["opacity_logits"].fill_(6.0)
        colors = method.render(camera, method.shade(Appearance())).colors
    torch.testing.assert_close(colors[16, 20], torch.full((3,), 200 / 255), atol=0.02, rtol=0)


def test_empty_photo_encodes(camera, make_wall_model) -> None:
    """Nothing lifts from where the scene is not seen; the appearance is still finite."""
    model = make_wall_model()
    away = camera.__class__(
        torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), camera.K, camera.width, camera.height
    )
    with torch.no_grad():
        sh = model.shade(model.encode(photo_of(camera), away))
    assert torch.isfinite(sh).all()
    assert isinstance(model, WildGS)


def test_colours_are_matched_to_a_photo_of_the_place_alone(camera, make_wall_model) -> None:
    model = make_wall_model()
    photo = torch.tensor([0.2, 0.5, 0.9]).expand(camera.height, camera.width, 3).contiguous()
    matched = model.encode(photo, camera)
    unmatched = replace(matched, color_map=None)
    errors = [
        float((model.render(camera, model.shade(look)).colors - photo).abs().mean().detach())
        for look in (matched, unmatched)
    ]
    assert errors[0] < 0.05 < errors[1]
    assert model.encode(photo, camera, trust_mask=False).color_map is None
    model.config = replace(model.config, color_match=False)
    assert model.encode(photo, camera).color_map is None


def test_colour_maps_mix_with_the_global_embedding() -> None:
    first = Embeddings(torch.zeros(2), torch.zeros(4, 2), torch.ones(3, 4))
    second = Embeddings(torch.ones(2), torch.ones(4, 2))
    mixed = blend_embeddings([first, second], [0.25, 0.75], [1.0, 0.0])
    assert torch.equal(mixed.color_map, torch.full((3, 4), 0.25))
    assert blend_embeddings([second, second], [0.5, 0.5]).color_map is None
    assert not blend_embeddings([first, second], [0.0, 1.0]).color_map.any()


def test_a_random_part_is_one_side_of_a_cut() -> None:
    torch.manual_seed(0)
    shares, kinds = [], set()
    for _ in range(200):
        part = random_part(40, 60)
        rows, columns = part.any(dim=1), part.any(dim=0)
        assert torch.equal(part, rows[:, None] & columns[None, :])
        assert int(rows.diff().sum() + columns.diff().sum()) == 1, "one cut"
        kinds.add((bool(rows.all()), bool(part[0, 0])))
        shares.append(float(part.float().mean()))
    assert len(kinds) == 4
    assert 0.24 < min(shares) < 0.35 < 0.65 < max(shares) < 0.76


@pytest.mark.parametrize(("share", "changes"), [(0.0, False), (1.0, True)])
def test_parts_are_lifted_in_training_alone(share: float, changes: bool, camera, make_wall_model) -> None:
    model = make_wall_model(partial_lifts=share)
    photo = photo_of(camera)
    pictures = []
    with torch.no_grad():
        whole = model.encode(photo, camera).planes
        assert torch.equal(whole, model.encode(photo, camera).planes)
    for _ in range(3):
        output = model.training_pass(photo, camera, Stage())
        pictures.append(output.rendering.colors.detach())
    assert (not torch.equal(pictures[0], pictures[1]) or not torch.equal(pictures[1], pictures[2])) == changes


@pytest.mark.parametrize(("noise", "changes"), [(0.0, False), (0.3, True)])
def test_embeddings_are_noisy_in_training_alone(noise: float, changes: bool, camera, make_wall_model) -> None:
    model = make_wall_model(embedding_noise=noise, partial_lifts=0.0)
    with torch.no_grad():
        model.fusion.output.weight.normal_()  # initially embeddings hardly matter
        encoded = [model.encode(photo_of(camera), camera).global_embedding for _ in range(2)]
    passes = [model.training_pass(photo_of(camera), camera, Stage()).picture for _ in range(2)]
    assert torch.equal(*passes) is not changes
    assert torch.equal(*encoded)


def test_antialiased_takes_opacity_from_small_gaussians_only(camera, wall, make_wall_model) -> None:
    config, colors = make_wall_model().config, torch.full((len(wall), 3), 128, dtype=torch.uint8)
    small = torch.arange(len(wall)) % 2 == 0
    opacities = {}
    for antialiased in (False, True):
        chosen = replace(config, antialiased=antialiased, eps2d=0.3)
        model = WildGS.from_points(chosen, wall, colors, encoder=load_encoder(None))
        with torch.no_grad():
            model.gaussians.rows["opacity_logits"].fill_(6.0)
            model.gaussians.rows["log_scales"][small] = -5.0  # a seventh of a pixel
            model.gaussians.rows["log_scales"][~small] = -1.0
            projection = model.gaussians.project(camera)
        opacities[antialiased] = torch.where(projection.visible, projection.opacities, torch.nan)
    ratio = opacities[True] / opacities[False]
    assert 0 < ratio[small].nanmean() < 0.15
    assert 0.99 < ratio[~small].nanmean() <= 1
