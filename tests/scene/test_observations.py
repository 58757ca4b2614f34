"""Pixels that are static by proof."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
import torch

from wildgs.scene import DataConfig, load_scene
from wildgs.scene.scene import observed_pixels


@pytest.mark.shared
def test_observed_pixels_are_colmaps(shared):
    """Against COLMAP's own observations: points reproject to within a pixel of the features that made them."""
    root = shared / "data" / "longchamp"
    scene = load_scene(root, DataConfig(downscale=1.5), lazy=True)
    found = observed_pixels(scene)
    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    images = {image.name: image for image in model.images.values()}
    assert set(found) <= {view.name for view in scene.train_views}
    for view in scene.train_views[:3]:
        image = images[view.name]
        observed = {p.point3D_id for p in image.points2D if p.has_point3D()}
        long = {i for i in observed if len({e.image_id for e in model.points3D[i].track.elements}) >= 3}
        assert 0.9 * len(long) <= len(found[view.name]) <= len(long)
        features = np.array([p.xy for p in image.points2D if p.has_point3D() and p.point3D_id in long])
        scale = view.camera.width / model.cameras[image.camera_id].width
        nearest = torch.cdist(found[view.name], torch.from_numpy(features * scale).float()).min(dim=1).values
        assert float(nearest.quantile(0.9)) < 1.5


def test_a_scene_without_observations_proves_nothing(landmark):
    from dataclasses import replace

    scene = load_scene(landmark, lazy=True)
    assert observed_pixels(replace(scene, observations=scene.observations[:0])) == {}
    assert all(len(pixels) for pixels in observed_pixels(scene, least_photos=1).values())
