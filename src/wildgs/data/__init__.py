"""Photos, cameras and sparse points: from a folder to a `Scene`."""

from wildgs.data.loading import DataConfig, load_scene
from wildgs.data.scene import Alignment, Scene, Split, View, scene_extent

__all__ = ["Alignment", "DataConfig", "Scene", "Split", "View", "load_scene", "scene_extent"]
