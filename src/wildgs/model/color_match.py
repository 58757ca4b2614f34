"""Matching a scene's colours to a photo: what the embedding missed of its exposure and colour cast.

Not in the paper. A network that has seen some ninety photos guesses a new photo's light, and the photo itself says
how far off the guess is. NeRF-W's line of work optimises the embedding of a new photo for that; an affine map of
colours is found in closed form, from one render, and brings most of what many steps of optimisation bring.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.sky import Sky
from wildgs.model.wrapping import MIN_ALPHA, liftable
from wildgs.rasterize import Rendering

ROUNDS, TRAINING_ROUNDS = 6, 3
"""Of reweighting."""
RIDGE = 3e-4
"""Of the least squares, in units of mean squared colour: what a photo does not tell stays as it was."""
OUTLIER = 0.05
"""Residual at which a pixel counts half (Cauchy's weights): passers-by that the mask has missed."""
LEAST_PIXELS = 64
"""Fewer say nothing about a photo's light."""

ELEVATION_ORDERS = 2
"""Powers of the sine of the elevation by which the sky's colours are matched: it is paler near the horizon."""
SKY_COLUMNS = 4 + ELEVATION_ORDERS
"""Columns of the sky's change: [A | b] and one for each power."""


def elevation_powers(sine: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch E"]:
    """What the sky's change multiplies its further columns with."""
    return torch.stack([sine ** (order + 1) for order in range(ELEVATION_ORDERS)], dim=-1)


def mapped(
    harmonics: Float[Tensor, "V K 3"],
    change: Float[Tensor, "3 4"],
    offset: Float[Tensor, "V 3"] | float = 0.0,
) -> Float[Tensor, "V K 3"]:
    """Spherical harmonics of colours ``c + A c + b + offset``, by the harmonics of c.

    Args:
        harmonics: Around grey, as `wildgs.rasterize.sh_to_colors` takes them.
        change: [A | b].
        offset: Of every Gaussian's colour.
    """
    matrix = torch.eye(3, dtype=change.dtype, device=change.device) + change[:, :3]
    flat = rgb_to_sh0(matrix @ torch.full_like(change[:, 3], 0.5) + change[:, 3] + offset)
    turned = harmonics @ matrix.T
    return torch.cat([turned[:, :1] + flat.reshape(-1, 1, 3), turned[:, 1:]], dim=1)


@torch.no_grad()
def match_photo(
    photo: Float[Tensor, "*pixels 3"],
    rendering: Rendering,
    visibility: Float[Tensor, "*pixels"] | None,
    keep: Bool[Tensor, "*pixels"] | None,
    *,
    threshold: float,
    sky: Sky | None,
    codes: Float[Tensor, "*pixels L"],
    training: bool = False,
) -> Float[Tensor, "3 M"]:
    """The change that takes a render's colours to its photo's, for the landmark and the sky apart.

    Photos are full of sky: one change for all would do to the landmark what the sky needs.

    Args:
        photo: In 0..1.
        rendering: From the photo's camera.
        visibility: M; of the sky, all pixels that are covered count.
        keep: The user's own mask: pixels that are False do not count.
        threshold: Th: pixels with a visibility above it are static.
        sky: Which pixels show it; None matches all pixels alike.
        codes: Rendered light codes of the landmark, on which its change depends linearly; L may be 0.
        training: Gives each channel a gain of its own, no more.

    Returns:
        Change [A | b | W] of the landmark: colours c become ``c + A c + b + W codes``; with a sky, its change
        [A | b | E] beside it: ``c + A c + b + E @ elevation_powers(sine)``. Zero where too little is seen.
    """
    static = liftable(visibility, rendering.alpha, threshold)
    covered = rendering.alpha > MIN_ALPHA
    if keep is not None:
        static, covered = static & keep, covered & keep
    weights = static.float() if visibility is None else visibility * static
    ones = torch.ones_like(weights)[..., None]
    regions = [(weights if sky is None else weights * ~sky.which, torch.cat([ones, codes], dim=-1))]
    if sky is not None:
        elevated = torch.cat([ones, elevation_powers(sky.sine)], dim=-1)
        regions.append(((covered & sky.which).float(), elevated))
    return torch.cat(_fitted(rendering.colors, photo, regions, training), dim=1)


def changed_harmonics(
    harmonics: Float[Tensor, "V K 3"],
    change: Float[Tensor, "3 M"],
    sky: Sky | None,
    codes: Float[Tensor, "V L"],
) -> Float[Tensor, "V K 3"]:
    """The harmonics of changed colours.

    Args:
        harmonics: Around grey, as `wildgs.rasterize.sh_to_colors` takes them.
        change: From `match_photo`.
        sky: Which Gaussians stand for it; None as in `match_photo`.
        codes: Their light codes.
    """
    own, by_code, of_sky, by_elevation = split_change(change, codes.shape[1])
    below = mapped(harmonics, own, codes @ by_code.T)
    if sky is None:
        return below
    above = mapped(harmonics, of_sky, elevation_powers(sky.sine) @ by_elevation.T)
    return torch.where(sky.which[:, None, None], above, below)


def split_change(change: Float[Tensor, "3 M"], codes: int) -> tuple[Tensor, ...]:
    """[A | b] of the landmark and what its codes change, the same of the sky and its elevation."""
    return change.tensor_split((4, 4 + codes, 8 + codes), dim=1)


def _fitted(
    render: Float[Tensor, "*pixels 3"],
    photo: Float[Tensor, "*pixels 3"],
    regions: Sequence[tuple[Float[Tensor, "*pixels"], Float[Tensor, "*pixels _"]]],
    training: bool,
) -> list[Float[Tensor, "3 _"]]:
    """Robust least squares of the photo's difference from the render by the render's colours and further terms.

    In training each channel has a gain of its own and no share in the others. With all nine numbers, training lost
    the colours of materials: errors of the render weaken what the fit makes of a hue, which then is not learnt.

    Nothing in it waits for a GPU: pixels that do not count are weighted, not selected. All regions, and channels
    that have a gain of their own, are solved at once, in few operations, since each is small.

    Args:
        render: Colours.
        photo: Likewise.
        regions: Of each, the weights of pixels, and further terms, of which the first is 1.
        training: Whether each channel has a gain of its own.
    """
    sizes = [further.shape[-1] for _, further in regions]
    weights = torch.stack([weight.reshape(-1) for weight, _ in regions])
    # A term that a region lacks is 0, and so is its coefficient.
    padded = [functional.pad(further, (0, max(sizes) - further.shape[-1])) for _, further in regions]
    further = torch.stack(padded).reshape(len(regions), 1, weights.shape[1], max(sizes))
    colors = render.reshape(-1, 3).clamp(max=1)
    residual = photo.reshape(-1, 3) - colors
    # Axes: regions, sets of channels that are solved together, pixels, terms and residuals.
    parts = (colors.T[..., None], residual.T[..., None]) if training else (colors[None], residual[None])
    sets, own = parts[0].shape[0], parts[0].shape[2]
    sides = (*further.shape[:1], sets, len(colors), -1)
    columns = [parts[0].expand(sides), further.expand(sides), parts[1].expand(sides)]
    counts = weights > 0
    table = torch.where(counts[:, None, :, None], torch.cat(columns, dim=3), 0).double()
    terms, residuals = table[..., :-own], table[..., -own:]
    ridge = RIDGE * torch.eye(terms.shape[3], table.shape[3], dtype=table.dtype, device=table.device)
    base = torch.where(counts, weights, 0).double()
    change, trusted = table.new_zeros(()), base
    for round_ in range(rounds := TRAINING_ROUNDS if training else ROUNDS):
        sums = (terms * trusted[:, None, :, None]).mT @ table
        # The term that is 1, squared and summed, is the sum of weights.
        normal = torch.addcdiv(ridge, sums, sums[..., own : own + 1, own : own + 1])
        change = torch.linalg.solve_ex(normal[..., :-own], normal[..., -own:]).result
        if round_ < rounds - 1:
            error = (residuals - terms @ change).abs().mean(dim=(1, 3))
            trusted = base / (1 + (error / OUTLIER).square())
    if training:
        found = torch.cat([change[:, :, 0, 0].diag_embed(), change[:, :, 1:, 0]], dim=2)
    else:
        found = change[:, 0].mT
    usable = found.isfinite().flatten(1).all(dim=1) & (counts.sum(dim=1) >= LEAST_PIXELS)
    found = torch.where(usable[:, None, None], found.float(), 0)
    return [each[:, : 3 + size] for each, size in zip(found, sizes, strict=True)]
