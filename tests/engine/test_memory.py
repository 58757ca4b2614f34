"""What is said about memory before training starts."""

from __future__ import annotations

import pytest
import torch

from wildgs.engine import memory
from wildgs.engine.memory import plan_budget
from wildgs.errors import UserError
from wildgs.model.vanilla import VanillaGS
from wildgs.scene import Scene

CPU = torch.device("cpu")


def plan(scene: Scene, wish: int, free: int | None, monkeypatch, *, explicit: bool = False):
    monkeypatch.setattr(memory, "free_memory", lambda _: free)
    return plan_budget("3dgs", scene, wish, CPU, explicit=explicit)


def test_what_fits_is_granted(wall_scene: Scene, monkeypatch) -> None:
    assert plan(wall_scene, 3_000_000, 2**40, monkeypatch) == (3_000_000, None)
    assert plan(wall_scene, 3_000_000, None, monkeypatch) == (3_000_000, None)


def test_a_default_budget_is_lowered_with_a_word(wall_scene: Scene, monkeypatch) -> None:
    free = VanillaGS.memory.fixed + 10**9
    budget, word = plan(wall_scene, 3_000_000, free, monkeypatch)
    assert 100_000 < budget < 3_000_000
    assert word is not None
    assert f"{budget:,} Gaussians" in word
    assert plan(wall_scene, budget, free, monkeypatch) == (budget, None)


def test_a_budget_that_was_asked_for_is_refused(wall_scene: Scene, monkeypatch) -> None:
    with pytest.raises(UserError, match=r"lower --max-gaussians to \d"):
        plan(wall_scene, 3_000_000, VanillaGS.memory.fixed + 10**9, monkeypatch, explicit=True)


def test_what_cannot_start_is_refused(wall_scene: Scene, monkeypatch) -> None:
    with pytest.raises(UserError, match="raise --downscale"):
        plan(wall_scene, 3_000_000, VanillaGS.memory.fixed // 2, monkeypatch)


def test_free_memory_of_the_cpu_is_known() -> None:
    assert memory.free_memory(CPU) is None or memory.free_memory(CPU) > 0  # pyright: ignore
