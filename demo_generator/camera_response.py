"""Camera response: from linear radiance to an 8-bit photo, different for each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True)
class CameraResponse:
    """Response of a camera.

    Attributes:
        exposure: Stops above (below) what the camera's meter proposes.
        white_balance: Gain of each channel.
        contrast: Exponent about middle grey in the display's space.
        saturation: 0 is grey, 1 leaves colours alone.
        vignetting: Share of light that is missing in the corners.
        noise: Standard deviation at full scale of the sensor's grain.
    """

    exposure: float
    white_balance: tuple[float, float, float]
    contrast: float
    saturation: float
    vignetting: float
    noise: float


def draw_response(rng: np.random.Generator, *, dark: bool) -> CameraResponse:
    """A random camera response; photos at dusk are darker and have more grain."""
    warm = rng.normal(0.0, 0.07)
    return CameraResponse(
        exposure=float(rng.uniform(-0.45, 0.45)) - 0.55 * dark,
        white_balance=(float(np.exp(warm)), float(np.exp(rng.normal(0.0, 0.02))), float(np.exp(-warm))),
        contrast=float(rng.uniform(0.92, 1.18)),
        saturation=float(rng.uniform(0.9, 1.25)),
        vignetting=float(rng.uniform(0.0, 0.35)),
        noise=float(rng.uniform(0.003, 0.01)) * (1.6 if dark else 1.0),
    )


def metered_gain(radiance: Float[np.ndarray, "H W 3"]) -> float:
    """Gain for medium brightness, centre-weighted like a light meter."""
    height, width = radiance.shape[:2]
    y, x = np.mgrid[:height, :width]
    weight = np.exp(-2.0 * ((x / width - 0.5) ** 2 + (y / height - 0.55) ** 2) / 0.3)
    luminance = radiance @ np.array([0.2126, 0.7152, 0.0722])
    return float(0.22 / np.exp(np.average(np.log(luminance + 1e-3), weights=weight)))


def develop(
    radiance: Float[np.ndarray, "H W 3"], gain: float, response: CameraResponse, seed: int
) -> UInt8[np.ndarray, "H W 3"]:
    """The 8-bit photo. The tone curve is Narkowicz's fit of ACES (2015); equal seeds give equal grain."""
    height, width = radiance.shape[:2]
    y, x = np.mgrid[:height, :width]
    corner = ((x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2) / (width**2 + height**2) * 4.0
    light = radiance * gain * 2.0**response.exposure * np.asarray(response.white_balance)
    light = 0.72 * light * (1.0 - response.vignetting * corner**1.3)[..., None]
    grey = light @ np.array([0.2126, 0.7152, 0.0722])
    light = np.maximum(grey[..., None] + response.saturation * (light - grey[..., None]), 0.0)
    tone = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    display = np.clip(tone, 0.0, 1.0) ** (1.0 / 2.2)
    display = np.where(display < 0.5, 0.5 * (2 * display) ** response.contrast, display)
    bright = 1.0 - 0.5 * np.maximum(2.0 * (1.0 - display), 0.0) ** response.contrast
    display = np.where(display < 0.5, display, bright)
    grain = np.random.default_rng(seed).normal(0.0, response.noise, display.shape)
    return np.round(np.clip(display + grain, 0.0, 1.0) * 255.0).astype(np.uint8)
