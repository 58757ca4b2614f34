"""Two processes under torchrun compute what one computes with both photos, and stay identical."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from wildgs.engine.feed import ViewSampler
from wildgs.engine.optimizers import OptimizerConfig, Optimizers
from wildgs.engine.schedule import Schedule, ScheduleConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError
from wildgs.model.registry import create_method

pytestmark = pytest.mark.timeout(900)
SCRIPT = Path(__file__).with_name("two_ranks.py")
SOURCE = Path(__file__).parents[2] / "src"


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory, forking_python: Path) -> Path:
    """The folder into which two processes wrote what they computed."""
    output = tmp_path_factory.mktemp("ranks")
    launcher = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    places = os.pathsep.join([str(SOURCE), str(SOURCE.parent)])  # the package, and helpers of other tests
    environment = os.environ | {"PYTHONPATH": places, "WILDGS_NUM_THREADS": "1"}
    environment["PYTHON_EXEC"] = str(forking_python)  # torchrun starts ranks with it
    result = subprocess.run(
        [*launcher, str(SCRIPT), str(output)], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return output


def left(ranks: Path, name: str) -> list[dict[str, Any]]:
    """What each of the two left."""
    return [torch.load(ranks / f"{name}_{rank}.pt", weights_only=False) for rank in range(2)]


@pytest.mark.parametrize("method", ["3dgs", "wildgs"])
def test_two_processes_have_the_gradients_of_one_with_both_photos(ranks: Path, method: str) -> None:
    for found in left(ranks, f"gradients_{method}"):
        together, alone = found["together"], found["alone"]
        assert together["gradients"].keys() == alone["gradients"].keys()
        assert any(name.startswith("gaussians.rows") for name in together["gradients"])
        for part in ("gradients", "density"):
            for name, expected in alone[part].items():
                difference = float((together[part][name] - expected).abs().max())
                assert difference <= 1e-5 * float(expected.abs().max()), (part, name)
        assert together["total"] == pytest.approx(alone["total"], rel=1e-5)
        assert float(alone["density"]["seen"].max()) == 2


@pytest.mark.parametrize("method", ["3dgs", "wildgs"])
def test_both_hold_the_same_bits_after_densification(ranks: Path, method: str) -> None:
    first, second = left(ranks, f"trained_{method}")
    assert first["fingerprint"] == second["fingerprint"]
    assert first["counts"] == second["counts"]
    assert len(set(first["counts"])) > 1
    assert first["losses"] == second["losses"]
    assert first["displaced"] == [method == "wildgs"] * 7
    # One colour for two lights: what the baseline can gain in so few steps is little.
    falls = {"3dgs": 1.0, "wildgs": 0.8}[method]
    assert sum(first["losses"][-7:]) < falls * sum(first["losses"][:7])


def test_a_step_counts_its_photos_and_none_is_taken_twice(ranks: Path) -> None:
    first, second = left(ranks, "trained_3dgs")
    assert first["steps"] == [*range(2, 101, 2), 101]
    assert all(a != b for a, b in zip(first["photos"], second["photos"], strict=True))
    both = [name for pair in zip(first["photos"], second["photos"], strict=True) for name in pair]
    assert set(both) == {f"{index}.jpg" for index in range(7)}


def test_one_ranks_mistake_ends_all_and_is_told_once(ranks: Path) -> None:
    first, second = left(ranks, "heard")
    assert first["one_fails"] == ("UserError", "rank 1: no such folder")
    assert second["one_fails"][0] == "ReportedError"
    assert first["first_fails"] == ("UserError", "the disk is full")
    assert second["first_fails"][0] == "ReportedError"
    assert first["unlike_facts"][0] == "UserError"
    assert "photos: 8 on rank 0, 9 on rank 1" in first["unlike_facts"][1]
    assert (first["both_warn"], second["both_warn"]) == (1, 0)


def test_ranks_whose_models_differ_in_size_stop(ranks: Path) -> None:
    first, second = left(ranks, "heard")
    assert first["unlike_sizes"][0] == "DivergedRanksError"
    assert "3 and 4 elements" in first["unlike_sizes"][1]
    assert second["unlike_sizes"][0] == "ReportedError"


def test_ranks_agree(ranks: Path) -> None:
    for heard in left(ranks, "heard"):
        assert heard["from_first"] == "by 0"
        assert heard["least"] == 4
        assert heard["exchange"] == [(7, 0.0), (8, 0.5)]
        assert heard["stop"] == (0, 15)
        here, nowhere = heard["partly_without_gradient"]
        assert here.tolist() == [2, 1]
        assert nowhere is None


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_photos_of_a_step_differ_and_rounds_stay_whole(size: int) -> None:
    sampler = ViewSampler(7, torch.Generator().manual_seed(0))
    batches = [sampler.take(size) for _ in range(70)]
    assert all(len(set(batch)) == size for batch in batches)
    taken = [index for batch in batches for index in batch]
    rounds = [taken[start : start + 7] for start in range(0, len(taken) - 6, 7)]
    assert all(sorted(each) == list(range(7)) for each in rounds)
    assert len({tuple(each) for each in rounds}) > 5


@pytest.mark.parametrize("taken", [1, 2, 3, 64])
def test_a_step_of_several_photos_misses_no_event(taken: int) -> None:
    schedule = Schedule(ScheduleConfig(), 30_000)
    steps = range(taken, 30_001, taken)
    assert sum(schedule.densifies(step, taken) for step in steps) == pytest.approx(144, abs=1)
    assert sum(schedule.resets(step, taken) for step in steps) == 4


def test_adam_of_a_mean_over_photos(wall_scene, tiny_model) -> None:
    method = create_method("3dgs", None, wall_scene)
    one, four = (Optimizers.build(method, OptimizerConfig(), 1.0, photos) for photos in (1, 4))
    for optimizers in (one, four):
        optimizers.set_progress(0.3)
    for single, scaled in zip(one.rows.param_groups, four.rows.param_groups, strict=True):
        assert scaled["lr"] == pytest.approx(2 * single["lr"])
        assert scaled["betas"] == pytest.approx((0.9**4, 0.999**4))
        assert scaled["eps"] == pytest.approx(single["eps"] / 2)


def test_adam_goes_on_with_another_number_of_photos(wall_scene, tiny_model) -> None:
    """The bias correction of 12 photos is the same, whether they were twelve steps or three."""
    method = create_method("3dgs", None, wall_scene)
    one, four = (Optimizers.build(method, OptimizerConfig(), 1.0, photos) for photos in (1, 4))
    for _ in range(3):
        for parameter in method.parameters():
            parameter.grad = torch.ones_like(parameter)
        four.step()
    one.restore(four.state())
    for parameter in one.rows.state.values():
        assert float(parameter["step"]) == 12
    assert all(torch.equal(value, four.state()[name]) for name, value in one.state().items())


def test_fewer_photos_than_processes_is_a_users_mistake(wall_scene, tiny_model) -> None:
    from wildgs.engine.team import Team

    class Crowd(Team):
        size = 8

    method = create_method("3dgs", None, wall_scene)
    with pytest.raises(UserError, match="7 training photos are too few for 8 processes"):
        Trainer(method, wall_scene, TrainConfig(), Crowd())


def test_optimiser_steps_of_one_process_are_as_before() -> None:
    """A team of one changes nothing: every step is a multiple of one."""
    schedule = Schedule(ScheduleConfig(), 30_000)
    found = [step for step in range(30_001) if schedule.densifies(step)]
    assert found == list(range(600, 15_000, 100))
    assert all(b - a == 100 for a, b in pairwise(found))
