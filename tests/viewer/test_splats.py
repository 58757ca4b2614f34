"""What the browser gets is what the rasteriser has."""

from __future__ import annotations

import numpy as np
import torch

from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.gaussians import Gaussians
from wildgs.viewer.display import ENLARGED, colors_from, distances_from, splats_of


def gaussians(count: int = 6) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    return Gaussians(
        {
            "means": torch.randn(count, 3, generator=generator),
            "quats": torch.randn(count, 4, generator=generator),
            "log_scales": torch.randn(count, 3, generator=generator) - 5,
            "opacity_logits": torch.zeros(count),
        }
    )


def test_covariances_have_the_gaussians_axes_and_scales() -> None:
    made = gaussians()
    splats = splats_of(made)
    for row in range(len(made)):
        axes = quats_to_rotations(made.quats[row : row + 1])[0].detach().numpy()
        along = axes.T @ splats.covariances[row] @ axes
        expected = np.diag((ENLARGED * made.scales[row].detach().numpy()) ** 2)
        np.testing.assert_allclose(along, expected, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(splats.centers, ENLARGED * made.means.detach().numpy(), rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, 0.5)


def test_what_no_picture_shows_is_left_out() -> None:
    made = gaussians()
    with torch.no_grad():
        made.rows["opacity_logits"][0] = torch.tensor(0.5 / 255).logit()
        made.rows["means"][2, 1] = float("nan")
        made.rows["log_scales"][3, 0] = float("inf")
    splats = splats_of(made)
    assert splats.rows.tolist() == [1, 4, 5]
    assert np.isfinite(splats.covariances).all()


def test_enlarging_keeps_thin_gaussians_in_half_precision() -> None:
    """A Gaussian as wide as a pixel at the usual depth has a variance of 1e-6, of which halves know 16 steps."""
    variance = np.float64(1.28e-6)
    plain = float(np.float16(variance))
    enlarged = float(np.float16(variance * ENLARGED**2)) / ENLARGED**2
    assert abs(plain - variance) > 0.01 * variance
    assert abs(enlarged - variance) < 0.001 * variance


def test_huge_gaussians_stay_finite_in_half_precision() -> None:
    made = gaussians()
    with torch.no_grad():
        made.rows["log_scales"][:] = 6.0
    assert np.isfinite(splats_of(made).covariances.astype(np.float16)).all()


def test_colours_depend_on_where_the_eye_is() -> None:
    means = torch.tensor([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0]])
    sh = torch.zeros(2, 16, 3)
    sh[:, 3, 0] = 0.5  # red along -x
    left = colors_from(means, sh, torch.tensor([-1.0, 1.0, 0.0]), 3)
    right = colors_from(means, sh, torch.tensor([1.0, 1.0, 0.0]), 3)
    assert left[0, 0] < 0.3 < 0.7 < right[0, 0]
    assert left[1, 0] > left[0, 0], "the farther one is seen at another angle"
    flat = colors_from(means, sh, torch.tensor([-1.0, 1.0, 0.0]), 0)
    np.testing.assert_allclose(flat, 0.5)


def test_distances_are_from_the_eye() -> None:
    means = torch.tensor([[0.0, 1.0, 0.0], [3.0, 4.0, 0.0]])
    np.testing.assert_allclose(distances_from(means, torch.zeros(3)), [1.0, 5.0])
