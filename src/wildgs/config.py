"""The configuration of a run, composed of the packages' dataclasses, and its YAML file."""

from __future__ import annotations

import dataclasses
import reprlib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
import yaml.composer

from wildgs.earlier_defaults import with_earlier_defaults
from wildgs.engine.config import TrainConfig
from wildgs.errors import UserError
from wildgs.files import check_regular, written_aside
from wildgs.model.registry import DEFAULT_METHOD, MethodName, config_type
from wildgs.scene.config import IMAGE_CACHE, DataConfig, parse_bytes

CONFIG_FILE = "config.yaml"
MAX_CONFIG_BYTES = 1_000_000
BUDGET = "train.density.max_gaussians"  # the only entry that may change when a run is resumed

_BEGIN, _END = "# Configuration of a run of wildgs", "# End of the configuration"
"""First and last line, to detect truncation: a truncated file could still be valid YAML with entries missing."""
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
_MOVED = (("data", "image_cache"), ("train", "cuda_graphs"))
"""Entries of earlier versions' `config.yaml` that are part of `ExecutionConfig` now."""


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
        for path, value in _flat(to_plain(self)).items():
            least, most = _RANGES.get(path.replace("model.initial.", "model."), (0, _MAX_VALUE))
            if isinstance(value, int | float) and not least <= value <= most:  # also rejects NaN
                raise UserError(f"{path} {value}: must be from {least:g} to {most:g}")

    def with_method(self, method: MethodName) -> RunConfig:
        """The configuration with another method and that method's default options."""
        return self if method == self.method else dataclasses.replace(self, method=method, model=None)


ConfigT = TypeVar("ConfigT")


def to_plain(value: Any) -> Any:
    """Converts a configuration to dicts, lists, strings and numbers."""
    if type(value).__module__ == "numpy":  # np.float32(2), for example
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def validated(config: ConfigT) -> ConfigT:
    """A configuration from Python, with entries of the annotated types, as if it had been read from a file.

    Raises:
        UserError: An entry has another type, for example a float where an integer is expected.
    """
    return from_plain(type(config), to_plain(config), type(config).__name__)


def from_plain(kind: Any, value: Any, where: str = "config") -> Any:
    """The inverse of `to_plain`; missing entries take their defaults.

    Args:
        kind: Type to convert to.
        value: Plain value.
        where: Path of the entry, for messages.

    Raises:
        UserError: An entry is unknown or has the wrong type.
    """
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_plain(kind, value, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal and value in arguments:
        return value
    if origin in (typing.Union, types.UnionType):
        return _union_from_plain(arguments, value, where)
    if origin is tuple and isinstance(value, list):
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(inner) == len(value):
            return tuple(from_plain(k, v, where) for k, v in zip(inner, value, strict=True))
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and type(value) is kind and value == value:  # rejects NaN
        return value
    raise UserError(f"{where}: {reprlib.repr(value)} is not a {getattr(kind, '__name__', kind)}")


def _dataclass_from_plain(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise UserError(f"{where}: expected a mapping, found {reprlib.repr(value)}")
    hints = typing.get_type_hints(kind)
    if kind is RunConfig:
        try:
            config_type(_method_of(value))
        except UserError as error:
            raise UserError(f"{where}.{error}") from error
        value = _upgraded(value)
        hints["model"] = config_type(_method_of(value))
    known = {f.name for f in dataclasses.fields(kind)}
    if unknown := sorted(map(str, set(value) - known)):
        raise UserError(f"{where}: unknown entry {unknown[0][:80]!r}; choose from {', '.join(sorted(known))}")
    required = {f.name for f in dataclasses.fields(kind) if _is_required(f)}
    if missing := sorted(required - set(value)):
        raise UserError(f"{where}: the entry {missing[0]!r} is missing")
    return kind(**{name: from_plain(hints[name], entry, f"{where}.{name}") for name, entry in value.items()})


def _method_of(plain: dict[Any, Any]) -> str:
    return str(plain.get("method", DEFAULT_METHOD))


_MOVED_RATES = {name: name for name in ("intrinsic", "networks", "encoder", "sh0", "shN")} | {
    "network_decay": "decay"
}
"""Entries of `train.optimizer` in earlier versions -> entries of `model.learning_rates` now."""


def _upgraded(plain: dict[Any, Any]) -> dict[Any, Any]:
    """Converts the configuration of an earlier version's run to the current form.

    Learning rates of a method's own parameters were entries of `train.optimizer`, every method had the default
    method's options, and `train.objective` repeated the mask threshold.
    """
    plain = with_earlier_defaults(plain)
    known = _entries(config_type(_method_of(plain)))
    model = plain.get("model")
    if isinstance(model, dict):
        foreign = _entries(config_type(DEFAULT_METHOD)).keys() - known.keys()
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
    own = _entries(known["learning_rates"]) if "learning_rates" in known else {}
    rates = {_MOVED_RATES[name]: value for name, value in moved.items() if _MOVED_RATES[name] in own}
    return plain | {"model": (plain.get("model") or {}) | ({"learning_rates": rates} if rates else {})}


def _entries(kind: Any) -> dict[str, Any]:
    """Names and types of a dataclass's fields."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


def _is_required(entry: dataclasses.Field[Any]) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING


def _union_from_plain(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    for kind in kinds:
        try:
            return from_plain(kind, value, where)
        except UserError:
            continue
    names = " or ".join("None" if k is type(None) else getattr(k, "__name__", str(k)) for k in kinds)
    raise UserError(f"{where}: {reprlib.repr(value)} is not of type {names}")


class _Loader(yaml.SafeLoader):
    """Loads plain data and rejects aliases, with which a small file can expand beyond the memory."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "references are not allowed", event.start_mark)
        return super().compose_node(parent, index)


def write_config(path: Path, config: RunConfig) -> None:
    """Writes YAML atomically.

    Raises:
        UserError: The file cannot be written.
    """
    with written_aside(path, flush=True) as aside, aside.open("w", encoding="utf-8") as file:
        file.write(f"{_BEGIN}\n")
        yaml.safe_dump(to_plain(config), file, sort_keys=False)
        file.write(f"{_END}\n")


def read_config(path: Path) -> RunConfig:
    """Reads YAML.

    Raises:
        UserError: The file is missing, not YAML, or not the configuration of a run.
    """
    try:
        check_regular(path)
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise UserError(
                f"{path} is larger than {MAX_CONFIG_BYTES} bytes; it is not a run's configuration"
            )
        text = path.read_text(encoding="utf-8")
        if text.startswith(_BEGIN) and _END not in text.splitlines():
            raise UserError(f"{path} is truncated: the line {_END!r} is missing; restore it from a copy")
        plain = yaml.load(text, _Loader)
    except FileNotFoundError as error:
        raise UserError(
            f"{path.parent} contains no run: {path.name} is missing; give another folder, or train without --resume"
        ) from error
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:  # ValueError: an invalid date
        raise UserError(f"{path} cannot be read as a run's configuration: {error}".splitlines()[0]) from error
    for part, name in _MOVED:
        if isinstance(plain, dict) and isinstance(plain.get(part), dict):
            plain[part].pop(name, None)
    return from_plain(RunConfig, plain, str(path))


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
    one, other = _flat(to_plain(first)), _flat(to_plain(second))
    paths = dict.fromkeys(path for path in (*one, *other) if path != "scene")
    return {p: (one.get(p), other.get(p)) for p in paths if one.get(p) != other.get(p)}


def edited_entries(config: RunConfig, plain: Any) -> str:
    """Describes in what a configuration differs from that in a checkpoint's header; empty if in nothing.

    The scene folder, the upper bound on Gaussians and entries that only one of them has are ignored.

    Args:
        config: The current configuration, from `config.yaml`.
        plain: The plain configuration in the checkpoint's header.
    """
    now, then = _flat(to_plain(config)), _flat(plain)
    allowed = {"scene", "train.density.max_gaussians"}
    changed = [path for path in now if path in then and path not in allowed and now[path] != then[path]]
    return ", ".join(f"{path} was {then[path]}, is {now[path]}" for path in changed[:3])


def _flat(plain: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(plain, dict):
        return {path: plain}
    parts = (_flat(value, f"{path}.{name}" if path else name) for name, value in plain.items())
    return {key: value for part in parts for key, value in part.items()}
