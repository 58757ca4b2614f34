"""Triplane projection against a hand-made cloud, sampling at known cells, and the robust box."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.model.triplane import (
    PLANE_AXES,
    VIEW_AXIS,
    Box,
    _nearest_per_cell,
    project_cloud,
    robust_box,
    sample_planes,
)

RED, GREEN, BLUE = torch.eye(3)


def cell_centre(index: int, resolution: int) -> float:
    return (2 * index + 1) / resolution - 1


@pytest.mark.parametrize("plane", [0, 1, 2], ids=["xy", "yz", "zx"])
@pytest.mark.parametrize("reverse", [0, 1], ids=["c", "c_reverse"])
def test_nearest_point_wins_in_each_of_six_directions(plane: int, reverse: int) -> None:
    """Two points on one line of sight: c shows the one at the positive end, c' the other."""
    column_axis, row_axis = PLANE_AXES[plane]
    points = torch.zeros(2, 3)
    points[:, column_axis] = cell_centre(1, 8)
    points[:, row_axis] = cell_centre(6, 8)
    points[0, VIEW_AXIS[plane]] = 0.7
    points[1, VIEW_AXIS[plane]] = -0.4
    pictures = project_cloud(points, torch.stack([RED, BLUE]), 8)
    expected = BLUE if reverse else RED
    picture = pictures[plane, reverse]
    assert torch.equal(picture[:3, 6, 1], expected)
    assert picture[3].sum() == 1
    assert picture[:, torch.arange(8) != 6].abs().sum() == 0


def test_reverse_pictures_are_not_mirrored() -> None:
    points = torch.tensor([[cell_centre(0, 4), cell_centre(2, 4), 0.0]])
    pictures = project_cloud(points, GREEN[None], 4)
    assert torch.equal(pictures[:, 0], pictures[:, 1])


def test_points_outside_the_box_and_empty_clouds_leave_no_trace() -> None:
    outside = project_cloud(torch.tensor([[0.0, 0.0, 1.5], [-2.0, 0.0, 0.0]]), torch.ones(2, 3), 4)
    empty = project_cloud(torch.zeros(0, 3), torch.zeros(0, 3), 4)
    assert outside.abs().sum() == 0
    assert empty.shape == (3, 2, 4, 4, 4)
    assert empty.abs().sum() == 0


@given(st.integers(0, 10_000), st.integers(1, 200))
@settings(max_examples=25, deadline=None)
def test_projection_agrees_with_a_plain_loop(seed: int, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) * 2.4 - 1.2
    colors = torch.rand(count, 3, generator=generator)
    resolution = 5
    pictures = project_cloud(points, colors, resolution)
    expected = torch.zeros_like(pictures)
    for plane, (a, b) in enumerate(PLANE_AXES):
        for reverse, sign in enumerate((1.0, -1.0)):
            best: dict[tuple[int, int], float] = {}
            for point, color in zip(points, colors, strict=True):
                if (point.abs() > 1).any():
                    continue
                column = min(int((point[a] + 1) / 2 * resolution), resolution - 1)
                row = min(int((point[b] + 1) / 2 * resolution), resolution - 1)
                height = sign * float(point[VIEW_AXIS[plane]])
                if height > best.get((row, column), -9.0):
                    best[row, column] = height
                    expected[plane, reverse, :3, row, column] = color
                    expected[plane, reverse, 3, row, column] = 1
    torch.testing.assert_close(pictures, expected)


def test_sampling_at_cell_centres_returns_the_cells_summed_over_planes() -> None:
    planes = torch.randn(3, 5, 6, 6)
    x, y, z = 1, 4, 2
    point = torch.tensor([[cell_centre(x, 6), cell_centre(y, 6), cell_centre(z, 6)]])
    expected = planes[0, :, y, x] + planes[1, :, z, y] + planes[2, :, x, z]
    torch.testing.assert_close(sample_planes(planes, point)[0], expected)


def test_sampling_between_cells_is_bilinear() -> None:
    planes = torch.zeros(3, 1, 4, 4)
    planes[0, 0, 1, 1], planes[0, 0, 1, 2] = 2.0, 4.0
    halfway = (cell_centre(1, 4) + cell_centre(2, 4)) / 2
    point = torch.tensor([[halfway, cell_centre(1, 4), 0.0]])
    torch.testing.assert_close(sample_planes(planes, point), torch.tensor([[3.0]]))


def test_what_is_projected_is_sampled_where_it_came_from() -> None:
    """The two conventions, of cells and of samples, are one."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(1, 3, generator=generator) * 1.8 - 0.9
    cells = ((points + 1) * 8).floor()
    centres = (2 * cells + 1) / 16 - 1
    pictures = project_cloud(centres, RED[None], 16)
    torch.testing.assert_close(sample_planes(pictures[:, 0], centres)[0, 0], torch.tensor(3.0))


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 9), st.integers(0, 300))
@settings(max_examples=25, deadline=None)
def test_cpu_sampling_and_its_gradient_agree_with_grid_sample(
    seed: int, resolution: int, channels: int, count: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    planes = torch.randn(3, channels, resolution, resolution, generator=generator, requires_grad=True)
    points = torch.rand(count, 3, generator=generator) * 2.2 - 1.1
    weights = torch.randn(count, channels, generator=generator)
    sampled = sample_planes(planes, points)
    in_double = sample_planes(planes.double(), points.double())
    torch.testing.assert_close(sampled.double(), in_double, rtol=1e-4, atol=1e-5)
    (gradient,) = torch.autograd.grad((sampled * weights).sum(), planes)
    (expected,) = torch.autograd.grad((in_double * weights).sum(), planes)
    torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-4)


def test_robust_box_ignores_outliers_and_shrinks_by_the_ratio() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator) * torch.tensor([4.0, 2.0, 1.0])
    points[:5] = 1000.0
    whole = robust_box(points, 0.01, 1.0)
    half = robust_box(points, 0.01, 0.5)
    assert (whole.high - whole.low <= torch.tensor([4.1, 2.1, 1.1])).all()
    torch.testing.assert_close(half.high - half.low, (whole.high - whole.low) / 2)
    assert whole.contains(points).float().mean() > 0.9


def test_robust_box_of_a_flat_or_single_point_cloud_has_a_volume() -> None:
    flat = torch.rand(50, 3) * torch.tensor([1.0, 1.0, 0.0])
    for points in (flat, flat[:1]):
        box = robust_box(points, 0.005, 0.5)
        assert (box.high > box.low).all()
        assert torch.isfinite(box.normalize(points)).all()


def test_normalised_coordinates_span_the_box() -> None:
    box = Box(torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 4.0, 3.0]))
    corners = torch.stack([box.low, box.high, (box.low + box.high) / 2])
    torch.testing.assert_close(box.normalize(corners), torch.tensor([[-1.0] * 3, [1.0] * 3, [0.0] * 3]))


def test_what_runs_on_a_gpu_stays_there() -> None:
    """By tensors without numbers that know their device: an operand in main memory is an error."""
    points, colors = (torch.empty(60, 3, device="meta") for _ in range(2))
    with pytest.raises(RuntimeError, match="device"):
        points + torch.ones(60, 3)
    keep = torch.empty(60, dtype=torch.bool, device="meta")
    pictures = project_cloud(points, colors, 8, keep)
    assert (pictures.shape, pictures.device.type) == ((3, 2, 4, 8, 8), "meta")
    planes = torch.empty(3, 5, 8, 8, device="meta", requires_grad=True)
    sampled = sample_planes(planes, points)
    assert (sampled.shape, sampled.device.type) == ((60, 5), "meta")
    sampled.sum().backward()
    assert planes.grad is not None
    assert planes.grad.device.type == "meta"


def test_rejected_points_share_no_cell_and_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scatter that a GPU does, where points that do not count are kept out of one another's way."""
    generator = torch.Generator().manual_seed(0)
    points = 2.4 * torch.rand(500, 3, generator=generator) - 1.2
    inside = (points.abs() <= 1).all(dim=-1)
    wanted = _nearest_per_cell(points[inside], inside[inside], 8)
    for without in ("", "spread_rejected"):
        monkeypatch.setenv("WILDGS_WITHOUT", without)
        winner, hit = _nearest_per_cell(points, inside, 8)
        assert torch.equal(hit, wanted[1])
        assert torch.equal(points[winner][hit], points[inside][wanted[0]][hit])
