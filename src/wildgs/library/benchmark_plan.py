"""Plans the runs of a benchmark: all combinations of scenes, methods or variants, and seeds."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from wildgs.config import RunConfig, differing_entries, with_entries
from wildgs.config_file import CONFIG_FILE, read_config
from wildgs.errors import UserError, WildGSWarning
from wildgs.evaluation.benchmark_table import PHOTOTOURISM
from wildgs.library.config import BENCH_METHODS, ENTRIES_WITHOUT, HALF, WITHOUT
from wildgs.model.registry import METHODS, method_type
from wildgs.presets import PRESETS, PresetName, with_preset
from wildgs.scene.colmap import find_model
from wildgs.scene.split import find_split_file

_ABLATION_LABELS = {"reverse": "w/o {c'}", "flat-ground": "w/o Flat Ground"}

PHOTOTOURISM_DOWNSCALE = 2
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_NEXT_ENTRY = re.compile(r",(?=[\w.]+=)")
_BENCH_ENTRIES = {"scene": "use the argument SCENES", "train.seed": "use --seeds"}


@dataclass(frozen=True)
class Variant:
    """Wild-GS, or another method, with some entries of its configuration changed."""

    name: str
    entries: Mapping[str, Any]


@dataclass(frozen=True)
class Job:
    """One run to train and to score; `method` is one of `BENCH_METHODS` or the name of a variant."""

    scene: str
    method: str
    seed: int
    folder: Path
    config: RunConfig

    @property
    def title(self) -> str:
        """The job's name on the console."""
        return f"{self.scene}, {label_of(self.method)}, seed {self.seed}"


def parse_variant(text: str) -> Variant:
    """Parses ``NAME:KEY=VALUE[,KEY=VALUE...]``; keys are paths in `config.yaml`, values JSON or YAML.

    Raises:
        UserError: The text has another form, or changes an entry that the benchmark sets.
    """
    name, colon, rest = text.partition(":")
    if not colon or not _NAME.fullmatch(name):
        raise UserError(
            f"--variant {text}: expected NAME:KEY=VALUE, for example slow:model.learning_rates.networks=5e-4"
        )
    if name in BENCH_METHODS:
        raise UserError(f"--variant {text}: {name} is a method of the benchmark; choose another name")
    entries: dict[str, Any] = {}
    for entry in _NEXT_ENTRY.split(rest):
        key, equals, value = entry.partition("=")
        if not equals or not key.strip():
            raise UserError(
                f"--variant {text}: {entry!r} is not KEY=VALUE; the keys are those of config.yaml"
            )
        if key.strip() in _BENCH_ENTRIES:
            raise UserError(
                f"--variant {text}: a variant cannot set {key.strip()}; {_BENCH_ENTRIES[key.strip()]}"
            )
        entries[key.strip()] = _plain(value)
    return Variant(name, entries)


def _plain(text: str) -> Any:
    try:
        return json.loads(text)  # first, since YAML reads 2e-3 as a string
    except ValueError:
        pass
    try:
        return yaml.safe_load(text)
    except (ValueError, yaml.YAMLError):
        return text


def find_phototourism(places: Sequence[Path]) -> tuple[Path, ...]:
    """Finds the paper's scenes among folders or one level below them, and warns of missing ones.

    Raises:
        UserError: None is found, or one has no NeRF-W split, for which the paper's figures hold.
    """
    candidates = [*places, *(place / name for place in places for name in PHOTOTOURISM)]
    found = {path.resolve().name: path for path in reversed(candidates) if path.is_dir()}
    scenes = tuple(found[name] for name in PHOTOTOURISM if name in found)
    missing = ", ".join(name for name in PHOTOTOURISM if name not in found)
    searched = ", ".join(map(str, places))
    if not scenes:
        raise UserError(
            f"{searched}: none of the suite's scenes ({missing}) found; give the folder with them"
        )
    if missing:
        warnings.warn(f"{searched}: {missing} not found; the table omits them", WildGSWarning, stacklevel=2)
    for scene in scenes:
        if find_split_file(scene) is None:
            raise UserError(
                f"{scene}: no split; put NeRF-W's .tsv of this scene into it, because the paper's figures are for "
                "the photos of that split"
            )
    return scenes


def make_jobs(
    scenes: Sequence[Path],
    base: RunConfig,
    methods: Sequence[str],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    output: Path,
    reference: PresetName = "default",
) -> list[Job]:
    """All runs, ordered by scene and seed, so that the table is complete for the first seed early.

    Args:
        scenes: Scene folders.
        base: Base configuration; its scene and seed are replaced.
        methods: Members of `BENCH_METHODS`.
        variants: Changes of `base` with the preset `reference`.
        seeds: Random seeds.
        output: The benchmark's folder; run folders are OUTPUT/<scene>/<method>/seed_<n>.
        reference: The preset of all rows except those of other presets.

    Raises:
        UserError: A folder is not a scene, names are not unique, an entry of a variant does not exist, or a run
            folder contains a run with other settings.
    """
    _check_unique("scene", [scene.resolve().name for scene in scenes])
    _check_unique("--variant", [variant.name for variant in variants])
    _check_unique("--methods", methods)
    _check_unique("--seeds", [str(seed) for seed in seeds])
    configs = {method: method_config(method, base, reference) for method in methods}
    changed = with_preset(base, reference)
    configs |= {v.name: with_entries(changed, v.entries, f"--variant {v.name}: config") for v in variants}
    jobs = []
    for scene in (scene.resolve() for scene in scenes):
        find_model(scene)
        for seed in seeds:
            for method, config in configs.items():
                train = replace(config.train, seed=seed)
                folder = output / scene.name / method / f"seed_{seed}"
                jobs.append(Job(scene.name, method, seed, folder, replace(config, scene=scene, train=train)))
    for job in jobs:
        _check_stored(job)
    return jobs


def _check_unique(what: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{what}: {name} is given twice; names must be unique")


def label_of(name: str) -> str:
    """The label of a method in the table; ablations are labelled as in the paper."""
    if name in METHODS:
        return method_type(name).label
    if name.endswith(HALF):
        return method_type(name.removesuffix(HALF)).label + "†"
    if name in PRESETS:
        return f"preset {name}"
    if name in BENCH_METHODS:
        part = name.removeprefix(WITHOUT)
        return _ABLATION_LABELS.get(part, f"w/o {part.capitalize()}")
    return name


def method_config(method: str, base: RunConfig, reference: PresetName = "default") -> RunConfig:
    """The configuration of one of `BENCH_METHODS`: `base` with that preset, or with the preset `reference`.

    Raises:
        UserError: The method is unknown.
    """
    if method not in BENCH_METHODS and method not in METHODS:
        raise UserError(f"--methods {method}: unknown; choose from {', '.join(BENCH_METHODS)}")
    if method in PRESETS:
        return with_preset(base, method)
    base = with_preset(base, reference)
    if method in METHODS:
        return base.with_method(method)
    if method.endswith(HALF):
        return replace(base, train=replace(base.train, steps=max(1, base.train.steps // 2)))
    part = method.removeprefix(WITHOUT)
    if part in ENTRIES_WITHOUT:
        return with_entries(base, ENTRIES_WITHOUT[part])
    return with_entries(base, {"model.without": [*base.model.without, part]})


def _check_stored(job: Job) -> None:
    """Raises `UserError` if the job's folder contains a run with other settings."""
    file = job.folder / CONFIG_FILE
    if not file.is_file():
        return
    differing = differing_entries(read_config(file), job.config)
    budget = differing.get("train.density.max_gaussians")
    if budget is not None and budget[0] < budget[1]:  # lowered because memory was short
        del differing["train.density.max_gaussians"]
    if differing:
        entry, (stored, new) = next(iter(differing.items()))
        raise UserError(
            f"{job.folder} holds a run with other settings ({entry} is {stored} instead of {new}); choose another "
            "--output or another name for the variant"
        )
