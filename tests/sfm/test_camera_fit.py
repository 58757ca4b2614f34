"""Residuals of a photo's camera and their derivatives."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.optimize import approx_fprime

from wildgs.sfm.camera_fit import CROPPED, STRETCHED, WHOLE, CameraFit

SCALE = 0.5


@pytest.fixture
def fit() -> CameraFit:
    """A stretched and cropped photo of a few points at random places."""
    random = np.random.default_rng(0)
    middle = np.array([0.2, -0.1, 6.0])
    return CameraFit(
        pixels=random.random((9, 2)) * [1024, 768],
        arms=random.uniform(-2, 2, (9, 3)),
        middle=middle,
        rotation=pycolmap.Rotation3d(),
        origin=middle,
        lens=np.array([1200.0, 530.0, 370.0, -0.05, 0.03]),
        center=np.array([512.0, 384.0]),
        side=1024.0,
        edge=0.3,
        scale=SCALE,
    )


@pytest.mark.parametrize("parameters", [WHOLE, CROPPED, STRETCHED])
@pytest.mark.parametrize("size", [0.0, 1e-6, 0.03, 0.4])
def test_residuals_have_the_derivatives_that_it_says(fit: CameraFit, parameters: int, size: float) -> None:
    changes = fit.start(parameters) + size * np.random.default_rng(1).uniform(-1, 1, parameters)
    found = fit.jacobian(changes)
    expected = approx_fprime(changes, fit.residuals, 1e-7)
    assert found.shape == (2 * len(fit.pixels) + 2, parameters)
    assert np.allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max(axis=0) + 1e-6)


def test_the_distance_of_a_centred_principal_point_has_a_derivative(fit: CameraFit) -> None:
    """It has none in mathematics; least squares needs a number."""
    assert np.isfinite(fit.jacobian(np.zeros(STRETCHED))).all()


@pytest.mark.parametrize("value", [-1e6, 0.0, 1e6])
def test_any_change_has_finite_residuals(fit: CameraFit, value: float) -> None:
    for parameter in (6, 10):
        changes = np.zeros(STRETCHED)
        changes[parameter] = value
        assert np.isfinite(fit.residuals(changes)).all()
        assert np.isfinite(fit.jacobian(changes)).all()


def test_loss_has_the_derivatives_that_it_says(fit: CameraFit) -> None:
    squared, step = np.linspace(0.1, 9.0, 12), 1e-5
    value, slope, curvature = fit.loss(squared)
    above, below = fit.loss(squared + step), fit.loss(squared - step)
    assert np.allclose((above[0] - below[0]) / (2 * step), slope, rtol=1e-5)
    assert np.allclose((above[1] - below[1]) / (2 * step), curvature, rtol=1e-4)
    assert (value > 0).all()
