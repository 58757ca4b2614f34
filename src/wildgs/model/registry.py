"""Registry of methods. A new method is a separate file and one line here.

Classes are imported at their first use, so that the command line can list methods without importing torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from wildgs.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from wildgs.model.method import Method
    from wildgs.scene import Scene


@dataclass(frozen=True)
class Registered:
    """Location of a method, as ``module:name``.

    Attributes:
        method: The class.
        config: Its configuration, if it can be imported without torch; None uses `Method.Config`.
    """

    method: str
    config: str | None = None


METHODS: dict[str, Registered] = {
    "wildgs": Registered("wildgs.model.wildgs:WildGS", "wildgs.model.config:WildGSConfig"),
    "3dgs": Registered("wildgs.model.vanilla:VanillaGS", "wildgs.model.config:VanillaConfig"),
    "affine": Registered("wildgs.model.affine:AffineGS"),
}
"""All methods; the first one is the default."""

DEFAULT_METHOD = next(iter(METHODS))
MethodName = str
"""A key of `METHODS`."""
_ROWS = "gaussians.rows."


def _find(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def _registered(name: MethodName) -> Registered:
    if name not in METHODS:
        raise UserError(f"method {name!r}: unknown; choose one of {', '.join(METHODS)}")
    return METHODS[name]


def method_type(name: MethodName) -> type[Method]:
    """The class of a method.

    Raises:
        UserError: The method is unknown.
    """
    return _find(_registered(name).method)


def config_type(name: MethodName) -> type:
    """The dataclass of a method's options.

    Raises:
        UserError: The method is unknown.
    """
    place = _registered(name).config
    return method_type(name).Config if place is None else _find(place)


def create_method(
    name: MethodName, config: Any, scene: Scene, *, max_gaussians: int = 3_000_000, seed: int = 0
) -> Method:
    """Creates an untrained method.

    Args:
        name: Name of the method.
        config: Its configuration; None for the defaults.
        scene: The scene, from which initial Gaussians are created.
        max_gaussians: Upper bound on their number.
        seed: Random seed of the selection of points.
    """
    from wildgs.model.initial import initial_gaussians

    method = method_type(name)
    config = method.Config() if config is None else config
    return method.create(config, initial_gaussians(scene, method.initial(config), max_gaussians, seed))


def restore_method(name: MethodName, config: Any, state: dict[str, Tensor]) -> Method:
    """Restores a method from `Method.state_dict`, without reading pretrained weights.

    Raises:
        UserError: The tensors do not belong to this method and configuration.
    """
    from wildgs.model.gaussians import Gaussians

    try:
        rows = {key.removeprefix(_ROWS): value for key, value in state.items() if key.startswith(_ROWS)}
        _check_rows(rows, method_type(name).rows(config))
        method = method_type(name).blank(config, Gaussians(rows), state)
        method.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise UserError(f"the checkpoint does not fit method {name} as configured: {first}") from error
    return method


def _check_rows(rows: dict[str, Tensor], shapes: dict[str, tuple[int, ...]]) -> None:
    """Checks names and shapes of all rows.

    Raises:
        KeyError: A row is missing.
        RuntimeError: A row has another shape.
    """
    count = rows["means"].shape[0]
    for row, shape in shapes.items():
        if rows[row].shape != (count, *shape):
            raise RuntimeError(f"{row} has shape {tuple(rows[row].shape)} instead of {(count, *shape)}")
