"""Wild-GS: relightable 3D Gaussian scenes from unconstrained photo collections."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from wildgs.version import __version__ as __version__

if TYPE_CHECKING:
    from wildgs.api import LoadedScene as LoadedScene
    from wildgs.api import load as load
    from wildgs.light.look import Look as Look
    from wildgs.light.look import mix as mix

_HOMES = {
    "load": "wildgs.api",
    "LoadedScene": "wildgs.api",
    "Look": "wildgs.light.look",
    "mix": "wildgs.light.look",
}


def __getattr__(name: str) -> Any:
    """The Python API, imported when it is first asked for: `wildgs --help` must not wait for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'wildgs' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
