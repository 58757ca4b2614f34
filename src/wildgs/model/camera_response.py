"""The camera's response: vignetting and a tone curve, applied to the pixels of a render.

Not in the paper. Both belong to a photo's camera, not to the scene: exposure and white balance are the affine part
of a camera's response, which the colour match represents (`wildgs.model.color_match`). What remains are a gain that
depends on the distance from the optical axis and a curve per channel, as in PPISP (arXiv 2601.18336). They are
fitted to the photo in closed form with a prior on the identity, so that the mean appearance has none.

A response is a vector of 8 numbers, all zero for the identity:

- a1, a2 of the gain ``g = 1 + a1 r^2 + a2 r^4``, where r is the distance from the principal point, relative to that
  of the upper left corner;
- for each channel b1, b2 of the curve ``y = x + b1 x (1 - x) + b2 x (1 - x) (1 - 2 x)``. It maps 0 to 0 and 1 to 1
  and is monotone for ``|b1| + |b2| <= 1``.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.model.config import CameraResponseConfig

GAIN_TERMS, CURVE_TERMS = 2, 2
RESPONSE_SIZE = GAIN_TERMS + 3 * CURVE_TERMS
"""Numbers of a response."""
ROUNDS, TRAINING_ROUNDS = 5, 3
"""Iterations of Gauss-Newton and of the robust weights."""
RIDGE = 1e-4
"""Ridge regularisation towards the identity, in units of mean squared colour."""
OUTLIER = 0.1
"""Residual at which a pixel's weight is halved (Cauchy weights)."""
LEAST_PIXELS = 64
"""Smallest number of pixels for a fit."""
MOST_GAIN, MOST_CURVE = 0.6, 0.9
"""Limits of ``|a1| + |a2|`` and of ``|b1| + |b2|``, for a positive gain and a monotone curve."""


def squared_radius(
    camera: Camera, pixels: tuple[Int[Tensor, "*pixels"], Int[Tensor, "*pixels"]] | None = None
) -> Float[Tensor, "*pixels"]:
    """r^2 of pixel centres: 0 at the principal point, 1 at the upper left corner of the image.

    A crop that keeps this corner, such as the left half of a photo, has the same values as the photo.

    Args:
        camera: The camera.
        pixels: Rows and columns of the pixels; None for the whole image.
    """
    rays = camera.pixel_rays(pixels)[..., :2] * camera.K.diagonal()[:2]
    return rays.square().sum(dim=-1) / camera.K[:2, 2].square().sum().clamp_min(1)


def responded(
    colors: Float[Tensor, "*pixels 3"], radius: Float[Tensor, "*pixels"], response: Float[Tensor, " Q"]
) -> Float[Tensor, "*pixels 3"]:
    """Applies a response to rendered colours; outside [0, 1], the curve is the identity.

    Args:
        colors: Rendered colours.
        radius: From `squared_radius`.
        response: From `fit_response`.
    """
    gain, curve = response[:GAIN_TERMS], response[GAIN_TERMS:].reshape(3, CURVE_TERMS)
    exposed = colors * (1 + _powers(radius) @ gain)[..., None]
    x = exposed.clamp(0, 1)
    # Factored, which needs fewer passes over the pixels than a sum of terms.
    return exposed + x * (1 - x) * (curve[:, 0] + curve[:, 1] * (1 - 2 * x))


def _powers(radius: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels G"]:
    return torch.stack([radius, radius.square()], dim=-1)


@torch.no_grad()
def fit_response(
    config: CameraResponseConfig,
    render: Float[Tensor, "*pixels 3"],
    photo: Float[Tensor, "*pixels 3"],
    radius: Float[Tensor, "*pixels"],
    weights: Float[Tensor, "*pixels"],
    *,
    rounds: int = ROUNDS,
) -> Float[Tensor, " Q"]:
    """The response that best maps a render to its photo, by robust ridge regression (Gauss-Newton).

    There is no synchronisation with a GPU, since pixels are weighted instead of selected.

    Args:
        config: Which parts are fitted; the others remain zero.
        render: Colours under the photo's appearance, with its colour match.
        photo: RGB in [0, 1].
        radius: From `squared_radius`.
        weights: Weights of the pixels; values at pixels of weight 0 are not read.
        rounds: Number of iterations.

    Returns:
        The response; zero if too few pixels have a weight.
    """
    base = weights.reshape(-1).double()
    counts = base > 0
    colors, target = (
        torch.where(counts[:, None], x.reshape(-1, 3), 0).double() for x in (render.clamp(max=1), photo)
    )
    radius = radius.reshape(-1).double()
    fitted = torch.tensor([config.vignetting] * GAIN_TERMS + [config.curve] * 3 * CURVE_TERMS).to(colors)
    ridge = RIDGE * torch.eye(RESPONSE_SIZE).to(colors)
    response, trusted = colors.new_zeros(RESPONSE_SIZE), torch.where(counts, base, 0)
    for _ in range(rounds):
        residual = target - responded(colors, radius, response)
        terms = (_derivative(colors, radius, response) * fitted).flatten(0, 1)
        root = trusted.repeat_interleave(3)[:, None] / (3 * trusted.sum().clamp_min(1e-9))
        normal = terms.T @ (terms * root) + ridge
        right = (terms * root).T @ residual.reshape(-1) - RIDGE * response
        change = torch.linalg.solve_ex(normal, right[:, None]).result[:, 0]
        response = _limited(response + change)
        trusted = torch.where(counts, base / (1 + (residual.abs().mean(dim=1) / OUTLIER).square()), 0)
    usable = response.isfinite().all() & (counts.sum() >= LEAST_PIXELS)
    return torch.where(usable, response, 0).to(render.dtype)


def _derivative(
    colors: Float[Tensor, "P 3"], radius: Float[Tensor, " P"], response: Float[Tensor, " Q"]
) -> Float[Tensor, "P 3 Q"]:
    """Derivative of `responded` with respect to the response."""
    powers, curve = _powers(radius), response[GAIN_TERMS:].reshape(3, CURVE_TERMS)
    exposed = colors * (1 + powers @ response[:GAIN_TERMS])[:, None]
    x = exposed.clamp(0, 1)
    inside = (exposed > 0) & (exposed < 1)
    slope = 1 + inside * (curve[:, 0] * (1 - 2 * x) + curve[:, 1] * (1 - 6 * x + 6 * x * x))
    by_gain = (colors * slope)[..., None] * powers[:, None]
    bump = x * (1 - x)
    by_curve = torch.stack([bump, bump * (1 - 2 * x)], dim=-1)
    of_channel = torch.eye(3).to(colors)[:, :, None] * by_curve[:, :, None]
    return torch.cat([by_gain, of_channel.flatten(2)], dim=-1)


def _limited(response: Float[Tensor, " Q"]) -> Float[Tensor, " Q"]:
    """Shrinks coefficients to a positive gain and a monotone curve."""
    gain, curve = response[:GAIN_TERMS], response[GAIN_TERMS:].reshape(3, CURVE_TERMS)
    gain = gain * (MOST_GAIN / gain.abs().sum().clamp_min(MOST_GAIN))
    curve = curve * (MOST_CURVE / curve.abs().sum(dim=1, keepdim=True).clamp_min(MOST_CURVE))
    return torch.cat([gain, curve.reshape(-1)])


def static_weights(
    static: Bool[Tensor, "*pixels"],
    visibility: Float[Tensor, "*pixels"] | None,
    keep: Bool[Tensor, "*pixels"] | None,
) -> Float[Tensor, "*pixels"]:
    """Weights of pixels in a fit: M at static pixels that the user's mask does not ignore.

    Args:
        static: Static pixels that the render covers.
        visibility: M; None for 1.
        keep: The user's mask; None for all pixels.
    """
    weights = static.float() if visibility is None else visibility * static
    return weights if keep is None else weights * keep
