"""Schedules: the paper's at its own length, scaled otherwise."""

from __future__ import annotations

import pytest

from wildgs.engine.density import STRATEGIES
from wildgs.engine.schedule import Schedule, ScheduleConfig, exponential
from wildgs.errors import UserError
from wildgs.model.vanilla import VanillaGS
from wildgs.model.wildgs import WildGS


def test_paper_length_keeps_the_papers_steps() -> None:
    schedule = Schedule(ScheduleConfig(), 30_000)
    assert [schedule.first_stage, schedule.densify_from, schedule.densify_until] == [3000, 500, 15_000]
    assert [schedule.densify_every, schedule.reset_every, schedule.sh_every] == [100, 3000, 1000]
    assert schedule.densifies(600)
    assert not schedule.densifies(500)
    assert not schedule.densifies(650)
    assert not schedule.densifies(15_000)
    assert [step for step in range(0, 30_000) if schedule.resets(step)] == [3000, 6000, 9000, 12_000]


@pytest.mark.parametrize("steps", [1500, 6000, 12_000, 30_000])
def test_relocation_has_as_many_rounds_in_long_runs(steps: int) -> None:
    """A round splits many Gaussians, which have to be trained again."""
    strategy = STRATEGIES["relocation"]
    schedule = Schedule(ScheduleConfig(), steps, 0, strategy.until, every=strategy.every)
    assert 18 <= sum(map(schedule.densifies, range(steps))) <= 24
    often = Schedule(ScheduleConfig(densify_every=500), steps, 0, strategy.until, every=strategy.every)
    assert often.densify_every == max(50, steps // 60)


def test_densification_can_be_switched_off() -> None:
    """Pruning and resets are a part of it; the mask then never pauses."""
    off = Schedule(ScheduleConfig(densify_every=0), 30_000)
    assert not any(
        off.densifies(s) or off.resets(s) or off.mask_paused(s) or off.gathers(s) for s in range(30_000)
    )
    without_resets = Schedule(ScheduleConfig(reset_every=0), 3000)
    assert not any(without_resets.resets(s) or without_resets.mask_paused(s) for s in range(3000))
    assert any(without_resets.densifies(s) for s in range(3000))


@pytest.mark.parametrize(
    "name",
    ["densify_every", "reset_every", "first_stage", "sh_every", "encoder_every", "mask_every", "mask_visits"],
)
def test_impossible_steps_are_one_line(name: str) -> None:
    option = name.replace("_", "-")
    with pytest.raises(UserError, match=rf"--schedule\.{option} -1: must be"):
        ScheduleConfig(**{name: -1})
    if name in ("sh_every", "encoder_every", "mask_every"):
        with pytest.raises(UserError, match="must be 1 or more"):
            ScheduleConfig(**{name: 0})


def test_masks_become_final_once_every_photo_was_seen_often() -> None:
    schedule = Schedule(ScheduleConfig(), 30_000, reset_every=0, photos=200)
    learnt = [step for step in range(30_000) if schedule.stage(step, 1).learn_mask]
    assert learnt[:1000] == list(range(1000))
    assert learnt[-1] in (3998, 3999)
    assert schedule.mask_progress(2000) == pytest.approx(0.5, abs=0.001)
    assert schedule.mask_progress(29_999) == 1.0


@pytest.mark.parametrize(
    ("config", "steps", "photos", "expected"),
    [
        (ScheduleConfig(), 30_000, 10, 1500),  # a mask needs that many steps, however few photos there are
        (ScheduleConfig(), 1500, 90, 1500),
        (ScheduleConfig(), 30_000, 5000, 30_000),
        (ScheduleConfig(), 30_000, None, 30_000),  # a trainable encoder
        (ScheduleConfig(mask_visits=0), 30_000, 90, 30_000),
        (ScheduleConfig(mask_visits=50), 30_000, 90, 4500),
    ],
)
def test_steps_of_the_masks_training(
    config: ScheduleConfig, steps: int, photos: int | None, expected: int
) -> None:
    assert Schedule(config, steps, photos=photos).mask_steps == expected


def test_half_length_halves() -> None:
    schedule = Schedule(ScheduleConfig(), 15_000)
    assert schedule.first_stage == 1500
    assert schedule.densify_until == 7500


@pytest.mark.parametrize("steps", [1, 50, 300, 3000])
def test_short_runs_stay_sane(steps: int) -> None:
    schedule = Schedule(ScheduleConfig(), steps)
    resets = [step for step in range(steps) if schedule.resets(step)]
    assert all(step < steps / 2 for step in resets)
    assert schedule.first_stage <= max(1, steps // 5)
    assert schedule.progress(0) in (0.0, 1.0)
    assert schedule.progress(steps - 1) == (1.0 if steps > 1 else 0.0)


def test_masks_get_time_in_short_runs() -> None:
    assert Schedule(ScheduleConfig(), 2500).first_stage == 500
    assert Schedule(ScheduleConfig(), 2500).densify_from == 250
    assert Schedule(ScheduleConfig(), 1000).first_stage == 200


def test_stages() -> None:
    schedule = Schedule(ScheduleConfig(), 30_000)
    assert not schedule.stage(2999, 3).explicit
    assert schedule.stage(3000, 3).explicit
    assert [schedule.stage(step, 3).sh_degree for step in (0, 999, 1000, 2500, 29_999)] == [0, 0, 1, 2, 3]


def test_mask_rests_after_every_reset_and_only_then() -> None:
    schedule = Schedule(ScheduleConfig(), 30_000)
    assert not schedule.mask_paused(0)
    assert not schedule.mask_paused(2999)
    assert schedule.mask_paused(3000)
    assert schedule.mask_paused(3499)
    assert not schedule.mask_paused(3500)
    assert schedule.mask_paused(12_100)
    assert not schedule.mask_paused(15_100), "there is no reset at the end of densification"
    assert not schedule.mask_paused(18_100), "there is no reset after densification"


def test_exponential_ends() -> None:
    assert exponential(1.0, 0.01, 0.0) == pytest.approx(1.0)
    assert exponential(1.0, 0.01, 0.5) == pytest.approx(0.1)
    assert exponential(1.0, 0.01, 1.0) == pytest.approx(0.01)


@pytest.mark.parametrize("ranks", [1, 2, 3, 8])
def test_the_encoder_learns_as_often_however_many_photos_a_step_has(ranks: int) -> None:
    """Steps that have a photo on which one process would teach the encoder teach it."""
    schedule = Schedule(ScheduleConfig(encoder_every=4), 30_000)
    steps = range(0, 240, ranks)
    learning = {step for step in steps if schedule.stage(step, 3, ranks).learn_encoder}
    assert learning == {step for step in steps if any(photo % 4 == 0 for photo in range(step, step + ranks))}


def test_mask_and_planes_take_turns() -> None:
    schedule = Schedule(ScheduleConfig(reset_every=0), 30_000)
    assert all(schedule.stage(step, 3).learn_mask for step in range(10)), "masks are needed early"
    stages = [schedule.stage(step, 3) for step in range(15_000, 15_010)]
    assert [stage.learn_mask for stage in stages] == [True, False] * 5
    assert [stage.learn_planes for stage in stages] == [False, True] * 5
    both = Schedule(ScheduleConfig(mask_every=1, planes_every=1, reset_every=0), 30_000).stage(3, 3)
    assert both.learn_mask
    assert both.learn_planes


def test_resets_are_the_methods_unless_they_are_given() -> None:
    """Wild-GS has none: what it renders then differs from every photo, and masks and colour match with it."""
    assert Schedule(ScheduleConfig(), 30_000, WildGS.reset_every).reset_every == 0
    assert Schedule(ScheduleConfig(), 30_000, VanillaGS.reset_every).reset_every == 3000
    assert Schedule(ScheduleConfig(reset_every=6000), 30_000, WildGS.reset_every).reset_every == 6000
