import pytest
import torch

from wildgs.losses.evidence import PROOF
from wildgs.losses.objective import (
    OUTLYING,
    ObjectiveConfig,
    depth_correlation,
    metric_error,
    nearness,
    total_loss,
    visibility_regularizer,
)
from wildgs.losses.photometric import masked_photometric
from wildgs.losses.ssim import ssim_map

H, W = 24, 32


@pytest.fixture
def inputs() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        "photo": torch.rand(H, W, 3, generator=generator),
        "render": torch.rand(H, W, 3, generator=generator).requires_grad_(),
        "visibility": torch.rand(H, W, generator=generator).requires_grad_(),
        "depth": (torch.rand(H, W, generator=generator) + 1).requires_grad_(),
        "alpha": torch.rand(H, W, generator=generator).requires_grad_(),
        "disparity": torch.rand(H, W, generator=generator) + 0.1,
    }


def test_regularizer_is_the_mean_square_of_what_is_hidden():
    assert visibility_regularizer(torch.ones(H, W)).item() == 0
    assert visibility_regularizer(torch.full((H, W), 0.25)).item() == pytest.approx(0.5625)


def test_mask_weight_falls_linearly_and_stays_in_its_range():
    config = ObjectiveConfig()
    weights = [config.mask_weight(p) for p in (-1.0, 0.0, 0.5, 1.0, 2.0)]
    assert weights == pytest.approx([0.4, 0.4, 0.25, 0.1, 0.1])


def test_few_photos_begin_with_a_lower_mask_weight():
    config = ObjectiveConfig(mask_weight_photos=60)
    starts = [config.mask_weight(0.0, photos) for photos in (200, 60, 50, 40, 1)]
    assert starts == pytest.approx([0.4, 0.4, 0.25, 0.1, 0.1])
    assert config.mask_weight(0.5, 50) == pytest.approx(0.175)
    assert config.mask_weight(1.0, 50) == pytest.approx(config.mask_weight_end)
    assert ObjectiveConfig(mask_weight_photos=0).mask_weight(0.0, 1) == pytest.approx(0.4)


def test_the_number_of_photos_decides_the_weight_in_the_total(inputs):
    few, many = (total_loss(ObjectiveConfig(), 0.0, **inputs, num_photos=photos) for photos in (10, 100))
    difference = many.total - few.total
    assert difference.item() == pytest.approx(0.3 * few.mask.item(), rel=1e-4)


def test_total_is_the_weighted_sum_of_its_terms(inputs):
    config = ObjectiveConfig(depth_weight=0.3, opaque_weight=0.02)
    losses = total_loss(config, 0.5, **inputs)
    selection = (inputs["visibility"] > 0.5) & (inputs["alpha"] > 0.5)
    image = masked_photometric(inputs["photo"], inputs["render"], inputs["visibility"], 0.8, power=3.0)
    mask = visibility_regularizer(inputs["visibility"])
    depth = depth_correlation(inputs["depth"], inputs["disparity"], selection)
    clear = (1 - inputs["alpha"]).mean()
    assert losses.as_floats() == pytest.approx(
        {
            "image": image.item(),
            "mask": mask.item(),
            "depth": depth.item(),
            "total": (image + 0.25 * mask + 0.3 * depth + 0.02 * clear).item(),
        }
    )


def test_plain_splatting_has_only_the_image_loss(inputs):
    losses = total_loss(ObjectiveConfig(), 0.0, inputs["photo"], inputs["render"])
    assert losses.mask.item() == losses.depth.item() == 0
    assert losses.total.item() == losses.image.item()


def test_depth_loss_passes_no_gradient_to_mask_and_alpha(inputs):
    photo = inputs["photo"].clone()
    losses = total_loss(ObjectiveConfig(), 0.0, **{**inputs, "photo": photo})
    by_mask, by_alpha, by_depth = torch.autograd.grad(
        losses.depth, [inputs["visibility"], inputs["alpha"], inputs["depth"]], allow_unused=True
    )
    assert by_mask is None
    assert by_alpha is None
    assert by_depth.abs().max() > 0
    hidden = inputs["visibility"] <= 0.5
    assert (by_depth[hidden] == 0).all()


def test_paused_mask_gets_no_gradient_but_still_masks(inputs):
    paused = total_loss(ObjectiveConfig(), 0.0, **inputs, train_mask=False)
    running = total_loss(ObjectiveConfig(), 0.0, **inputs)
    assert paused.total.item() == pytest.approx(running.total.item())
    paused.total.backward()
    assert inputs["visibility"].grad is None
    assert inputs["render"].grad.abs().max() > 0


def test_pixels_that_the_user_ignores_count_in_no_term(inputs):
    keep = torch.ones(H, W, dtype=torch.bool)
    keep[5:15, 5:20] = False
    before = total_loss(ObjectiveConfig(), 0.3, **inputs, keep=keep).as_floats()
    changed = {name: value.detach().clone() for name, value in inputs.items()}
    for name in changed:
        changed[name][5:15, 5:20] = 0.123
    after = total_loss(ObjectiveConfig(), 0.3, **changed, keep=keep).as_floats()
    assert after == pytest.approx(before)
    plain = total_loss(ObjectiveConfig(), 0.3, inputs["photo"], inputs["render"], keep=keep)
    plain_changed = total_loss(ObjectiveConfig(), 0.3, changed["photo"], changed["render"], keep=keep)
    assert plain.total.item() == pytest.approx(plain_changed.total.item())


def test_the_masks_gradient_as_printed_is_that_of_the_formula(inputs):
    """λ |I⊙M - Î⊙M| + (1 - λ) (1 - SSIM(I⊙M, Î⊙M)), by plain convolutions in double precision."""
    photo, render, visibility = (inputs[name].detach().double() for name in ("photo", "render", "visibility"))
    render.requires_grad_()
    visibility.requires_grad_()
    mask = visibility[..., None]
    similarity = ssim_map(photo * mask, render * mask).mean()
    printed = 0.8 * (photo * mask - render * mask).abs().mean() + 0.2 * (1 - similarity)
    expected = torch.autograd.grad(printed + 0.4 * (1 - visibility).square().mean(), [visibility, render])
    plain = {"photo": inputs["photo"], "render": inputs["render"], "visibility": inputs["visibility"]}
    losses = total_loss(ObjectiveConfig(mask_gradient="loss", mask_power=1.0), 0.0, **plain)
    found = torch.autograd.grad(losses.total, [inputs["visibility"], inputs["render"]])
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other.float(), atol=1e-7, rtol=1e-3)


def test_either_gradient_of_the_mask_belongs_to_one_value(inputs):
    losses = {
        kind: total_loss(ObjectiveConfig(mask_gradient=kind), 0.0, **inputs) for kind in ("loss", "evidence")
    }
    assert losses["loss"].as_floats() == pytest.approx(losses["evidence"].as_floats(), rel=1e-5)
    by_mask = {k: torch.autograd.grad(v.image, [inputs["visibility"]])[0] for k, v in losses.items()}
    assert not torch.allclose(by_mask["loss"], by_mask["evidence"], atol=1e-4)


def test_metric_error_is_that_of_inverse_depth_and_bounded() -> None:
    known = torch.tensor([[2.0, 2.0, 0.0, 2.0]])
    everywhere = torch.ones(1, 4, dtype=torch.bool)
    assert float(metric_error(known, known, everywhere)) == 0.0
    rendered = torch.tensor([[2.0 / 1.05, 1e-3, 5.0, 2.0]], requires_grad=True)
    error = metric_error(rendered, known, everywhere)
    expected = (0.05 / 1.5 + OUTLYING * (1999 / (1999 + OUTLYING))) / 4
    assert float(error.detach()) == pytest.approx(expected, rel=1e-3)
    error.backward()
    assert rendered.grad is not None
    assert rendered.grad[0, 0] < 0  # towards the known depth
    assert rendered.grad[0, 2] == 0  # nothing is known there
    assert float(metric_error(rendered, known, ~everywhere).detach()) == 0.0


def test_metric_depth_takes_the_place_of_the_monocular_estimate() -> None:
    generator = torch.Generator().manual_seed(0)
    photo, depth = torch.rand(16, 16, 3, generator=generator), 1 + torch.rand(16, 16, generator=generator)
    metric = torch.zeros(16, 16)
    metric[:8] = depth[:8]
    disparity = 1 / depth
    disparity[:8] = depth[:8]  # wrong where metric depth is known: it must not count there
    config = ObjectiveConfig(depth_weight=0.3, metric_weight=0.7)
    both = total_loss(config, 0.0, photo, photo, depth=depth, disparity=disparity, metric_depth=metric)
    lower = total_loss(config, 0.0, photo[8:], photo[8:], depth=depth[8:], disparity=disparity[8:])
    torch.testing.assert_close(both.depth, lower.depth)
    without = total_loss(config, 0.0, photo, photo, depth=2 * depth, metric_depth=metric)
    torch.testing.assert_close(without.total, 0.7 * without.depth + without.image)


def test_depth_in_front_of_the_sky_is_penalised_by_its_nearness() -> None:
    depth = torch.tensor([[1.0, 3.0], [8.0, 1.0]], requires_grad=True)
    sky = torch.tensor([[True, True], [True, False]])
    loss = nearness(depth, sky, far=4.0)
    assert loss.item() == pytest.approx((0.75 + 0.25) / 4)
    loss.backward()
    assert depth.grad is not None
    assert depth.grad.tolist() == [[pytest.approx(-0.0625), pytest.approx(-0.0625)], [0.0, 0.0]]


def test_what_is_known_to_be_static_is_not_hidden() -> None:
    photo = torch.rand(48, 48, 3, generator=torch.Generator().manual_seed(0))
    render = photo.clone()
    render[:, 16:32] = 1 - render[:, 16:32]
    visibility = torch.full((48, 48), 0.9, requires_grad=True)
    static = torch.zeros(48, 48, dtype=torch.bool)
    static[:16] = True
    observations = torch.tensor([[24.5, 40.5]])
    config = ObjectiveConfig()
    losses = total_loss(
        config, 0.0, photo, render, visibility=visibility, static=static, observations=observations
    )
    losses.image.backward()
    gradient = visibility.grad
    assert gradient is not None
    assert bool((gradient[:16] == -PROOF / 48**2).all())
    assert float(gradient[40, 24]) == pytest.approx(-PROOF / 48**2)
    assert float(gradient[18:38, 20:28].mean()) > 0.05 / 48**2


def test_pixels_that_the_user_masks_are_no_sky() -> None:
    photo, depth = torch.zeros(16, 16, 3), torch.ones(16, 16)
    sky, keep = torch.ones(16, 16, dtype=torch.bool), torch.ones(16, 16, dtype=torch.bool)
    keep[:, :4] = False
    config = ObjectiveConfig(sky_weight=2.0)
    losses = [
        total_loss(config, 0.0, photo, photo, depth=depth, sky=sky, sky_depth=4.0, keep=each)
        for each in (None, keep, torch.zeros_like(keep))
    ]
    assert [each.total.item() for each in losses] == pytest.approx([1.5, 1.125, 0.0])


def test_what_is_transparent_is_penalised_but_where_the_user_masks() -> None:
    photo = torch.zeros(16, 16, 3)
    alpha = torch.full((16, 16), 0.75, requires_grad=True)
    keep = torch.ones(16, 16, dtype=torch.bool)
    keep[:, :4] = False
    config = ObjectiveConfig(opaque_weight=2.0)
    for mask, wanted in ((None, 0.5), (keep, 0.375), (torch.zeros_like(keep), 0.0)):
        losses = total_loss(config, 0.0, photo, photo, alpha=alpha, keep=mask)
        assert losses.total.item() == pytest.approx(wanted)
    total_loss(config, 0.0, photo, photo, alpha=alpha, keep=keep).total.backward()
    assert alpha.grad is not None
    assert alpha.grad[:, 4:].unique().tolist() == [pytest.approx(-2.0 / 256)]
    assert not alpha.grad[:, :4].any()
    assert total_loss(ObjectiveConfig(opaque_weight=0.0), 0.0, photo, photo, alpha=alpha).total.item() == 0
