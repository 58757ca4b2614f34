"""The list of runs: methods, variants, scenes, and what is refused before anything is trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from wildgs.config import RunConfig, differing_entries, with_entries
from wildgs.config_file import write_config
from wildgs.errors import UserError, WildGSWarning
from wildgs.evaluation.benchmark_table import PHOTOTOURISM, published_figures
from wildgs.library.benchmark_plan import find_phototourism, label_of, make_jobs, method_config, parse_variant
from wildgs.library.config import BENCH_METHODS, ENTRIES_WITHOUT, default_bench_methods, reference_preset
from wildgs.model.registry import METHODS
from wildgs.model.wildgs import Ablation
from wildgs.presets import with_preset

BASE = RunConfig(Path())


def test_every_ablation_is_a_method_with_a_label():
    ablations = {name.removeprefix("without-") for name in BENCH_METHODS if name.startswith("without-")}
    assert ablations == {*get_args(Ablation), *ENTRIES_WITHOUT}
    assert [label_of(name) for name in ("3dgs", "wildgs-half-steps", "without-reverse", "mine")] == [
        "3DGS",
        "Wild-GS†",
        "w/o {c'}",
        "mine",
    ]
    for name in BENCH_METHODS:
        config = method_config(name, with_entries(BASE, {"model.local_embeddings": True}))
        assert config.method == (name if name in METHODS else "wildgs")
        if config.method == "wildgs":
            part = name.removeprefix("without-")
            assert config.model.without == ((part,) if part in get_args(Ablation) else ())
    assert method_config("wildgs-half-steps", BASE).train.steps == BASE.train.steps // 2


@pytest.mark.parametrize("part", list(ENTRIES_WITHOUT))
def test_rows_without_additions_change_only_these(part: str):
    changed = differing_entries(BASE, method_config(f"without-{part}", BASE))
    assert {path: new for path, (_, new) in changed.items()} == ENTRIES_WITHOUT[part]
    assert (f"without-{part}" in default_bench_methods(None)) == (part != "stereo")


@pytest.mark.parametrize(
    ("text", "entries"),
    [
        ("slow:model.learning_rates.networks=2e-3", {"model.learning_rates.networks": 0.002}),
        (
            "thin:model.wrapping.widths=[8,16],train.steps=5",
            {"model.wrapping.widths": [8, 16], "train.steps": 5},
        ),
        ("bare:model.without=[local, mask]", {"model.without": ["local", "mask"]}),
        ("plain:method=3dgs", {"method": "3dgs"}),
        ("no-depth:data.use_depth=false", {"data.use_depth": False}),
    ],
)
def test_variants_are_read(text, entries):
    variant = parse_variant(text)
    assert variant.name == text.partition(":")[0]
    assert variant.entries == entries


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing", "expected NAME:KEY=VALUE"),
        ("../up:train.steps=1", "expected NAME"),
        ("wildgs:train.steps=1", "is a method"),
        ("x:train.steps", "is not KEY=VALUE"),
        ("x:", "is not KEY=VALUE"),
        ("x:train.seed=3", "--seeds"),
        ("x:scene=there", "SCENE"),
    ],
)
def test_other_variants_are_refused(text, said):
    with pytest.raises(UserError, match=said):
        parse_variant(text)


def test_jobs_differ_in_what_they_should(landmark: Path, tmp_path: Path):
    variants = [parse_variant("slow:train.optimizer.means=1e-4")]
    jobs = make_jobs([landmark], BASE, ["3dgs", "wildgs"], variants, (0, 7), tmp_path)
    assert [(job.seed, job.method) for job in jobs] == [
        (seed, method) for seed in (0, 7) for method in ("3dgs", "wildgs", "slow")
    ]
    assert len({job.folder for job in jobs}) == 6
    slow = jobs[-1]
    assert slow.folder == tmp_path / "scene" / "slow" / "seed_7"
    assert slow.config.train.seed == 7
    assert slow.config.scene == landmark.resolve()
    optimizer = replace(BASE.train.optimizer, means=1e-4)
    assert slow.config.train == replace(BASE.train, seed=7, optimizer=optimizer)


@pytest.mark.parametrize(
    ("variants", "seeds", "said"),
    [
        (("a:train.stebs=1",), (0,), "unknown entry 'stebs'"),
        (("a:train.steps=lots",), (0,), "--variant a: config.train.steps"),
        (("a:train.steps=1", "a:train.steps=2"), (0,), "a is given twice"),
        ((), (0, 0), "0 is given twice"),
    ],
)
def test_mistakes_are_found_before_training(landmark, tmp_path, variants, seeds, said):
    with pytest.raises(UserError, match=said):
        make_jobs([landmark], BASE, ["wildgs"], [parse_variant(v) for v in variants], seeds, tmp_path)


def test_two_scenes_of_one_name_are_refused(landmark, tmp_path):
    with pytest.raises(UserError, match="scene is given twice"):
        make_jobs([landmark, tmp_path / "scene"], BASE, ["wildgs"], [], (0,), tmp_path)


def test_runs_with_other_settings_are_not_mixed_in(landmark, tmp_path):
    (job,) = make_jobs([landmark], BASE, ["wildgs"], [], (0,), tmp_path)
    job.folder.mkdir(parents=True)
    write_config(job.folder / "config.yaml", job.config)
    shorter = replace(BASE, train=replace(BASE.train, steps=10))
    with pytest.raises(UserError, match=r"train\.steps is 30000 instead of 10"):
        make_jobs([landmark], shorter, ["wildgs"], [], (0,), tmp_path)
    make_jobs([landmark], BASE, ["wildgs"], [], (0,), tmp_path)


def test_a_budget_lowered_for_memory_is_no_other_setting(landmark, tmp_path):
    (job,) = make_jobs([landmark], BASE, ["wildgs"], [], (0,), tmp_path)
    job.folder.mkdir(parents=True)
    density = replace(BASE.train.density, max_gaussians=1000)
    lowered = replace(job.config, train=replace(job.config.train, density=density))
    write_config(job.folder / "config.yaml", lowered)
    (again,) = make_jobs([landmark], BASE, ["wildgs"], [], (0,), tmp_path)
    assert again.folder == job.folder


def test_what_stands_beside_the_papers_figures_is_the_preset_paper(landmark: Path, tmp_path: Path):
    variants = [parse_variant("clip:train.optimizer.means=1e-4")]
    suite = default_bench_methods("phototourism")
    jobs = make_jobs([landmark], BASE, suite, variants, (0,), tmp_path, reference_preset("phototourism"))
    configs = {job.method: replace(job.config, scene=BASE.scene) for job in jobs}
    paper = with_preset(BASE, "paper")
    compared = {name for name in configs if published_figures(PHOTOTOURISM[0], name)}
    assert compared == {"3dgs", "wildgs", "wildgs-half-steps"} | {
        f"without-{part}" for part in ("crop", "reverse", "global", "mask", "depth")
    }
    changes = {name: differing_entries(paper, configs[name]).keys() for name in [*compared, "clip"]}
    assert changes.pop("wildgs") == set()
    assert changes.pop("wildgs-half-steps") == {"train.steps"}
    assert changes.pop("clip") == {"train.optimizer.means"}
    assert configs["3dgs"] == paper.with_method("3dgs")
    del changes["3dgs"]
    assert all(entries == {"model.without"} for entries in changes.values())
    assert configs["default"] == BASE
    assert configs["paper-mended"] == with_preset(BASE, "paper-mended")
    assert "paper" not in configs


def test_without_a_suite_ablations_are_those_of_the_default():
    assert method_config("without-mask", BASE).model == replace(BASE.model, without=("mask",))
    with pytest.raises(UserError, match="--local-embeddings"):
        method_config("without-crop", BASE)
    assert {"paper", "wildgs"} <= set(default_bench_methods(None))
    assert "default" not in default_bench_methods(None)
    for name in default_bench_methods(None):
        method_config(name, BASE)
    assert "without-crop" in default_bench_methods("phototourism")


def test_preset_finds_its_scenes_in_the_papers_order(tmp_path):
    for name in ("trevi_fountain", "brandenburg_gate", "lincoln_memorial"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "split.tsv").touch()
    with pytest.warns(WildGSWarning, match="sacre_coeur not found"):
        scenes = find_phototourism([tmp_path])
    assert [scene.name for scene in scenes] == ["brandenburg_gate", "trevi_fountain"]
    with pytest.warns(WildGSWarning, match="sacre_coeur, trevi_fountain"):
        assert find_phototourism([tmp_path / "brandenburg_gate"]) == (tmp_path / "brandenburg_gate",)


def test_preset_without_scenes_or_split_says_what_to_do(tmp_path):
    with pytest.raises(UserError, match="none of the suite's scenes"):
        find_phototourism([tmp_path])
    (tmp_path / "sacre_coeur").mkdir()
    with (
        pytest.warns(WildGSWarning, match="brandenburg_gate, trevi_fountain not found"),
        pytest.raises(UserError, match="no split; put NeRF-W's"),
    ):
        find_phototourism([tmp_path])
