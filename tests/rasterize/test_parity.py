"""Every backend against the dense reference in float64: values and gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize import Projection, Rendering, blend, blend_sample, project, sh_to_colors

BACKENDS = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


@dataclass
class Case:
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    camera: Camera
    eps2d: float = 0.3
    antialiased: bool = False

    def inputs(self) -> list[Tensor]:
        return [self.means, self.quats, self.scales, self.opacities, self.colors]


def pinhole(width: int, height: int, focal: float | None = None) -> Camera:
    focal = focal or 0.9 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal * 1.1, height / 2 - 1], [0, 0, 1]])
    angle = torch.tensor(0.2)
    viewmat = torch.eye(4)
    viewmat[:2, :2] = torch.stack(
        [torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])]
    )
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    return Camera(viewmat, K, width, height)


def random_case(
    count: int, width: int, height: int, size: float = 0.05, channels: int = 3, seed: int = 0
) -> Case:
    g = torch.Generator().manual_seed(seed)
    camera = pinhole(width, height)
    z = 2 + 4 * torch.rand(count, generator=g)
    xy = (torch.rand(count, 2, generator=g) - 0.5) * z[:, None] * torch.tensor([1.2, 1.2 * height / width])
    return Case(
        means=torch.cat([xy, z[:, None]], 1),
        quats=torch.randn(count, 4, generator=g),
        scales=torch.exp(math.log(size) + 0.5 * torch.randn(count, 3, generator=g)),
        opacities=torch.rand(count, generator=g),
        colors=torch.rand(count, channels, generator=g),
        camera=camera,
    )


def render(case: Case, backend: str, dtype: torch.dtype) -> tuple[Projection, Rendering, dict[str, Tensor]]:
    """Renders, and pulls fixed random gradients back to every input."""
    device = "cuda" if backend == "cuda" else "cpu"
    inputs = [t.detach().clone().to(device, dtype).requires_grad_() for t in case.inputs()]
    channels = case.colors.shape[1]
    background = torch.linspace(0.2, 0.8, channels).to(device, dtype).detach().requires_grad_()
    projection = project(
        *inputs[:4],
        case.camera.to(device),
        backend=backend,
        absgrad=True,
        eps2d=case.eps2d,
        antialiased=case.antialiased,
    )
    projection.means2d.retain_grad()
    rendering = blend(projection, inputs[4], background=background)
    g = torch.Generator().manual_seed(9)
    pictures = [rendering.colors, rendering.depth, rendering.alpha]
    pulls = [torch.rand(p.shape, generator=g, dtype=torch.float64).to(p) for p in pictures]
    pulled = [(p, pull) for p, pull in zip(pictures, pulls, strict=True) if p.requires_grad]
    if pulled:
        torch.autograd.backward(*map(list, zip(*pulled, strict=True)))
    names = ["means", "quats", "scales", "opacities", "colors"]
    leaves = dict(zip(names, inputs, strict=True)) | {"background": background, "means2d": projection.means2d}
    grads = {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()}
    return (
        projection,
        rendering,
        {name: g.cpu() for name, g in (grads | {"absgrad": projection.absgrad}).items()},
    )


def assert_same(case: Case, backend: str, tolerance: float = 1e-4) -> None:
    """Values to `tolerance` of each picture's largest, gradients to `tolerance` of each tensor's largest.

    Where float32 puts a pixel on the other side of a threshold (alpha 1/255, the cap, the stop) single numbers
    differ by more; they may be one in a thousand. gsplat is compiled with approximate division, square root and
    exponential: its gradients differ by up to 0.3% of the largest, and more numbers cross a threshold.
    """
    approximate = backend == "cuda"
    most_outliers = 1e-2 if approximate else 1e-3
    if approximate:
        tolerance = max(tolerance, 5e-3)
    projection, rendering, grads = render(case, backend, torch.float32)
    expected_projection, expected, expected_grads = render(case, "reference", torch.float64)
    seen = assert_same_visible(projection, expected_projection, approximate)
    pairs = {k: (getattr(rendering, k), getattr(expected, k)) for k in ("colors", "depth", "alpha")}
    pairs |= {
        k: (getattr(projection, k).cpu()[seen], getattr(expected_projection, k)[seen])
        for k in ("means2d", "depths", "conics")
    }
    pairs |= {f"gradient of {k}": (grads[k], expected_grads[k]) for k in grads}
    for name, (value, truth) in pairs.items():
        assert value.shape == truth.shape, name
        if truth.numel() == 0:
            continue
        difference = (value.detach().cpu().double() - truth.detach()).abs()
        scale = truth.detach().abs().max().clamp(min=1e-2)
        assert value.isfinite().all(), name
        outliers = (difference > tolerance * scale).double().mean()
        message = f"{name}: {outliers:.2%} differ, by up to {difference.max() / scale:.2e}"
        assert outliers <= most_outliers, message


def assert_same_visible(found: Projection, expected: Projection, approximate: bool) -> Tensor:
    """Compares which Gaussians are visible, and their radii; returns those that both show.

    gsplat culls by radii rounded up to whole pixels: Gaussians less than a pixel outside of the image, which
    contribute nothing, stay visible.
    """
    visible, wanted = found.visible.cpu(), expected.visible
    if not approximate:
        assert torch.equal(visible, wanted)
    assert (wanted & ~visible).double().mean() <= (5e-3 if approximate else 0) or len(wanted) == 0
    both = visible & wanted
    radii, wanted_radii = found.radii.cpu()[both], expected.radii[both]
    assert ((radii - wanted_radii).abs() <= (2 + 0.02 * wanted_radii if approximate else 1)).all()
    return both


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (37, 53), (16, 16), (1, 1), (100, 3)])
def test_pictures_of_any_shape(backend: str, width: int, height: int):
    assert_same(random_case(200, width, height), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4, 8, 19])
def test_any_number_of_channels(backend: str, channels: int):
    assert_same(random_case(120, 40, 30, channels=channels), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [1e-5, 0.3, 3.0, 100.0])
def test_tiny_to_huge(backend: str, size: float):
    assert_same(random_case(60, 70, 50, size=size), backend, tolerance=5e-4)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("eps2d", [0.03, 2.0])
def test_more_and_less_of_a_blur(backend: str, eps2d: float):
    case = random_case(200, 48, 48, size=0.01)
    case.eps2d = eps2d
    assert_same(case, backend, tolerance=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [1e-3, 0.01, 0.3])
@pytest.mark.parametrize("eps2d", [0.03, 0.3])
def test_antialiased(backend: str, size: float, eps2d: float):
    case = random_case(200, 48, 48, size=size)
    case.eps2d, case.antialiased = eps2d, True
    assert_same(case, backend, tolerance=5e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_antialiased_needles_and_discs(backend: str):
    case = random_case(100, 64, 64)
    case.antialiased = True
    case.scales[:, 0] = 2.0
    case.scales[:50, 1:] = 1e-3
    case.scales[50:, 1] = 2.0
    case.scales[50:, 2] = 1e-5
    assert_same(case, backend, tolerance=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_fully_opaque(backend: str):
    case = random_case(200, 48, 48)
    case.opacities[:] = 1.0
    assert_same(case, backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_needles(backend: str):
    case = random_case(100, 64, 64)
    case.scales[:, 0] = 2.0
    case.scales[:, 1:] = 1e-3
    assert_same(case, backend, tolerance=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_saturated_pixels_beside_open_ones(backend: str):
    """Lists of several batches in which some pixels of a block are saturated early and others late or never."""
    case = random_case(600, 37, 29, size=0.03)
    case.opacities[:] = 0.9 + 0.1 * case.opacities
    case.means[:, 0] -= 0.5
    assert_same(case, backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 33])
def test_counts_around_the_vector_width(backend: str, count: int):
    assert_same(random_case(count, 33, 20, size=0.2), backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_behind_and_beside_the_camera(backend: str):
    case = random_case(300, 50, 40, size=0.2)
    case.means[:100, 2] *= -1
    case.means[100:150, 2] = torch.linspace(-0.35, 0.1, 50)
    case.means[150:250, 0] *= 4
    assert_same(case, backend, tolerance=1e-3)
    projection, _, grads = render(case, backend, torch.float32)
    culled = ~projection.visible.cpu()
    assert culled[:100].all()
    for name in ("means", "quats", "scales", "opacities", "colors", "means2d"):
        assert not grads[name][culled].any(), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_thousands_in_one_tile(backend: str):
    case = random_case(10_000, 16, 16, size=0.02)
    case.opacities *= 0.02
    case.opacities += 1.5 / 255
    assert_same(case, backend, tolerance=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38])
def test_numbers_that_are_not_finite_are_culled(backend: str, bad: float):
    case = random_case(80, 40, 40)
    for i, tensor in enumerate((case.means, case.quats, case.scales)):
        for column in range(tensor.shape[1]):
            tensor[10 * i + column, column] = bad
    if not abs(bad) > 1e38 or math.isinf(bad):
        case.opacities[40] = bad
    _, rendering, grads = render(case, backend, torch.float32)
    case.means, case.quats, case.scales = (
        t.nan_to_num(0, 0, 0) for t in (case.means, case.quats, case.scales)
    )
    for name, value in (("colors", rendering.colors), ("depth", rendering.depth), ("alpha", rendering.alpha)):
        assert value.isfinite().all(), name
    for name, value in grads.items():
        assert value.isfinite().all(), name


@pytest.mark.parametrize("backend", ["cpu", "reference", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_zero_quaternion_and_zero_scale_give_finite_numbers(backend: str):
    case = random_case(20, 30, 30)
    case.quats[0] = 0
    case.scales[1] = 0
    case.means[2] = case.camera.position
    _, rendering, grads = render(case, backend, torch.float32)
    assert rendering.colors.isfinite().all()
    assert all(value.isfinite().all() for value in grads.values())


def test_colours_agree_with_gsplats_torch_functions():
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed (extra `cuda`)")
    case = random_case(300, 60, 45, size=0.1)
    covariances, _ = gsplat._quat_scale_to_covar_preci(case.quats, case.scales, True, False)
    view, K = case.camera.viewmat[None], case.camera.K[None]
    _, means2d, depths, conics, _ = gsplat._fully_fused_projection(case.means, covariances, view, K, 60, 45)
    projection = project(case.means, case.quats, case.scales, case.opacities, case.camera)
    seen = projection.visible
    assert seen.any()
    assert torch.allclose(projection.means2d[seen], means2d[0, seen], atol=1e-3)
    assert torch.allclose(projection.depths[seen], depths[0, seen], atol=1e-5)
    assert torch.allclose(projection.conics[seen], conics[0, seen], rtol=1e-3, atol=1e-4)
    directions = case.means - case.camera.position
    sh = torch.randn(300, 16, 3, generator=torch.Generator().manual_seed(3))
    expected = (gsplat._spherical_harmonics(3, directions, sh) + 0.5).clamp(min=0)
    assert torch.allclose(sh_to_colors(case.means, sh, case.camera, degree=3), expected, atol=1e-5)


@pytest.mark.parametrize("backend", [*BACKENDS, "reference"])
def test_a_sample_shows_what_the_whole_shows(backend: str):
    """At pixels all over the picture, drawn anew each time, and the same for every backend."""
    device = "cuda" if backend == "cuda" else "cpu"
    case = random_case(200, 150, 130, channels=4)
    values = case.colors.to(device)
    inputs = [tensor.to(device) for tensor in case.inputs()[:4]]
    projection = project(*inputs, case.camera.to(device), backend=backend)
    whole = blend(projection, values)
    seen = torch.zeros(130, 150, dtype=torch.bool)
    torch.manual_seed(0)
    draws = [blend_sample(projection, values, tiles=20, every=3) for _ in range(8)]
    for part, (rows, columns) in draws:
        assert 10 * 25 < len(rows) < 30 * 25
        assert not {0, 2, 15} & set((rows % 16).tolist() + (columns % 16).tolist())
        for name, found in vars(part).items():
            torch.testing.assert_close(found, getattr(whole, name)[rows, columns], atol=1e-5, rtol=1e-5)
        seen[rows.cpu(), columns.cpu()] = True
    assert seen[1::16, 1::16].all()
    torch.manual_seed(0)
    _, pixels = blend_sample(project(*case.inputs()[:4], case.camera), case.colors, tiles=20, every=3)
    assert torch.equal(torch.stack(draws[0][1]).cpu(), torch.stack(pixels))


@pytest.mark.parametrize("backend", [*BACKENDS, "reference"])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 40), (16, 3)])
def test_a_sample_of_few_pixels(backend: str, width: int, height: int):
    device = "cuda" if backend == "cuda" else "cpu"
    case = random_case(20, width, height)
    projection = project(
        *[tensor.to(device) for tensor in case.inputs()[:4]], case.camera.to(device), backend=backend
    )
    part, (rows, columns) = blend_sample(projection, case.colors.to(device), tiles=40, every=3)
    assert part.colors.shape == (len(rows), 3)
    assert len(rows) == len(range(1, height, 3)) * len(range(1, width, 3))
    assert len(columns) == len(part.alpha)
