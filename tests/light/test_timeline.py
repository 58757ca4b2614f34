"""Light over time."""

from __future__ import annotations

import pytest
import torch

from wildgs.errors import UserError
from wildgs.light.look import Timeline, look_of
from wildgs.light.photos import encode_view


@pytest.fixture
def looks(method, wall):
    return [look_of(method, encode_view(method, view), view.name) for view in wall.views[:3]]


def test_looks_come_at_their_times(looks) -> None:
    timeline = Timeline.of(looks)
    assert timeline.at(0.0) is looks[0]
    assert timeline.at(0.5) is looks[1]
    assert timeline.at(1.0) is looks[2]


def test_between_two_looks_lies_their_mix(looks) -> None:
    middle = Timeline.of(looks).at(0.625).embeddings.global_embedding
    expected = 0.75 * looks[1].embeddings.global_embedding + 0.25 * looks[2].embeddings.global_embedding
    torch.testing.assert_close(middle, expected)


def test_a_single_look_stays(looks) -> None:
    timeline = Timeline.of(looks[0])
    assert {timeline.at(share) for share in (0.0, 0.3, 1.0)} == {looks[0]}


def test_the_light_moves_without_jumps(looks) -> None:
    timeline = Timeline.of(looks)
    path = torch.stack([timeline.at(i / 40).embeddings.global_embedding for i in range(41)])
    steps = path.diff(dim=0).norm(dim=1)
    assert float(steps[:20].std()) < 1e-4 * float(steps[:20].mean())
    assert float(steps[20:].std()) < 1e-4 * float(steps[20:].mean())


def test_nothing_is_no_light() -> None:
    with pytest.raises(UserError, match="at least one"):
        Timeline.of([])


def test_a_paced_timeline_spends_its_time_where_much_changes(looks) -> None:
    timeline = Timeline(tuple(looks)).paced([3.0, 0.0, 0.0, 1.0])
    assert timeline.at(0.0) is looks[0]
    assert timeline.at(1.0) is looks[2]
    quarter = timeline.at(0.75 / 2).embeddings.global_embedding  # half of the first of four parts
    expected = 0.75 * looks[0].embeddings.global_embedding + 0.25 * looks[1].embeddings.global_embedding
    torch.testing.assert_close(quarter, expected)
    assert Timeline(tuple(looks)).paced([0.0, 0.0]).at(0.5) is looks[1]
