"""Public functions of the rasteriser: argument checks and dispatch to a backend."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import num_sh_bases
from wildgs.rasterize.interface import EPS2D, TILE, BackendName, Projection, Rendering


def pick_backend(device: torch.device | str) -> BackendName:
    """Default backend for tensors on a device: `cuda` (gsplat) for CUDA, else `cpu`."""
    return "cuda" if torch.device(device).type == "cuda" else "cpu"


def _module(name: BackendName):
    if name == "cpu":
        from wildgs.rasterize import cpu as module
    elif name == "cuda":
        from wildgs.rasterize import cuda as module
    elif name == "reference":
        from wildgs.rasterize import reference as module
    else:
        raise ValueError(f"unknown rasteriser backend {name!r}; choose 'cpu', 'cuda' or 'reference'")
    return module


def _check(
    name: str, tensor: Tensor, shape: tuple[int | None, ...], like: Tensor, backend: BackendName
) -> None:
    """Checks the shape (None: any size), device and dtype of an input."""
    fits = tensor.dim() == len(shape) and all(
        s in (None, t) for s, t in zip(shape, tensor.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("*" if s is None else str(s) for s in shape)
        raise ValueError(f"{name} has shape {list(tensor.shape)}, expected [{wanted}]")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(
            f"{name} is {tensor.dtype} on {tensor.device}, but the means are {like.dtype} on {like.device}"
        )
    if backend != "reference" and tensor.dtype != torch.float32:
        raise ValueError(
            f"{name} is {tensor.dtype}; the backend {backend!r} needs float32 ('reference' accepts float64 too)"
        )
    if backend == "cpu" and tensor.device.type != "cpu":
        raise ValueError(f"{name} is on {tensor.device}; the backend 'cpu' needs tensors on the CPU")


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    camera: Camera,
    *,
    backend: BackendName | None = None,
    near: float = 0.01,
    absgrad: bool = False,
    eps2d: float = EPS2D,
    antialiased: bool = False,
) -> Projection:
    """Projects Gaussians into a camera and sorts them into tiles, for any number of `blend` calls.

    Semantics are those of gsplat 1.5 (`rasterize_mode`). A Gaussian is culled (radius 0,
    no gradient) if it lies in front of the near plane, touches no pixel, has an opacity below 1/255, or has a
    non-finite parameter.

    Args:
        means: Centres, world units.
        quats: Orientations (wxyz); they need not be normalised.
        scales: Standard deviations along the principal axes, world units, linear (no logarithm).
        opacities: In [0, 1]; larger values are clamped to 1.
        camera: The camera; it receives no gradient.
        backend: The implementation; None selects `cuda` for tensors on CUDA and `cpu` otherwise.
        near: Near plane: depth in world units up to which Gaussians are culled.
        absgrad: Collect absolute screen gradients in `Projection.absgrad` during the backward pass.
        eps2d: Added to the diagonal of the 2D covariances, square pixels.
        antialiased: Multiply opacities by sqrt(det before / det after adding eps2d), so that the filter does not
            enlarge small Gaussians (the 2D filter of Mip-Splatting, Yu et al. 2024; gsplat's "antialiased" mode).
            False is gsplat's "classic" mode.

    Raises:
        ValueError: Shapes, devices or dtypes do not match, or the backend is unknown.
        UserError: The backend is not installed.
    """
    backend = backend or pick_backend(means.device)
    module = _module(backend)
    n = means.shape[0] if means.dim() else 0
    for name, tensor, shape in (
        ("means", means, (n, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)),
    ):
        _check(name, tensor, shape, means, backend)
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"the camera's image has no pixels: {camera.width} x {camera.height}")
    return module.project(means, quats, scales, opacities, camera, near, absgrad, eps2d, antialiased)


def blend(
    projection: Projection,
    colors: Float[Tensor, "N C"] | None,
    *,
    background: Float[Tensor, "C"] | None = None,
    depth: bool = True,
) -> Rendering:
    """Alpha-blends per-Gaussian values front to back over a projection's tile lists.

    Gradients flow to the colours, the background and the projection's means2d, conics, depths and opacities. If no
    gradient is required (`torch.no_grad()`), nothing is saved for a backward pass.

    Args:
        projection: From `project`; may be blended several times.
        colors: Any number of channels per Gaussian; None for depth and alpha only.
        background: Colour behind the Gaussians; black if None.
        depth: Whether to render expected depth too.

    Raises:
        ValueError: Shapes, devices or dtypes do not match.
    """
    means2d = projection.means2d
    if colors is None:
        colors = means2d.new_zeros(len(means2d), 0)
    _check("colors", colors, (len(means2d), None), means2d, projection.backend)
    if background is not None:
        _check("background", background, (colors.shape[1],), means2d, projection.backend)
    return _module(projection.backend).blend(projection, colors, background, depth)


@torch.no_grad()
def blend_sample(
    projection: Projection, colors: Float[Tensor, "N C"], *, tiles: int, every: int
) -> tuple[Rendering, tuple[Int[Tensor, " P"], Int[Tensor, " P"]]]:
    """Renders a sample of pixels spread over the image, for statistics; without gradient and background.

    Only randomly chosen tiles are blended (torch's global random state).

    Args:
        projection: From `project`.
        colors: Any number of channels per Gaussian.
        tiles: Approximate number of tiles.
        every: Stride of the sampled rows and columns within a tile.

    Returns:
        The rendering of P pixels, and their rows and columns.

    Raises:
        ValueError: Shapes, devices or dtypes do not match.
    """
    means2d, camera = projection.means2d, projection.camera
    _check("colors", colors, (len(means2d), None), means2d, projection.backend)
    step = _diagonal_step(camera.width, camera.height, tiles)
    first = int(float(torch.rand(())) * step)
    chosen, at = _sampled(camera.width, camera.height, step, first, every, means2d.device)
    picture = _module(projection.backend).blend_tiles(projection, colors, chosen)
    pictures = (picture.colors, picture.depth, picture.alpha)
    return Rendering(*(values[at[0], at[1]] for values in pictures)), (at[0], at[1])


def _diagonal_step(width: int, height: int, tiles: int) -> int:
    """The distance of diagonals of tiles that together have about `tiles` tiles."""
    return max(1, -(-height // TILE) * -(-width // TILE) // tiles)


@lru_cache(maxsize=512)
def _sampled(
    width: int, height: int, step: int, first: int, every: int, device: torch.device
) -> tuple[Bool[Tensor, "R S"], Int[Tensor, "2 P"]]:
    """Every step-th diagonal of tiles, and rows and columns of every `every`-th pixel in them.

    Diagonals, so that every row and column of tiles is sampled. Kept, since they recur in every step.
    """
    diagonal = np.add.outer(np.arange(-(-height // TILE)), np.arange(-(-width // TILE))) + first
    chosen = diagonal % step == 0
    corners = TILE * np.argwhere(chosen)[:, None]
    offsets = np.arange(every // 2, TILE, every)
    inside = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1).reshape(1, -1, 2)
    pixels = (corners + inside).reshape(-1, 2)
    pixels = pixels[(pixels < (height, width)).all(axis=1)]
    return torch.from_numpy(chosen).to(device), torch.from_numpy(pixels.T.copy()).to(device)


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    *,
    degree: int,
    visible: Bool[Tensor, "N"] | None = None,
    clamped: bool = True,
) -> Float[Tensor, "N 3"]:
    """View-dependent colours of Gaussians: max(0, spherical harmonics + 0.5), as in 3DGS and gsplat.

    Args:
        means: Centres, world units; the viewing direction is from the camera's centre to them. Differentiable.
        sh: Coefficients, at least (degree + 1)^2 per channel; further ones are ignored. Differentiable.
        camera: The camera.
        degree: 0 to 3.
        visible: Mask of the Gaussians to compute (`Projection.visible`); others get colour 0 and no gradient. None
            computes all.
        clamped: Whether to clamp negative colours to 0.

    Raises:
        ValueError: Shapes or dtypes do not match, or the degree is not supported.
    """
    backend = pick_backend(means.device)
    bases = num_sh_bases(degree)
    if backend == "cpu" and means.dtype == torch.float64:
        backend = "reference"
    _check("means", means, (None, 3), means, backend)
    _check("sh", sh, (len(means), None, 3), means, backend)
    if sh.shape[1] < bases:
        raise ValueError(f"sh has {sh.shape[1]} coefficients per channel, degree {degree} needs {bases}")
    if visible is not None and visible.shape != means.shape[:1]:
        raise ValueError(f"visible has shape {list(visible.shape)}, expected [{len(means)}]")
    return _module(backend).sh_to_colors(means, sh, camera, degree, visible, clamped)


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    colors: Float[Tensor, "N C"] | Float[Tensor, "N K 3"],
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Float[Tensor, "C"] | None = None,
    backend: BackendName | None = None,
    near: float = 0.01,
    depth: bool = True,
    eps2d: float = EPS2D,
    antialiased: bool = False,
) -> Rendering:
    """Renders Gaussians in one call: `project`, `sh_to_colors` if `sh_degree` is given, `blend`.

    `colors` are per-Gaussian values, or spherical harmonics if `sh_degree` is given. The other arguments and the
    errors are those of `project` and `blend`.
    """
    projection = project(
        means, quats, scales, opacities, camera,
        backend=backend, near=near, eps2d=eps2d, antialiased=antialiased,
    )  # fmt: skip
    if sh_degree is not None:
        colors = sh_to_colors(means, colors, camera, degree=sh_degree, visible=projection.visible)
    return blend(projection, colors, background=background, depth=depth)
