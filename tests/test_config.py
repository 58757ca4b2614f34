"""Entries of a run's configuration changed by path."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wildgs.config import RunConfig, differing_entries, validated, with_entries
from wildgs.errors import UserError
from wildgs.model.config import VanillaConfig, VanillaRates, WildGSRates, WrappingConfig
from wildgs.plain_values import from_plain, to_plain

BASE = RunConfig(Path("scene"))


def test_changes_what_it_names_and_nothing_else():
    changed = with_entries(BASE, {"model.learning_rates.networks": 2, "model.wrapping.widths": [8, 16]})
    assert changed.model.learning_rates.networks == 2.0
    assert changed.model.wrapping.widths == (8, 16)
    assert differing_entries(BASE, changed) == {
        "model.learning_rates.networks": (BASE.model.learning_rates.networks, 2.0),
        "model.wrapping.widths": (list(BASE.model.wrapping.widths), [8, 16]),
    }
    assert BASE.model.learning_rates.networks != 2


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"train.optimiser.networks": 1.0}, "unknown entry 'optimiser'"),
        ({"train.optimizer.mean": 1.0}, "choose from"),
        ({"train.steps": "many"}, "config.train.steps: 'many' is not a int"),
        ({"train.steps.more": 1}, "steps is a value"),
        ({"method": "nerf"}, "config.method"),
        ({"data.downscale": 0}, "downscale"),
        ({"data.downscale": 1e12}, "downscale"),
        ({"model.mask_threshold": float("nan")}, "mask_threshold"),
        ({"model.mask_threshold": -1}, "mask_threshold -1.0: must be from 0 to 1"),
        ({"model.sky.points": -1}, "model.sky.points -1: must be from 0"),
        ({"model.sky.lowest": 1e12}, "model.sky.lowest"),
        ({"model.fusion.hidden": 10**9}, "model.fusion.hidden 1000000000"),
        ({"method": "affine", "model.photo_size": 10**9}, "model.photo_size"),
        ({"method": "affine", "model.initial.sky.points": -1}, "model.initial.sky.points"),
        ({"train.optimizer.means": 0}, "train.optimizer.means 0"),
        ({"train.objective.depth_weight": float("inf")}, "depth_weight inf"),
        ({"model.learning_rates.networks": -1}, "networks -1"),
        ({"model.without": ["mask", "crop"]}, "without crop: .*--local-embeddings"),
    ],
)
def test_what_does_not_exist_or_fit_is_named(entries, said):
    with pytest.raises(UserError, match=said):
        with_entries(BASE, entries)


def unchecked(group: str, name: str, value: object) -> RunConfig:
    """The configuration that a user gets where no type is checked; the tests' import hook checks them."""
    config = copy.deepcopy(BASE)
    object.__setattr__(getattr(config, group), name, value)
    return config


@pytest.mark.parametrize(
    ("group", "name", "value", "said"),
    [
        ("train", "steps", 3e1, "train.steps: 30.0 is not a int"),
        ("data", "use_masks", "false", "data.use_masks"),
        ("data", "holdout", False, "data.holdout"),
        ("train", "precision", "foo", "train.precision"),
    ],
)
def test_values_of_another_type_are_named_before_they_are_used(group, name, value, said):
    with pytest.raises(UserError, match=said):
        validated(unchecked(group, name, value))


def test_numbers_of_numpy_are_numbers():
    assert validated(unchecked("train", "steps", np.int64(5))).train == replace(BASE.train, steps=5)
    assert validated(unchecked("data", "downscale", np.float64(2))).data == replace(BASE.data, downscale=2.0)
    assert validated(BASE) == BASE


def test_files_of_earlier_versions_open():
    """Rates of a method's own parameters lay in `train.optimizer`, and 3dgs carried Wild-GS's options."""
    rates = {
        "means": 1e-4,
        "intrinsic": 1e-3,
        "networks": 2e-3,
        "encoder": 3e-4,
        "network_decay": 0.5,
        "sh0": 4e-3,
    }
    train = {"steps": 7, "optimizer": rates, "objective": {"mask_threshold": 0.5, "weight_l1": 0.7}}
    old = {"scene": "there", "model": {"without": ["mask"], "sky": {"points": 3}}, "train": train}
    wildgs = from_plain(RunConfig, old)
    assert wildgs.model.learning_rates == WildGSRates(1e-3, 2e-3, 3e-4, 0.5)
    assert (wildgs.model.without, wildgs.model.sky.points) == (("mask",), 3)
    assert (wildgs.train.steps, wildgs.train.optimizer.means, wildgs.train.objective.weight_l1) == (
        7,
        1e-4,
        0.7,
    )
    vanilla = from_plain(RunConfig, old | {"method": "3dgs"})
    assert vanilla.model == VanillaConfig(VanillaRates(sh0=4e-3))
    assert from_plain(RunConfig, to_plain(vanilla)) == vanilla


def test_runs_of_earlier_versions_resume_as_they_began():
    """What their `config.yaml` does not name was not there when they began."""
    plain = to_plain(BASE)
    model, train = plain["model"], plain["train"]
    for name in ("matched_loss", "light_codes", "light_components", "eps2d"):
        assert model.pop(name) > 0
    assert model.pop("local_embeddings") is False
    assert model.pop("antialiased") is True
    assert train["schedule"].pop("mask_visits") > 0
    assert model["sky"].pop("densify") is False
    assert model["sky"].pop("own_fusion") is True
    assert train["optimizer"].pop("short_runs") > 0
    assert train["objective"].pop("mask_weight_photos") > 0
    assert train["objective"].pop("mask_power") > 1
    assert train["objective"].pop("consensus") is True
    assert train["objective"].pop("free_space") is True
    assert train["objective"].pop("sky_weight") > 0
    assert train["objective"].pop("opaque_weight") > 0
    assert train["density"].pop("min_visibility") > 0.5
    del model["camera_response"]
    config = from_plain(RunConfig, plain)
    assert not config.model.camera_response.fits
    assert (config.model.matched_loss, config.model.light_codes, config.model.light_components) == (0, 0, 0)
    assert config.model.eps2d == 0.3  # with which its Gaussians were trained
    assert not config.model.antialiased
    assert config.train.schedule.mask_visits == 0
    assert config.model.local_embeddings
    assert config.model.sky.densify
    assert not config.model.sky.own_fusion
    assert config.train.optimizer.short_runs == 0
    assert (config.train.objective.mask_weight_photos, config.train.objective.mask_power) == (0, 1)
    assert config.train.objective.consensus is False
    assert config.train.objective.free_space is False
    assert config.train.objective.sky_weight == 0
    assert config.train.objective.opaque_weight == 0
    assert config.train.density.min_visibility == 0.5
    assert from_plain(RunConfig, to_plain(BASE)) == BASE


def test_a_configuration_takes_its_own_methods_options_alone():
    assert RunConfig(Path("scene"), "3dgs").model == VanillaConfig()
    assert BASE.with_method("3dgs").with_method("wildgs") == BASE
    with pytest.raises(TypeError, match="3dgs takes a VanillaConfig"):
        RunConfig(Path("scene"), "3dgs", model=BASE.model)


@pytest.mark.parametrize(
    "wrong",
    [{"resolution": 200_000}, {"resolution": 0}, {"features": 10**6}, {"widths": ()}, {"widths": (8, 10**6)},
     {"crop_ratio": 0.0}, {"crop_ratio": float("nan")}, {"box_quantile": 0.5}, {"partial_lifts": 2.0}],
)  # fmt: skip
def test_planes_that_no_memory_holds_are_refused(wrong: dict) -> None:
    """A configuration file may say 200,000 cells a side, which are 1.9 TB."""
    (name,) = wrong
    with pytest.raises(UserError, match=f"wrapping.{name} "):
        WrappingConfig(**wrong)
