"""Scenes: photos, cameras and sparse points, read from a folder."""

from __future__ import annotations

import importlib

# The system's zlib must be loaded before pycolmap, which exports its own zlib symbols; mixing the two corrupts
# memory when a PNG is written.
import zlib  # noqa: F401
from typing import TYPE_CHECKING, Any

import PIL.Image  # noqa: F401

if TYPE_CHECKING:
    from wildgs.scene.config import DataConfig as DataConfig
    from wildgs.scene.loading import load_scene as load_scene
    from wildgs.scene.scene import Alignment as Alignment
    from wildgs.scene.scene import Scene as Scene
    from wildgs.scene.scene import Split as Split
    from wildgs.scene.scene import View as View
    from wildgs.scene.scene import find_view as find_view
    from wildgs.scene.scene import match_view as match_view
    from wildgs.scene.scene import scene_extent as scene_extent

_MODULES = {"DataConfig": "wildgs.scene.config", "load_scene": "wildgs.scene.loading"} | dict.fromkeys(
    ("Alignment", "Scene", "Split", "View", "find_view", "match_view", "scene_extent"), "wildgs.scene.scene"
)


def __getattr__(name: str) -> Any:
    """Imports names at their first use, so that `wildgs.scene.config` does not import torch."""
    if name not in _MODULES:
        raise AttributeError(f"module 'wildgs.scene' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
