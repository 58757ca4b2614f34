"""Methods by name. A new method is a file of its own and one line here.

Classes are imported when they are first asked for, so that the command line can list methods without torch.
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
    """Where a method is, as ``module:name`` within this package.

    Attributes:
        method: The class.
        config: Its configuration, where that can be imported without torch; None takes the class's own.
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
        UserError: There is no such method.
    """
    return _find(_registered(name).method)


def config_type(name: MethodName) -> type:
    """The dataclass of a method's options.

    Raises:
        UserError: There is no such method.
    """
    place = _registered(name).config
    return method_type(name).Config if place is None else _find(place)


def create_method(
    name: MethodName, config: Any, scene: Scene, *, max_gaussians: int = 3_000_000, seed: int = 0
) -> Method:
    """A method at its start.

    Args:
        name: Which method.
        config: Its configuration; None for the defaults.
        scene: Where its first Gaussians come from.
        max_gaussians: Bound on their number.
        seed: Of random choices among points.
    """
    from wildgs.model.initial import initial_gaussians

    method = method_type(name)
    config = method.Config() if config is None else config
    return method.create(config, initial_gaussians(scene, method.initial(config), max_gaussians, seed))


def restore_method(name: MethodName, config: Any, state: dict[str, Tensor]) -> Method:
    """A method as `Method.state_dict` described it; reads no pretrained weights.

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
    """Checks that all rows are there, each with its shape and all with one length.

    Raises:
        KeyError: A row is missing.
        RuntimeError: A row has another shape.
    """
    count = rows["means"].shape[0]
    for row, shape in shapes.items():
        if rows[row].shape != (count, *shape):
            raise RuntimeError(f"{row} is {tuple(rows[row].shape)} where {(count, *shape)} is needed")
