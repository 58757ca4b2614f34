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

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.model.config import CameraResponseConfig
from wildgs.model.response_kernels import respond
from wildgs.threads import launch

GAIN_TERMS, CURVE_TERMS = 2, 2
RESPONSE_SIZE = GAIN_TERMS + 3 * CURVE_TERMS
"""Numbers of a response."""
ROUNDS, TRAINING_ROUNDS = 5, 2
"""Iterations of Gauss-Newton and of the robust weights."""
TRAINING_PIXELS = 1024
"""Number of pixels that a fit in training reads at most, approximately."""
RIDGE = 1e-4
"""Ridge regularisation towards the identity, in units of mean squared colour."""
OUTLIER = 0.1
"""Residual at which a pixel's weight is halved (Cauchy weights)."""
LEAST_PIXELS = 64
"""Smallest number of pixels for a fit."""
MOST_GAIN, MOST_CURVE = 0.6, 0.9
"""Limits of ``|a1| + |a2|`` and of ``|b1| + |b2|``, for a positive gain and a monotone curve."""


def squared_radius(camera: Camera, every: int = 1) -> Float[Tensor, "h w"]:
    """r^2 of pixel centres: 0 at the principal point, 1 at the upper left corner of the image.

    A crop that keeps this corner, such as the left half of a photo, has the same values as the photo.

    Args:
        camera: The camera.
        every: Distance of the rows and columns that are wanted.
    """
    center = camera.K[:2, 2]
    x, y = (torch.arange(0, size, every).to(center) + 0.5 for size in (camera.width, camera.height))
    squares = (y - center[1]).square()[:, None] + (x - center[0]).square()
    return squares / center.square().sum().clamp_min(1)


def sample_distance(height: int, width: int) -> int:
    """Distance of the rows and columns of a picture that a fit in training reads."""
    return max(math.ceil(math.sqrt(height * width / TRAINING_PIXELS)), 1)


def responded(
    colors: Float[Tensor, "*pixels 3"], radius: Float[Tensor, "*pixels"], response: Float[Tensor, " Q"]
) -> Float[Tensor, "*pixels 3"]:
    """Applies a response to rendered colours; outside [0, 1], the curve is the identity.

    Gradients reach the colours, not the response.

    Args:
        colors: Rendered colours.
        radius: From `squared_radius`.
        response: From `fit_response`.
    """
    applied: Tensor = _Responded.apply(colors, radius, response)
    return applied


class _Responded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, radius: Tensor, response: Tensor) -> Tensor:
        ctx.save_for_backward(colors, radius, response)
        if colors.device.type == "cpu":
            return _on_cpu(colors, radius, response, None)
        exposed = colors * _gain(radius, response[:GAIN_TERMS])[..., None]
        return _curved(exposed, *response[GAIN_TERMS:].reshape(3, CURVE_TERMS).T)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        colors, radius, response = ctx.saved_tensors
        if colors.device.type == "cpu":
            return _on_cpu(colors, radius, response, gradients[0]), None, None
        gain = _gain(radius, response[:GAIN_TERMS])[..., None]
        slope = _slope(colors * gain, *response[GAIN_TERMS:].reshape(3, CURVE_TERMS).T)
        return slope * gain * gradients[0], None, None


def _on_cpu(colors: Tensor, radius: Tensor, response: Tensor, gradient: Tensor | None) -> Tensor:
    flat = [x.detach().float().reshape(-1).numpy() for x in (colors, radius, response)]
    out = torch.empty(colors.shape)
    slopes = flat[0] if gradient is None else gradient.float().reshape(-1).numpy()
    launch(respond, *flat, slopes, gradient is not None, out.view(-1).numpy())
    return out.to(colors.dtype)


def _gain(radius: Float[Tensor, "*pixels"], gain: Float[Tensor, " G"]) -> Float[Tensor, "*pixels"]:
    return 1 + radius * (gain[0] + gain[1] * radius)


def _curved(exposed: Float[Tensor, "*colors"], first: Tensor, second: Tensor) -> Float[Tensor, "*colors"]:
    """Tone curves; coefficients are broadcast over the colours."""
    x = exposed.clamp(0, 1)
    return torch.addcmul(exposed, x - x * x, first + second * (1 - 2 * x))


def _slope(exposed: Float[Tensor, "*colors"], first: Tensor, second: Tensor) -> Float[Tensor, "*colors"]:
    """Derivative of `_curved` with respect to exposed colours."""
    x = exposed.clamp(0, 1)
    return torch.where(x == exposed, 1 + first * (1 - 2 * x) + second * (1 + 6 * (x * x - x)), 1)


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
    base = weights.reshape(-1)
    counts = base > 0
    colors, target = (
        torch.where(counts, x.reshape(-1, 3).T, 0).contiguous() for x in (render.clamp(max=1), photo)
    )
    base, radius = torch.where(counts, base, 0), radius.reshape(-1)
    fitted = torch.tensor([config.vignetting] * GAIN_TERMS + [config.curve] * CURVE_TERMS).to(colors)
    response, trusted = colors.new_zeros(RESPONSE_SIZE), base
    for _ in range(rounds):
        curve = response[GAIN_TERMS:].reshape(3, CURVE_TERMS).T[:, :, None]
        exposed = colors * _gain(radius, response[:GAIN_TERMS])
        residual = target - _curved(exposed, *curve)
        terms = _derivative(colors, radius, exposed, curve) * fitted[:, None]
        weighted = terms * (trusted / (3 * trusted.sum().clamp_min(1e-9)))
        normal, right = _assembled(weighted @ terms.mT, (weighted @ residual[:, :, None])[..., 0])
        normal.diagonal().add_(RIDGE)
        change = torch.linalg.solve_ex(normal, (right - RIDGE * response)[:, None]).result[:, 0]
        response = _limited(response + change)
        trusted = base / (1 + (residual.abs().mean(dim=0) / OUTLIER).square())
    usable = response.isfinite().all() & (counts.sum() >= LEAST_PIXELS)
    return torch.where(usable, response, 0).to(render.dtype)


def _derivative(
    colors: Float[Tensor, "3 P"],
    radius: Float[Tensor, " P"],
    exposed: Float[Tensor, "3 P"],
    curve: Float[Tensor, "C 3 1"],
) -> Float[Tensor, "3 T P"]:
    """Derivatives of each channel with respect to the gain and to the channel's own curve."""
    by_first = colors * _slope(exposed, *curve) * radius
    x = exposed.clamp(0, 1)
    bump = x - x * x
    return torch.stack([by_first, by_first * radius, bump, bump * (1 - 2 * x)], dim=1)


def _assembled(
    normal: Float[Tensor, "3 T T"], right: Float[Tensor, "3 T"]
) -> tuple[Float[Tensor, "Q Q"], Float[Tensor, " Q"]]:
    """One system for the common gain and the three curves, from one system per channel."""
    g = GAIN_TERMS
    curves = torch.block_diag(*normal[:, g:, g:])
    across = torch.cat(list(normal[:, :g, g:]), dim=1)
    gain = normal[:, :g, :g].sum(dim=0)
    system = torch.cat([torch.cat([gain, across], dim=1), torch.cat([across.T, curves], dim=1)])
    return system, torch.cat([right[:, :g].sum(dim=0), right[:, g:].reshape(-1)])


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
