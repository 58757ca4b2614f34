"""Matching a scene's colours to a photo: what the embedding missed of its exposure and colour cast.

Not in the paper. A network that has seen some ninety photos guesses a new photo's light, and the photo itself says
how far off the guess is. NeRF-W's line of work optimises the embedding of a new photo for that; an affine map of
colours is found in closed form, from one render, and brings most of what many steps of optimisation bring.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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
def match_colors(
    render: Float[Tensor, "H W 3"],
    photo: Float[Tensor, "H W 3"],
    weights: Float[Tensor, "H W"],
    training: bool = False,
    codes: Float[Tensor, "H W L"] | None = None,
) -> Float[Tensor, "3 M"]:
    """The affine map of colours that takes a render to its photo, by robust least squares.

    Args:
        render: In 0..1, more where the scene is brighter than white, less where it is below black.
        photo: In 0..1.
        weights: Of the pixels, 0 or more; 0 where something stands in the way.
        training: Whether each channel has a gain of its own and no share in the others.
        codes: Further terms; None for none.

    Returns:
        Change [A | b | W]: colours c become ``c + A c + b + W codes``. Zero where too little of the scene is seen.
    """
    further = torch.ones_like(weights)[..., None]
    if codes is not None:
        further = torch.cat([further, codes], dim=2)
    return _fitted(render, photo, weights, further, training)


@torch.no_grad()
def match_photo(
    photo: Float[Tensor, "H W 3"],
    rendering: Rendering,
    visibility: Float[Tensor, "H W"] | None,
    keep: Bool[Tensor, "H W"] | None,
    *,
    threshold: float,
    sky: Sky | None,
    codes: Float[Tensor, "H W L"],
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
        As `match_colors`, [A | b | W]; with a sky, that of `match_sky` beside it.
    """
    static = liftable(visibility, rendering.alpha, threshold)
    covered = rendering.alpha > MIN_ALPHA
    if keep is not None:
        static, covered = static & keep, covered & keep
    weights = static.float() if visibility is None else visibility * static
    colors = rendering.colors
    if sky is None:
        return match_colors(colors, photo, weights, training, codes)
    own = match_colors(colors, photo, weights * ~sky.which, training, codes)
    of_sky = match_sky(colors, photo, (covered & sky.which).float(), sky.sine, training)
    return torch.cat([own, of_sky], dim=1)


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


@torch.no_grad()
def match_sky(
    render: Float[Tensor, "H W 3"],
    photo: Float[Tensor, "H W 3"],
    weights: Float[Tensor, "H W"],
    sine: Float[Tensor, "H W"],
    training: bool = False,
) -> Float[Tensor, "3 M"]:
    """As `match_colors`, for the sky: the change may vary smoothly with the elevation.

    Args:
        render: In 0..1, more where the scene is brighter than white, less where it is below black.
        photo: In 0..1.
        weights: Of the pixels; 0 where there is no sky.
        sine: Of the elevation at which a pixel shows the sky.
        training: Whether each channel has a gain of its own and no share in the others.

    Returns:
        Change [A | b | E]: colours c become ``c + A c + b + E @ elevation_powers(sine)``.
    """
    further = torch.cat([torch.ones_like(sine)[..., None], elevation_powers(sine)], dim=-1)
    return _fitted(render, photo, weights, further, training)


def _fitted(
    render: Tensor, photo: Tensor, weights: Tensor, further: Float[Tensor, "H W F"], training: bool
) -> Float[Tensor, "3 M"]:
    """Robust least squares of the photo's difference from the render by the render's colours and further terms.

    In training each channel has a gain of its own and no share in the others. With all nine numbers, training lost
    the colours of materials: errors of the render weaken what the fit makes of a hue, which then is not learnt.

    Nothing in it waits for a GPU: pixels that do not count are weighted, not selected.
    """
    counts = (weights > 0).reshape(-1)
    base = torch.where(counts, weights.reshape(-1), 0).double()
    colors = torch.where(counts[:, None], render.reshape(-1, 3).clamp(max=1), 0).double()
    residual = torch.where(counts[:, None], photo.reshape(-1, 3), 0).double() - colors
    further = further.reshape(len(colors), -1).double()
    # A leading axis of problems: one of three channels, or one for each channel.
    if training:
        terms = torch.cat([colors.T[..., None], further.expand(3, -1, -1)], dim=2)
        residual = residual.T[..., None]
    else:
        terms, residual = torch.cat([colors, further], dim=1)[None], residual[None]
    ridge = RIDGE * torch.eye(terms.shape[2], dtype=terms.dtype, device=terms.device)
    change, trusted = terms.new_zeros(()), base
    for _ in range(TRAINING_ROUNDS if training else ROUNDS):
        weighted = terms.mT * (trusted / trusted.sum())
        change = torch.linalg.solve_ex(weighted @ terms + ridge, weighted @ residual).result
        error = (residual - terms @ change).abs().mean(dim=(0, 2))
        trusted = base * OUTLIER**2 / (OUTLIER**2 + error.square())
    found = torch.cat([change[:, 0, 0].diag(), change[:, 1:, 0]], dim=1) if training else change[0].T
    usable = found.isfinite().all() & (counts.sum() >= LEAST_PIXELS)
    return torch.where(usable, found.float(), 0).contiguous()
