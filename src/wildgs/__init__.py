"""Wild-GS: relightable 3D Gaussian scenes from unconstrained photo collections.

Every command of the command line is a function of this package (docs/python.md). All names are imported lazily, so
that `import wildgs` is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from wildgs.version import __version__ as __version__

if TYPE_CHECKING:
    from wildgs.config import ExecutionConfig as ExecutionConfig
    from wildgs.config import RunConfig as RunConfig
    from wildgs.engine.config import TrainConfig as TrainConfig
    from wildgs.errors import UserError as UserError
    from wildgs.errors import WildGSWarning as WildGSWarning
    from wildgs.library.benchmark import benchmark as benchmark
    from wildgs.library.config import MixOptions as MixOptions
    from wildgs.library.config import TrajectoryOptions as TrajectoryOptions
    from wildgs.library.doctor import examine as examine
    from wildgs.library.evaluation import evaluate as evaluate
    from wildgs.library.exporting import export as export
    from wildgs.library.gallery import gallery as gallery
    from wildgs.library.loaded import LoadedScene as LoadedScene
    from wildgs.library.loaded import appearance as appearance
    from wildgs.library.loaded import load as load
    from wildgs.library.pipeline import demo as demo
    from wildgs.library.pipeline import estimate_depth as estimate_depth
    from wildgs.library.pipeline import run as run
    from wildgs.library.rendering import render as render
    from wildgs.library.training import train as train
    from wildgs.light.look import Look as Look
    from wildgs.light.look import mix as mix
    from wildgs.scene.config import DataConfig as DataConfig
    from wildgs.sfm.reconstruction import reconstruct as reconstruct
    from wildgs.viewer.serving import view as view

_MODULES = {
    "DataConfig": "scene.config",
    "ExecutionConfig": "config",
    "LoadedScene": "library.loaded",
    "Look": "light.look",
    "MixOptions": "library.config",
    "RunConfig": "config",
    "TrainConfig": "engine.config",
    "TrajectoryOptions": "library.config",
    "UserError": "errors",
    "WildGSWarning": "errors",
    "appearance": "library.loaded",
    "benchmark": "library.benchmark",
    "demo": "library.pipeline",
    "estimate_depth": "library.pipeline",
    "evaluate": "library.evaluation",
    "examine": "library.doctor",
    "export": "library.exporting",
    "gallery": "library.gallery",
    "load": "library.loaded",
    "mix": "light.look",
    "reconstruct": "sfm.reconstruction",
    "render": "library.rendering",
    "run": "library.pipeline",
    "train": "library.training",
    "view": "viewer.serving",
}


def __getattr__(name: str) -> Any:
    """Imports a name of the Python API at its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module 'wildgs' has no attribute {name!r}")
    return getattr(importlib.import_module(f"wildgs.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
