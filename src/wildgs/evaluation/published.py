"""Published scores (table 1 of the paper), for comparison: Phototourism at half resolution, one RTX 3090."""

from __future__ import annotations

PHOTOTOURISM = ("brandenburg_gate", "sacre_coeur", "trevi_fountain")
"""Folder names of the scenes, as distributed."""

LABELS = {"nerf-w": "NeRF-W", "ha-nerf": "Ha-NeRF", "cr-nerf": "CR-NeRF"}
"""Labels of the table's methods that are not part of this package."""

_METRICS = ("psnr", "ssim", "lpips")
_TABLE: dict[str, tuple[float, ...]] = {
    # PSNR, SSIM, LPIPS of Brandenburg Gate, Sacre Coeur, Trevi Fountain; hours of training, frames per second
    "3dgs": (19.63, 0.8817, 0.1378, 17.95, 0.8455, 0.1633, 17.23, 0.6963, 0.2815, 0.12, 220),
    "nerf-w": (24.17, 0.8905, 0.1670, 19.20, 0.8076, 0.1915, 18.97, 0.6984, 0.2652, 60.3, 0.05),
    "ha-nerf": (24.04, 0.8873, 0.1391, 20.02, 0.8012, 0.1710, 20.18, 0.6908, 0.2225, 71.6, 0.05),
    "cr-nerf": (26.53, 0.9003, 0.1060, 22.07, 0.8233, 0.1520, 21.48, 0.7117, 0.2069, 101, 0.02),
    "wildgs-half-steps": (27.81, 0.9180, 0.1085, 23.85, 0.8567, 0.1575, 22.77, 0.7629, 0.2229, 0.23, 225),
    "wildgs": (29.65, 0.9333, 0.0951, 24.99, 0.8776, 0.1270, 24.45, 0.8081, 0.1622, 0.52, 227),
    "without-crop": (29.15, 0.9324, 0.0968, 24.93, 0.8761, 0.1323, 23.61, 0.7915, 0.1856, 0.85, 223),
    "without-reverse": (28.52, 0.9286, 0.1019, 24.37, 0.8623, 0.1379, 24.14, 0.8036, 0.1657, 0.47, 227),
    "without-global": (29.00, 0.9295, 0.1006, 24.82, 0.8761, 0.1309, 24.18, 0.8045, 0.1702, 0.53, 224),
    "without-mask": (28.85, 0.9292, 0.0981, 24.71, 0.8833, 0.1216, 23.91, 0.8063, 0.1590, 0.53, 205),
    "without-depth": (28.36, 0.9261, 0.1064, 23.36, 0.8573, 0.1672, 23.20, 0.7878, 0.1827, 0.48, 218),
}


def published_figures(scene: str, method: str) -> dict[str, float] | None:
    """Published figures of a scene and method, by the names of `metrics.json`; protocol `full`.

    Args:
        scene: One of `PHOTOTOURISM`.
        method: A method of `wildgs bench`, or of `LABELS`.

    Returns:
        ``psnr``, ``ssim``, ``lpips``, ``train_seconds`` and ``render_fps`` (the last two are the same for all
        three scenes); None if the table has no such row.
    """
    if scene not in PHOTOTOURISM or method not in _TABLE:
        return None
    row = _TABLE[method]
    first = 3 * PHOTOTOURISM.index(scene)
    figures = dict(zip(_METRICS, row[first : first + 3], strict=True))
    return figures | {"train_seconds": row[-2] * 3600, "render_fps": float(row[-1])}
