import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.evaluation.metrics import (
    MAX_PSNR,
    MaskScore,
    detail,
    landmark_pixels,
    psnr,
    structural_similarity,
    to_8bit,
)


def separable_ssim_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """SSIM of one channel by numpy alone: rows and columns convolved, zeros outside."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def blur(z: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            z = np.apply_along_axis(lambda line: np.convolve(np.pad(line, 5), taps, mode="valid"), axis, z)
        return z

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2) / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))


@pytest.fixture
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    truth = torch.randint(0, 256, (33, 47, 3), dtype=torch.uint8, generator=generator)
    noise = torch.randint(-30, 31, truth.shape, generator=generator)
    return (truth + noise).clamp(0, 255).to(torch.uint8), truth


def test_rounding_is_to_the_nearest_and_clamped():
    values = torch.tensor([-0.2, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 1.7, math.nan, math.inf, -math.inf])
    picture = values[:, None, None].expand(-1, 1, 3)
    assert to_8bit(picture)[:, 0, 0].tolist() == [0, 0, 0, 1, 255, 255, 0, 255, 0]


def test_psnr_of_a_known_error():
    truth = torch.full((4, 5, 3), 100, dtype=torch.uint8)
    assert psnr(truth + 10, truth) == pytest.approx(20 * math.log10(255 / 10))
    assert psnr(truth, truth) == MAX_PSNR


def test_psnr_counts_kept_pixels_only():
    truth = torch.full((4, 6, 3), 100, dtype=torch.uint8)
    render = truth + 10
    render[:, 3:] = 255
    keep = torch.zeros(4, 6, dtype=torch.bool)
    keep[:, :3] = True
    assert psnr(render, truth, keep) == pytest.approx(20 * math.log10(255 / 10))


def test_ssim_agrees_with_an_independent_implementation(pair):
    render, truth = pair
    maps = [separable_ssim_map(render[..., c].numpy() / 255, truth[..., c].numpy() / 255) for c in range(3)]
    assert structural_similarity(render, truth) == pytest.approx(np.mean(maps), abs=1e-10)
    keep = torch.rand(33, 47, generator=torch.Generator().manual_seed(1)) > 0.6
    expected = np.mean([m[keep.numpy()] for m in maps])
    assert structural_similarity(render, truth, keep) == pytest.approx(expected, abs=1e-10)


def test_ssim_is_one_for_equal_pictures_and_falls_with_noise(pair):
    render, truth = pair
    assert structural_similarity(truth, truth) == pytest.approx(1)
    assert structural_similarity(render, truth) < 0.999


def average_precision(scores: list[float], truth: list[bool]) -> float:
    """By the definition: every distinct score is a threshold."""
    total, recall, area = sum(truth), 0.0, 0.0
    for threshold in sorted(set(scores), reverse=True):
        found = [t for s, t in zip(scores, truth, strict=True) if s >= threshold]
        now = sum(found) / total
        area += (now - recall) * sum(found) / len(found)
        recall = now
    return area


def as_map(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)[None]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 20), st.booleans()), min_size=1, max_size=60))
def test_average_precision_agrees_with_the_definition(pixels):
    transient = [t for _, t in pixels]
    levels = [level / 20 for level, _ in pixels]
    score = MaskScore()
    score.add(as_map([1 - level for level in levels]), torch.tensor([not t for t in transient])[None])
    if not any(transient):
        assert score.average_precision is None
    else:
        assert score.average_precision == pytest.approx(average_precision(levels, transient))


def test_a_perfect_mask_and_its_opposite():
    static = torch.tensor([[True, True, False, True]])
    perfect, opposite = MaskScore(), MaskScore()
    perfect.add(static.float(), static)
    opposite.add(1 - static.float(), static)
    assert (perfect.average_precision, perfect.iou) == (1.0, 1.0)
    assert opposite.iou == 0.0
    assert opposite.average_precision == pytest.approx(0.25)


def test_pixels_of_all_photos_are_pooled():
    score = MaskScore(threshold=0.5)
    score.add(as_map([0.9, 0.2]), torch.tensor([[True, False]]))
    score.add(as_map([0.5, 0.7, 0.1]), torch.tensor([[True, False, False]]))
    # Predicted transient: 0.2, 0.5 (M <= Th) and 0.1; truly transient: 0.2, 0.7, 0.1.
    assert score.iou == pytest.approx(2 / 4)
    expected = average_precision([0.1, 0.8, 0.5, 0.3, 0.9], [False, True, False, True, True])
    assert score.average_precision == pytest.approx(expected)
    assert score.as_dict()["images"] == 2


def test_without_transients_there_is_nothing_to_find():
    score = MaskScore()
    score.add(as_map([0.9, 0.8]), torch.tensor([[True, True]]))
    assert score.average_precision is None
    assert score.iou is None


@pytest.fixture
def texture() -> torch.Tensor:
    noise = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(1))
    return (60 + 130 * noise).permute(1, 2, 0).to(torch.uint8)


def test_detail_of_the_truth_itself_is_whole_whatever_its_light(texture):
    recoloured = (texture.float() * torch.tensor([0.5, 0.7, 0.9]) + 20).round().to(torch.uint8)
    for render in (texture, recoloured):
        assert detail(render, texture) == pytest.approx((1, 1), abs=0.01)


def test_blur_takes_energy_and_noise_takes_correlation(texture):
    image = texture.permute(2, 0, 1)[None].float()
    blurred = (
        torch.nn.functional.avg_pool2d(image, 3, stride=1, padding=1)[0].permute(1, 2, 0).to(torch.uint8)
    )
    assert detail(blurred, texture).energy < 0.8
    other = texture.flip(0)
    assert abs(detail(other, texture).correlation) < 0.1
    flat = torch.full_like(texture, 9)
    assert detail(flat, flat) == (None, None)


def test_detail_counts_kept_pixels_alone(texture):
    keep = torch.zeros(texture.shape[:2], dtype=torch.bool)
    keep[:, :40] = True
    spoilt = texture.clone()
    spoilt[:, 48:] = 0  # beyond the reach of the filter
    assert detail(spoilt, texture, keep) == pytest.approx((1, 1), abs=1e-3)


def test_the_landmark_is_what_lies_near_observations():
    assert landmark_pixels(torch.full((19, 2), 5.0), 100, 200) is None
    near = landmark_pixels(torch.full((25, 2), 50.5), 100, 200)
    assert near is not None
    assert near[50, 50]
    assert not near[50, 57]
    assert near.sum() == pytest.approx(math.pi * 6**2, rel=0.1)
