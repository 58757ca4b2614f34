"""Mapping in processes of its own, on photos of a corner."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from wildgs.progress import silent
from wildgs.sfm import mapping_ahead
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.mapping_ahead import MappingRun, map_each
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

Matched = tuple[Workplace, list[WorkingCopy]]
RUNS = [MappingRun(0), MappingRun(1, wide=True), MappingRun(2, pair=(1, 3))]
PROCESSES = SfmConfig(threads=2)


@pytest.fixture
def in_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few photos are mapped in processes, too, and never here."""
    monkeypatch.setattr(mapping_ahead, "LEAST_PHOTOS", 2)
    monkeypatch.setattr(mapping_ahead, "map_photos", lambda *_, **__: pytest.fail("mapped here"))


def camera_centers(models: list[Any]) -> list[dict[str, np.ndarray]]:
    return [
        {model.image(i).name: model.image(i).projection_center() for i in model.reg_image_ids()}
        for model in models
    ]


def run_folders(work: Workplace) -> list[str]:
    return [path.name for path in work.root.iterdir() if path.name.startswith("run-")]


def test_processes_have_the_models_that_this_one_has(
    matched: Matched, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, copies = matched
    names = [copy.work_name for copy in copies[:5]]
    expected = list(map_each(work, len(copies), SfmConfig(threads=1), silent, names, RUNS))
    reported = set()

    def progress(step: str, done: int, total: int) -> None:
        reported.add((step, done, total))

    monkeypatch.setattr(mapping_ahead, "LEAST_PHOTOS", 2)
    monkeypatch.setattr(mapping_ahead, "SECONDS_BETWEEN", 0.001)
    monkeypatch.setattr(mapping_ahead, "map_photos", lambda *_, **__: pytest.fail("mapped here"))
    found = list(map_each(work, len(copies), PROCESSES, progress, names, RUNS))
    assert [run for run, _ in found] == [run for run, _ in expected] == RUNS
    for (_, models), (_, right) in zip(found, expected, strict=True):
        assert [model.num_points3D() for model in models] == [model.num_points3D() for model in right]
        for centers, places in zip(camera_centers(models), camera_centers(right), strict=True):
            assert centers.keys() == places.keys()
            assert all(np.allclose(centers[name], places[name], atol=1e-6) for name in centers)
    assert {done for _, done, _ in reported} > {0}
    assert {(step, total) for step, _, total in reported} == {("finding poses", len(copies))}
    assert run_folders(work) == []


@pytest.mark.usefixtures("in_processes")
def test_runs_that_nobody_asks_for_are_stopped(matched: Matched, monkeypatch: pytest.MonkeyPatch) -> None:
    work, copies = matched
    started: list[Any] = []
    popen = mapping_ahead.subprocess.Popen
    monkeypatch.setattr(
        mapping_ahead.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1]
    )
    taken = []

    def endless() -> Iterator[MappingRun]:
        for seed in range(1000):
            taken.append(seed)
            yield MappingRun(seed)

    with closing(map_each(work, len(copies), PROCESSES, silent, (), endless())) as mapped:
        run, models = next(mapped)
    assert run == MappingRun(0)
    assert models
    assert len(taken) <= 4, "runs are taken as late as possible"
    assert len(started) == 2
    assert all(process.poll() is not None for process in started)
    assert run_folders(work) == []


@pytest.mark.parametrize("program", ["false", "echo", "cat"])
def test_a_process_that_fails_is_no_failure(
    matched: Matched, monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    """It ends at once, prints something else, or answers what it was asked."""
    work, copies = matched
    monkeypatch.setattr(mapping_ahead, "LEAST_PHOTOS", 2)
    monkeypatch.setattr(sys, "executable", shutil.which(program))
    monkeypatch.setattr(mapping_ahead, "map_photos", lambda *_, wide, pair: [f"{wide} {pair}"])
    found = list(map_each(work, len(copies), PROCESSES, silent, (), RUNS))
    assert found == list(zip(RUNS, [["False None"], ["True None"], ["False (1, 3)"]], strict=True))


@pytest.mark.usefixtures("in_processes")
def test_an_interruption_stops_the_processes_at_once(
    matched: Matched, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, copies = matched

    def interrupt(step: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(map_each(work, len(copies), PROCESSES, interrupt, (), RUNS))
    assert time.monotonic() - begun < 60
    assert run_folders(work) == []


@pytest.mark.parametrize(
    ("config", "least", "ahead"),
    [(SfmConfig(threads=1), 2, True), (PROCESSES, 100, True), (PROCESSES, 2, False)],
)
def test_few_photos_one_thread_and_single_runs_need_no_process(
    matched: Matched, monkeypatch: pytest.MonkeyPatch, config: SfmConfig, least: int, ahead: bool
) -> None:
    work, copies = matched
    monkeypatch.setattr(mapping_ahead.subprocess, "Popen", lambda *_, **__: pytest.fail("started"))
    monkeypatch.setattr(mapping_ahead, "LEAST_PHOTOS", least)
    monkeypatch.setattr(mapping_ahead, "map_photos", lambda *_, **__: ["model"])
    found = list(map_each(work, len(copies), config, silent, (), RUNS, ahead=ahead))
    assert found == [(run, ["model"]) for run in RUNS]
