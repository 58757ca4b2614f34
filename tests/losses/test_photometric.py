from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.losses.evidence import (
    FLAT,
    FOREGROUND_EVIDENCE,
    PROOF,
    color_evidence,
    proven_static,
    structural_correlation,
    transient_evidence,
)
from wildgs.losses.photometric import masked_photometric
from wildgs.losses.ssim import _ConvolutionSSIM, gaussian_taps, ssim, ssim_map


def naive_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Straight from the definition, one window at a time, zeros outside the picture."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    height, width, channels = x.shape
    x, y = (np.pad(picture, ((5, 5), (5, 5), (0, 0))) for picture in (x, y))
    total = 0.0
    for c in range(channels):
        for i in range(height):
            for j in range(width):
                p, q = x[i : i + 11, j : j + 11, c], y[i : i + 11, j : j + 11, c]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                luminance = (2 * mp * mq + 1e-4) / (mp**2 + mq**2 + 1e-4)
                total += luminance * (2 * cov + 9e-4) / (vp + vq + 9e-4)
    return total / (height * width * channels)


def pictures(height: int, width: int, channels: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, channels, generator=generator, dtype=dtype)
    y = (0.6 * x + 0.4 * torch.rand(height, width, channels, generator=generator, dtype=dtype)).contiguous()
    return x, y


@settings(max_examples=15, deadline=None)
@given(
    height=st.integers(1, 17),
    width=st.integers(1, 17),
    channels=st.sampled_from([1, 3]),
    seed=st.integers(0, 99),
)
def test_ssim_agrees_with_the_definition(height, width, channels, seed):
    x, y = pictures(height, width, channels, seed)
    assert ssim(x, y).item() == pytest.approx(naive_ssim(x.numpy(), y.numpy()), abs=1e-10)


def test_single_precision_agrees_with_double():
    x, y = pictures(40, 53)
    assert ssim(x.float(), y.float()).item() == pytest.approx(ssim(x, y).item(), abs=1e-5)


def test_ssim_of_a_picture_with_itself_is_one():
    x, _ = pictures(20, 30)
    assert ssim(x, x).item() == pytest.approx(1.0, abs=1e-12)


def test_pictures_need_not_be_contiguous():
    x, y = pictures(21, 14)
    turned = ssim(x.transpose(0, 1), y.transpose(0, 1))
    assert turned.item() == pytest.approx(ssim(x, y).item(), abs=1e-12)


@pytest.mark.parametrize("shape", [(7, 5, 3), (13, 12, 1)])
def test_ssim_gradient_by_finite_differences(shape):
    x, y = pictures(*shape)
    assert torch.autograd.gradcheck(ssim, (x.requires_grad_(), y.requires_grad_()))


def test_kernels_and_convolutions_agree_in_value_and_gradient():
    results = []
    for function in (ssim, _ConvolutionSSIM.apply):
        x, y = (p.requires_grad_() for p in pictures(23, 31))
        value = function(x, y)
        (3 * value).backward()
        results.append((value.detach(), x.grad, y.grad))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=1e-9)


def test_nan_stays_visible():
    x, y = pictures(12, 12)
    x[3, 3, 0] = torch.nan
    assert ssim(x, y).isnan()


def test_window_sums_to_one_and_is_symmetric():
    taps = gaussian_taps(torch.float64)
    assert taps.sum().item() == pytest.approx(1.0)
    assert torch.equal(taps, taps.flip(0))


def test_loss_is_l1_plus_dissimilarity():
    photo, render = pictures(16, 18)
    expected = 0.8 * np.abs((photo - render).numpy()).mean() + 0.2 * (
        1 - naive_ssim(photo.numpy(), render.numpy())
    )
    assert masked_photometric(photo, render, None, 0.8).item() == pytest.approx(expected, abs=1e-10)


def test_full_visibility_is_the_same_as_none():
    photo, render = pictures(16, 18)
    ones = torch.ones(16, 18, dtype=torch.float64)
    assert masked_photometric(photo, render, ones).item() == masked_photometric(photo, render, None).item()


def test_hidden_pixels_cost_nothing_and_pull_nothing():
    photo, render = pictures(24, 24)
    visibility = torch.ones(24, 24, dtype=torch.float64)
    visibility[:, 12:] = 0
    render = render.clone()
    render[:, :12] = photo[:, :12]
    render.requires_grad_()
    loss = masked_photometric(photo, render, visibility)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-12)
    assert render.grad[:, 12:].abs().max() == 0


def test_gradient_to_the_render_is_the_formulas():
    photo, render = pictures(9, 8)
    visibility = torch.rand(9, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    render = (render + 0.3).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: masked_photometric(photo, r, visibility), (render,))


def test_a_learning_mask_changes_neither_value_nor_the_renders_gradient():
    photo, render = pictures(20, 14)
    visibility = torch.rand(20, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    results = []
    for mask in (visibility, visibility.clone().requires_grad_()):
        leaf = render.clone().requires_grad_()
        loss = masked_photometric(photo, leaf, mask)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    torch.testing.assert_close(results[0], results[1])


def test_a_power_of_the_mask_weights_doubtful_pixels_less():
    photo, render = pictures(20, 14)
    visibility = torch.rand(20, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    results = []
    for mask, power in ((visibility, 3.0), (visibility**3, 1.0)):
        leaf = render.clone().requires_grad_()
        loss = masked_photometric(photo, leaf, mask, power=power)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    torch.testing.assert_close(results[0], results[1])
    mask = visibility.clone().requires_grad_()
    masked_photometric(photo, render, mask, power=3.0).backward()
    torch.testing.assert_close(mask.grad, transient_evidence(photo, render) / (20 * 14))


def test_a_photo_that_is_wrong_everywhere_is_not_hidden():
    """Nothing rendered yet: the mask must not learn to hide it all."""
    visibility = torch.full((20, 14), 0.9, dtype=torch.float64, requires_grad=True)
    grey = torch.full((20, 14, 3), 0.8, dtype=torch.float64)
    masked_photometric(grey, torch.zeros_like(grey), visibility).backward()
    assert visibility.grad.abs().max() < 0.1 / (20 * 14)


def test_mask_gradient_is_the_evidence():
    photo, render = pictures(20, 14)
    visibility = torch.full((20, 14), 0.7, dtype=torch.float64, requires_grad=True)
    masked_photometric(photo, render, visibility).backward()
    torch.testing.assert_close(visibility.grad, transient_evidence(photo, render) / (20 * 14))
    assert (visibility.grad >= 0).all(), "no pixel is worth more than hiding it"


def test_evidence_is_zero_for_equal_and_local_for_unlike_pictures():
    photo, _ = pictures(40, 40)
    assert transient_evidence(photo, photo).abs().max() < 1e-12
    render = photo.clone()
    render[:8, :8] = 1 - render[:8, :8]
    evidence = transient_evidence(photo, render)
    assert evidence[2:6, 2:6].mean() > 0.2
    assert evidence[26:, 26:].abs().max() < 1e-12


def test_evidence_of_colour_is_of_another_hue_more_than_of_shade():
    photo = torch.full((120, 120, 3), 0.5)
    evidence = []
    for change in ([0.12, 0.12, 0.12], [0.17, -0.085, -0.085]):  # equally long
        render = photo.clone()
        render[40:60, 40:60] += torch.tensor(change)
        evidence.append(float(color_evidence(photo, render)[45:55, 45:55].mean()))
    assert evidence[1] > 3 * evidence[0]


def test_evidence_does_not_see_detail_that_is_a_pixel_off():
    stripes = 0.5 + 0.3 * (torch.arange(120) % 2 * 2 - 1)
    photo = stripes[None, :, None].expand(120, 120, 3).contiguous()
    render = photo.clone()
    render[:, :60] = photo[:, :60].roll(1, dims=1)
    assert float((photo - render)[:, :60].abs().mean()) > 0.5
    assert float(transient_evidence(photo, render).max()) < 0.01


def landscape(seed: int) -> torch.Tensor:
    """Textured stone: noise of three pixels a cell in one tint."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.rand(1, 1, 40, 40, generator=generator) * torch.tensor([1.0, 0.9, 0.7])[:, None, None]
    picture = torch.nn.functional.interpolate(cells, (120, 120), mode="bilinear")[0].permute(1, 2, 0)
    return 0.2 + 0.6 * picture


@given(
    seed=st.integers(0, 2**16),
    gain=st.lists(st.floats(0.4, 1.2), min_size=3, max_size=3),
    offset=st.lists(st.floats(-0.05, 0.05), min_size=3, max_size=3),
)
@settings(max_examples=25, deadline=None)
def test_another_light_is_no_evidence(seed, gain, offset):
    """Whatever an affine change does to the colours of all or half of a photo, hue included."""
    render = landscape(seed)
    light = (render * torch.tensor(gain) + torch.tensor(offset)).clamp(0, 1)
    assert float(transient_evidence(light, render).max()) < 0.2
    half = render.clone()
    half[:, :60] = light[:, :60]
    assert float(transient_evidence(half, render)[:, :50].max()) < 0.2


def test_a_pasted_object_is_evidence_in_any_light():
    render = landscape(0)
    for light in (torch.ones(3), torch.tensor([1.1, 0.8, 0.6])):
        photo = render * light
        photo[40:70, 50:65] = torch.tensor([0.9, 0.1, 0.1]) * (0.5 + landscape(1)[40:70, 50:65])
        evidence = transient_evidence(photo, render)
        assert float(evidence[45:65, 53:62].mean()) > 0.1
        assert float(evidence[90:].max()) < 0.01


def test_flat_areas_are_alike_and_a_flat_one_is_unlike_texture():
    flat, other = torch.full((120, 120, 3), 0.8), torch.full((120, 120, 3), 0.2)
    assert float(structural_correlation(flat, other).min()) > 0.99
    assert float(transient_evidence(flat, other).max()) == 0
    assert float(structural_correlation(flat, landscape(0)).mean()) < 0.5


def test_structural_correlation_is_the_windows_own():
    """Against the definition, at one pixel, without what the windows are taken to share."""
    photo, render = landscape(2), landscape(3)
    photo[40:80, 40:80] += 0.3 * landscape(4)[40:80, 40:80]
    row, column, radius = 60, 47, 2  # 120 pixels, 24 windows: 5 pixels a side
    x, y = (
        p[row - radius : row + radius + 1, column - radius : column + radius + 1].mean(dim=2).flatten()
        for p in (photo, render)
    )
    covariance = ((x - x.mean()) * (y - y.mean())).mean() + FLAT**2
    expected = covariance / ((x.var(correction=0) + FLAT**2) * (y.var(correction=0) + FLAT**2)).sqrt()
    assert float(structural_correlation(photo, render)[row, column]) == pytest.approx(
        float(expected), abs=1e-4
    )


def test_hiding_a_wrong_region_lowers_the_loss():
    photo, _ = pictures(32, 32)
    render = photo.clone()
    render[8:24, 8:24] = 1 - render[8:24, 8:24]
    visibility = torch.full((32, 32), 0.9, dtype=torch.float64, requires_grad=True)
    masked_photometric(photo, render, visibility).backward()
    assert visibility.grad[10:22, 10:22].mean() > 0
    assert visibility.grad[10:22, 10:22].mean() > 10 * visibility.grad[0:2].abs().mean()


@pytest.fixture
def precision() -> Iterator[Any]:
    """Torch's setting for cuDNN's convolutions."""
    setting: Any = torch.backends.cudnn.conv
    before = setting.fp32_precision
    yield setting
    setting.fp32_precision = before


def test_convolutions_run_where_the_user_set_the_precision_of_some(precision: Any):
    """torch refuses to read its older setting after that (`allow_tf32`)."""
    precision.fp32_precision = "ieee"
    with pytest.raises(RuntimeError, match="mix of the legacy and new"):
        assert torch.backends.cudnn.allow_tf32
    picture = torch.rand(12, 14, 3)
    torch.testing.assert_close(ssim_map(picture, picture), torch.ones_like(picture))
    assert precision.fp32_precision == "ieee"


def test_convolutions_never_run_in_tf32(monkeypatch: pytest.MonkeyPatch, precision: Any):
    """E[x^2] - E[x]^2 cancels with ten bits of mantissa; neither value nor gradient may be computed so."""
    convolve = torch.nn.functional.conv2d

    def rounds_as_tensor_cores_do(x: torch.Tensor, weight: torch.Tensor, **options):
        if precision.fp32_precision == "tf32":
            x, weight = ((t.view(torch.int32) + 0x1000 & -0x2000).view(torch.float32) for t in (x, weight))
        return convolve(x, weight, **options)

    monkeypatch.setattr(torch.nn.functional, "conv2d", rounds_as_tensor_cores_do)
    precision.fp32_precision = "tf32"
    generator = torch.Generator().manual_seed(0)
    x = 0.7 + 0.02 * torch.rand(24, 32, 3, generator=generator)
    y = x + 0.004 * torch.rand(24, 32, 3, generator=generator)
    leaves = [x.requires_grad_(), y.requires_grad_()]
    wanted, found = ssim(*leaves), _ConvolutionSSIM.apply(*leaves)
    assert float(found.detach()) == pytest.approx(float(wanted.detach()), abs=1e-3)
    gradients = [torch.autograd.grad(value, leaves) for value in (found, wanted)]
    for one, other in zip(*gradients, strict=True):
        assert float((one - other).norm() / other.norm()) < 0.01
    assert precision.fp32_precision == "tf32"


def test_convolutions_stay_on_their_device():
    pictures = [torch.empty(9, 12, 3, device="meta", requires_grad=True) for _ in range(2)]
    value = ssim(*pictures)
    value.backward()
    assert value.device.type == "meta"
    assert [picture.grad.device.type for picture in pictures if picture.grad is not None] == ["meta", "meta"]


def test_cells_with_observations_are_proven_static():
    observations = torch.tensor([[10.5, 3.0], [59.9, 39.9]])
    proven = proven_static(observations, 40, 60)
    assert bool(proven[3, 10])
    assert bool(proven[39, 59])
    assert int(proven.sum()) == 2, "60 pixels have cells of one"
    assert int(proven_static(observations * 4, 160, 240).sum()) == 2 * 16
    assert not proven_static(torch.zeros(0, 2), 40, 60).any()


def test_proof_shows_what_evidence_would_hide():
    photo, _ = pictures(60, 60)
    render = photo.clone()
    render[20:40, 20:40] = 1 - render[20:40, 20:40]
    visibility = torch.full((60, 60), 0.9, dtype=torch.float64, requires_grad=True)
    proven = torch.zeros(60, 60, dtype=torch.bool)
    proven[20:40, 20:26] = True
    masked_photometric(photo, render, visibility, proven=proven).backward()
    gradient = visibility.grad[22:38]
    assert bool((gradient[:, 20:26] == -PROOF / 3600).all())
    assert float(gradient[:, 27:33].mean()) > 0.1 / 3600


def test_foregrounds_are_transient_whatever_their_colour():
    photo, _ = pictures(60, 60)
    visibility = torch.full((60, 60), 0.9, dtype=torch.float64, requires_grad=True)
    foreground = torch.zeros(20, 20, dtype=torch.float64)
    foreground[:, 10:] = 1
    proven = torch.zeros(60, 60, dtype=torch.bool)
    proven[50:] = True
    doubt = torch.zeros(4, 4, dtype=torch.float64)
    loss = masked_photometric(photo, photo, visibility, proven=proven, doubt=doubt, foreground=foreground)
    loss.backward()
    gradient = visibility.grad[:50]
    assert bool((gradient[:, :28] == 0).all())
    torch.testing.assert_close(gradient[:, 32:], torch.full((50, 28), FOREGROUND_EVIDENCE / 3600).double())
    assert bool((visibility.grad[50:] == -PROOF / 3600).all())
    assert float(loss.detach()) == pytest.approx(0, abs=1e-9), "evidence changed the value"


def lit_wall(surroundings: float, wall: tuple[float, float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """A photo with a wall of one colour, and a render of the same brightness as its surroundings with texture."""
    photo = torch.full((120, 160, 3), surroundings)
    photo[40:80, 40:120] = torch.tensor(wall)
    texture = 0.1 * torch.rand(120, 160, 1, generator=torch.Generator().manual_seed(0))
    return photo, torch.full_like(photo, max(surroundings, 0.1)) + texture


def test_a_floodlit_wall_at_night_is_not_transient():
    photo, render = lit_wall(0.05, (1.0, 0.9, 0.6))
    assert transient_evidence(photo, render)[45:75, 45:115].max() < 0.01


def test_bright_objects_by_day_and_dark_ones_at_night_are_transient():
    by_day, render = lit_wall(0.4, (1.0, 0.9, 0.2))
    assert transient_evidence(by_day, render)[45:75, 45:115].min() > 0.2
    at_night = torch.full((120, 160, 3), 0.05)
    wall = 0.05 + 0.6 * torch.rand(120, 160, 1, generator=torch.Generator().manual_seed(0)).expand(-1, -1, 3)
    render = at_night.clone()
    render[20:100] = wall[20:100] + 0.3
    at_night[20:100] = render[20:100]
    at_night[40:80, 60:80] = 0.02  # somebody in front of the lit wall
    at_night = torch.cat([at_night, torch.zeros(200, 160, 3)])
    render = torch.cat([render, torch.zeros(200, 160, 3)])
    evidence = transient_evidence(at_night, render)
    assert evidence[45:75, 65:75].min() > 0.2
    assert evidence[45:75, 100:150].max() < 0.05
