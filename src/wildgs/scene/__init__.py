"""Photos, cameras and sparse points: from a folder to a `Scene`."""

# First of all the libraries that load the system's zlib: pycolmap exports a zlib of its own, and one that is
# loaded after it would mix its functions with pycolmap's and corrupt the memory when a PNG is written.
import zlib  # noqa: F401

import PIL.Image  # noqa: F401

from wildgs.scene.loading import DataConfig, load_scene
from wildgs.scene.scene import Alignment, Scene, Split, View, find_view, match_view, scene_extent

__all__ = [
    "Alignment",
    "DataConfig",
    "Scene",
    "Split",
    "View",
    "find_view",
    "load_scene",
    "match_view",
    "scene_extent",
]
