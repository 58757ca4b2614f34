import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.evaluation.masks import MaskScore


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
