"""Lighting of one photo: sun and sky at a time of day, and street lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from demo_generator.sky_kernels import (
    CLOUD_COLOR,
    CLOUD_SEED,
    CLOUDS,
    GLOW,
    HORIZON,
    LAMPS,
    LIGHT_SIZE,
    SUN,
    SUN_COLOR,
    ZENITH,
)

_HEIGHTS = (-8.0, -2.0, 4.0, 12.0, 30.0, 70.0)
_ZENITH = (
    (0.03, 0.06, 0.17),
    (0.07, 0.13, 0.32),
    (0.15, 0.25, 0.47),
    (0.17, 0.32, 0.62),
    (0.16, 0.35, 0.76),
    (0.14, 0.34, 0.80),
)
_HORIZON = (
    (0.10, 0.11, 0.20),
    (0.40, 0.26, 0.26),
    (0.74, 0.50, 0.36),
    (0.72, 0.66, 0.60),
    (0.62, 0.74, 0.88),
    (0.58, 0.74, 0.94),
)
_GLOW = (
    (0.16, 0.06, 0.03),
    (0.70, 0.28, 0.08),
    (1.10, 0.52, 0.18),
    (0.90, 0.66, 0.38),
    (0.55, 0.52, 0.44),
    (0.40, 0.40, 0.38),
)
_EXTINCTION = np.array([0.11, 0.21, 0.42])


@dataclass(frozen=True)
class Light:
    """Sun, sky and lamps.

    Attributes:
        elevation: Of the sun, degrees above the horizon.
        azimuth: Of the sun, degrees from the landmark's front (-y), positive towards +x.
        overcast: Share of the sky that a closed cover hides, 0 to 1; it takes the sun's light away.
        clouds: Amount of single clouds, 0 to 1.
        cloud_seed: Which clouds.
        lamps: Strength of the evening lamps; 0 = off.
    """

    elevation: float
    azimuth: float
    overcast: float = 0.0
    clouds: float = 0.0
    cloud_seed: float = 0.0
    lamps: float = 0.0

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector towards the sun."""
        height, turn = np.deg2rad(self.elevation), np.deg2rad(self.azimuth)
        return np.array([np.cos(height) * np.sin(turn), -np.cos(height) * np.cos(turn), np.sin(height)])

    @property
    def sun_color(self) -> Float[np.ndarray, "3"]:
        """Irradiance of the sun over pi, reddened by the air in its way (Kasten and Young's air mass)."""
        if self.elevation <= 0.0:
            return np.zeros(3)
        mass = 1.0 / (np.sin(np.deg2rad(self.elevation)) + 0.50572 * (self.elevation + 6.07995) ** -1.6364)
        return 2.1 * np.exp(-_EXTINCTION * mass * 0.8) * (1.0 - self.overcast)

    def vector(self) -> Float[np.ndarray, " 21"]:
        """Parameters as the kernels read them."""
        light = np.zeros(LIGHT_SIZE)
        grey = 0.62 * np.clip((self.elevation + 8.0) / 50.0, 0.12, 1.0)
        cover = grey * np.array([0.95, 1.0, 1.06])
        light[SUN : SUN + 3] = self.direction
        light[SUN_COLOR : SUN_COLOR + 3] = self.sun_color
        light[ZENITH : ZENITH + 3] = self._mix(_ZENITH, 1.05 * cover)
        light[HORIZON : HORIZON + 3] = self._mix(_HORIZON, 0.85 * cover)
        light[GLOW : GLOW + 3] = self._mix(_GLOW, np.zeros(3))
        lit = 0.45 * self.sun_color + 0.75 * light[HORIZON : HORIZON + 3] + 0.1 * light[ZENITH : ZENITH + 3]
        light[CLOUD_COLOR : CLOUD_COLOR + 3] = lit
        light[CLOUDS], light[CLOUD_SEED], light[LAMPS] = self.clouds, self.cloud_seed, self.lamps
        return light

    def _mix(self, table: tuple[tuple[float, ...], ...], cover: np.ndarray) -> np.ndarray:
        values = np.asarray(table)
        clear = np.array([np.interp(self.elevation, _HEIGHTS, values[:, c]) for c in range(3)])
        return clear * (1.0 - self.overcast) + cover * self.overcast


def draw_light(kind: str, rng: np.random.Generator) -> Light:
    """A light of the given kind: "noon", "slant" (morning or afternoon), "golden", "overcast" or "dusk"."""
    seed = float(rng.uniform(0.0, 50.0))
    side = float(rng.choice([-1.0, 1.0]))
    clouds = float(rng.uniform(0.25, 0.8)) if rng.uniform() < 0.7 else 0.0
    if kind == "noon":
        return Light(rng.uniform(48, 66), side * rng.uniform(5, 50), 0.0, clouds, seed)
    if kind == "slant":
        return Light(rng.uniform(24, 42), side * rng.uniform(35, 85), 0.0, clouds, seed)
    if kind == "golden":
        return Light(rng.uniform(5, 12), side * rng.uniform(35, 80), 0.0, clouds, seed)
    if kind == "overcast":
        return Light(rng.uniform(25, 50), side * 40.0, rng.uniform(0.85, 1.0), 0.0, seed)
    if kind == "dusk":
        return Light(
            rng.uniform(-5.5, -2.0),
            side * rng.uniform(60, 120),
            0.0,
            0.5 * clouds,
            seed,
            rng.uniform(0.7, 1.0),
        )
    raise ValueError(f"no light of the kind {kind!r}")
