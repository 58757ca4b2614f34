"""The configuration of a run, composed of the packages' dataclasses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from wildgs.earlier_defaults import with_earlier_defaults
from wildgs.engine.config import TrainConfig
from wildgs.errors import UserError
from wildgs.model.registry import DEFAULT_METHOD, MethodName, config_type
from wildgs.plain_values import entry_types, flat, from_plain, to_plain
from wildgs.scene.config import IMAGE_CACHE, DataConfig, parse_bytes

BUDGET = "train.density.max_gaussians"  # the only entry that may change when a run is resumed

_MAX_VALUE = 1e9
_RANGES: dict[str, tuple[float, float]] = {
    "data.downscale": (1, 1000),
    "data.max_image_pixels": (1, 1e12),
    "train.seed": (0, 2**63 - 1),
    "train.objective.weight_l1": (0, 1),
    "train.objective.mask_power": (0, 16),
    "train.optimizer.means": (1e-12, _MAX_VALUE),
    "train.optimizer.short_runs": (0, 1),
    "train.density.reset_opacity": (1e-6, 1),
    "train.density.max_gaussians": (1, _MAX_VALUE),
    "train.density.grow_share": (0, 1),
    "train.density.prune_share": (0, 1),
    "train.density.grow_error": (0, _MAX_VALUE),
    "train.density.least_pixels": (0, _MAX_VALUE),
    "train.density.min_visibility": (0, 1),
    "train.dropout.rate": (0, 0.9),
    "train.dropout.neighbours": (1, 1024),
    "train.flat_ground.rate": (0, 1),
    "train.flat_ground.height": (0, _MAX_VALUE),
    "train.warp.least_share": (0, 1),
    "train.warp.rate": (0, 1),
    "train.warp.friction": (0, 10),
    "train.warp.cells": (1, 256),
    "train.warp.most": (0, 0.2),
    "train.warp.photos": (0, _MAX_VALUE),
    "model.mask_threshold": (0, 1),
    "model.matched_loss": (0, 1),
    "model.light_codes": (0, 64),
    "model.light_components": (0, 256),
    "model.embedding_noise": (0, 10),
    "model.embedding_scale": (0, 1),
    "model.eps2d": (0.01, 10),
    "model.parsing.max_side": (16, 4096),
    "model.parsing.global_size": (1, 1024),
    "model.fusion.intrinsic_size": (3, 1024),
    "model.fusion.hidden": (1, 4096),
    "model.photo_size": (1, 1024),
    "model.gaussian_size": (1, 1024),
    "model.hidden": (1, 4096),
    "model.encode_steps": (0, 1e6),
    "model.depth_points.cell": (1e-4, 1e3),
    "model.depth_points.agreement": (0, 1),
    "model.ground.points": (0, 1e7),
    "model.ground.spacing": (1e-4, 1e3),
    "model.ground.most_pixels": (0, 1e6),
    "model.sky.points": (0, 1e7),
    "model.sky.radius": (1e-3, 1e6),
    "model.sky.reach": (0, 1e6),
    "model.sky.lowest": (-90, 89),
    "model.sky.opacity": (1e-6, 0.999999),
}
"""Smallest and largest value of numeric entries; those not listed range from 0 to `_MAX_VALUE`."""


@dataclass(frozen=True)
class ExecutionConfig:
    """How training is executed. These options do not affect the result and may change when a run is resumed.

    Attributes:
        image_cache: Memory for decoded photos; photos that do not fit are decoded again at every use.
        checkpoint_every: Steps between checkpoints.
        checkpoint_minutes: Largest time between checkpoints, in minutes.
        log_every: Steps between entries of metrics.jsonl and TensorBoard.
        pictures_every: Steps between images on TensorBoard.
        cuda_graphs: Capture and replay the networks as CUDA graphs (on CUDA devices).
        feature_cache: Memory for the frozen encoder's features of training photos; those of photos that do not fit
            are computed again at every use.
        threads: Number of CPU threads of kernels and torch. Default: WILDGS_NUM_THREADS, else all cores.
    """

    image_cache: str = IMAGE_CACHE
    checkpoint_every: int = 1000
    checkpoint_minutes: float = 10.0
    log_every: int = 50
    pictures_every: int = 500
    cuda_graphs: bool = True
    feature_cache: str = "1GB"
    threads: int | None = None

    def __post_init__(self) -> None:
        """Validates the values."""
        parse_bytes(self.image_cache)
        parse_bytes(self.feature_cache)
        for name in ("checkpoint_every", "checkpoint_minutes", "log_every", "pictures_every", "threads"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise UserError(f"--{name.replace('_', '-')} {value}: must be above 0")


@dataclass(frozen=True)
class RunConfig:
    """Everything that affects the result of a run.

    Attributes:
        scene: The scene folder at the time of training; ignored when configurations are compared.
        method: A name in `wildgs.model.registry.METHODS`.
        data: How the scene is read.
        model: The method's options, an instance of its `Config`; None = defaults.
        train: Training.
    """

    scene: Path = field(default=Path(), compare=False)
    method: MethodName = DEFAULT_METHOD
    data: DataConfig = field(default_factory=DataConfig)
    model: Any = None
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        """Sets the method's default options if none are given, and validates all values.

        Raises:
            TypeError: `model` holds the options of another method.
            UserError: A value is out of range.
        """
        kind = config_type(self.method)
        if self.model is None:
            object.__setattr__(self, "model", kind())
        elif not isinstance(self.model, kind):
            raise TypeError(
                f"method {self.method} takes a {kind.__name__}, not a {type(self.model).__name__}"
            )
        for path, value in flat(to_plain(self)).items():
            least, most = _RANGES.get(path.replace("model.initial.", "model."), (0, _MAX_VALUE))
            if isinstance(value, int | float) and not least <= value <= most:  # also rejects NaN
                raise UserError(f"{path} {value}: must be from {least:g} to {most:g}")

    @classmethod
    def upgraded(cls, plain: dict[Any, Any], where: str) -> tuple[dict[Any, Any], dict[str, Any]]:
        """The current form of an earlier version's entries, and the type of the method's options."""
        try:
            kind = config_type(_method_of(plain))
        except UserError as error:
            raise UserError(f"{where}.{error}") from error
        return _upgraded(plain, kind), {"model": kind}

    def with_method(self, method: MethodName) -> RunConfig:
        """The configuration with another method and that method's default options."""
        return self if method == self.method else dataclasses.replace(self, method=method, model=None)


ConfigT = TypeVar("ConfigT")


def validated(config: ConfigT) -> ConfigT:
    """A configuration from Python, with entries of the annotated types, as if it had been read from a file.

    Raises:
        UserError: An entry has another type, for example a float where an integer is expected.
    """
    return from_plain(type(config), to_plain(config), type(config).__name__)


def _method_of(plain: dict[Any, Any]) -> str:
    return str(plain.get("method", DEFAULT_METHOD))


_MOVED_RATES = {name: name for name in ("intrinsic", "networks", "encoder", "sh0", "shN")} | {
    "network_decay": "decay"
}
"""Entries of `train.optimizer` in earlier versions -> entries of `model.learning_rates` now."""


def _upgraded(plain: dict[Any, Any], model_type: type) -> dict[Any, Any]:
    """Converts the configuration of an earlier version's run to the current form.

    Learning rates of a method's own parameters were entries of `train.optimizer`, every method had the default
    method's options, and `train.objective` repeated the mask threshold.
    """
    plain = with_earlier_defaults(plain)
    known = entry_types(model_type)
    model = plain.get("model")
    if isinstance(model, dict):
        foreign = entry_types(config_type(DEFAULT_METHOD)).keys() - known.keys()
        plain = plain | {"model": {name: value for name, value in model.items() if name not in foreign}}
    train = plain.get("train")
    optimizer = train.get("optimizer") if isinstance(train, dict) else None
    if not isinstance(train, dict) or not isinstance(optimizer, dict):
        return plain
    moved = {name: optimizer[name] for name in _MOVED_RATES if name in optimizer}
    if not moved:
        return plain
    kept = {name: value for name, value in optimizer.items() if name not in moved}
    objective = {n: v for n, v in (train.get("objective") or {}).items() if n != "mask_threshold"}
    plain = plain | {"train": train | {"optimizer": kept, "objective": objective}}
    own = entry_types(known["learning_rates"]) if "learning_rates" in known else {}
    rates = {_MOVED_RATES[name]: value for name, value in moved.items() if _MOVED_RATES[name] in own}
    return plain | {"model": (plain.get("model") or {}) | ({"learning_rates": rates} if rates else {})}


def with_entries(config: RunConfig, entries: Mapping[str, Any], where: str = "config") -> RunConfig:
    """Sets some entries of a configuration.

    Args:
        config: The configuration.
        entries: Paths such as ``model.learning_rates.networks`` and their plain values.
        where: Source of the entries, for messages.

    Raises:
        UserError: There is no such entry, or a value has the wrong type.
    """
    if isinstance(method := entries.get("method"), str):
        try:
            config = config.with_method(method)  # first: the other entries are options of this method
        except UserError as error:
            raise UserError(f"{where}.method: {error}") from error
    plain = to_plain(config)
    for path, value in entries.items():
        *parents, name = path.split(".")
        inner = plain
        for parent in parents:
            inner = inner.setdefault(parent, {})
            if not isinstance(inner, dict):
                raise UserError(f"{where}: {path}: {parent} is a value and has no entries of its own")
        inner[name] = value
    return from_plain(RunConfig, plain, where)


def differing_entries(first: RunConfig, second: RunConfig) -> dict[str, tuple[Any, Any]]:
    """Entries, other than `scene`, in which two configurations differ: path -> both plain values."""
    one, other = flat(to_plain(first)), flat(to_plain(second))
    paths = dict.fromkeys(path for path in (*one, *other) if path != "scene")
    return {p: (one.get(p), other.get(p)) for p in paths if one.get(p) != other.get(p)}


def edited_entries(config: RunConfig, plain: Any) -> str:
    """Describes in what a configuration differs from that in a checkpoint's header; empty if in nothing.

    The scene folder, the upper bound on Gaussians and entries that only one of them has are ignored.

    Args:
        config: The current configuration, from `config.yaml`.
        plain: The plain configuration in the checkpoint's header.
    """
    now, then = flat(to_plain(config)), flat(plain)
    allowed = {"scene", BUDGET}
    changed = [path for path in now if path in then and path not in allowed and now[path] != then[path]]
    return ", ".join(f"{path} was {then[path]}, is {now[path]}" for path in changed[:3])
