"""The viewer's part of training time, with a clock that only the test moves."""

from __future__ import annotations

import itertools

import pytest

from wildgs.engine.report import StepReport
from wildgs.viewer.jobs import SHARE, Jobs, TrainingTurns

REPORT = StepReport.__new__(StepReport)


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def training(turns: TrainingTurns, clock: Clock, step_seconds: float, seconds: float) -> int:
    """Steps of some length with turns between them; how many were done."""
    steps = 0
    end = clock.now + seconds
    while clock.now < end:
        clock.now += step_seconds
        steps += 1
        turns(REPORT)
    return steps


@pytest.mark.parametrize("cost", [0.01, 0.2, 2.0])
@pytest.mark.parametrize("step_seconds", [0.004, 0.3])
def test_share_is_kept_however_much_is_asked_for(cost: float, step_seconds: float) -> None:
    clock, jobs = Clock(), Jobs()

    def work() -> None:
        clock.now += cost
        for kind in ("light", "compare", "paint"):
            jobs.put(kind, work)

    turns = TrainingTurns(jobs, lambda: True, lambda _: jobs.put("light", work), clock=clock)
    seconds = 300.0
    steps = training(turns, clock, step_seconds, seconds)
    assert steps * step_seconds >= (1 - SHARE) * seconds - cost
    assert turns.seconds >= 0.5 * SHARE * seconds if cost > 0.1 else turns.seconds > 0


def test_nothing_is_done_when_nobody_looks() -> None:
    clock, jobs, done = Clock(), Jobs(), []
    turns = TrainingTurns(jobs, lambda: False, lambda _: done.append("update"), clock=clock)
    jobs.put("light", lambda: done.append("light"))
    training(turns, clock, 0.1, 60)
    assert done == []
    assert turns.seconds == 0


def test_updates_come_at_a_bounded_rate() -> None:
    clock, jobs, updates = Clock(), Jobs(), []
    turns = TrainingTurns(jobs, lambda: True, lambda _: updates.append(clock.now), every=3.0, clock=clock)
    training(turns, clock, 0.01, 30)
    assert 9 <= len(updates) <= 11
    assert min(b - a for a, b in itertools.pairwise(updates)) >= 3.0
