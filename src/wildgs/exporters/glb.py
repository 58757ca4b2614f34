"""GLB files with the ratified glTF extension KHR_gaussian_splatting: one geometry, one scene for each light.

All scenes share the accessors of positions, rotations, scales and opacities. Harmonics of degree 0 are separate for
each light. Higher degrees have one accessor for all lights, in which each light replaces some rows (sparse
accessors). KHR_materials_variants does not apply, since it exchanges materials, which splats do not have.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from wildgs.errors import UserError
from wildgs.exporters.lights import RelightableScene, SharedHarmonics, thumbnail_url
from wildgs.files import printable
from wildgs.geometry.camera import Camera
from wildgs.version import __version__

EXTENSION = "KHR_gaussian_splatting"

_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_VERTICES = 34962
_SIZES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MOST_BYTES = 2**32 - 1


@dataclass
class _Document:
    """A glTF document under construction."""

    chunks: list[bytes] = field(default_factory=list)
    length: int = 0
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add_view(self, values: np.ndarray, *, vertices: bool = True) -> int:
        """Stores an array; returns the index of its buffer view."""
        content = np.ascontiguousarray(values).tobytes()
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": len(content)}
        if vertices:
            view |= {"target": _VERTICES, "byteStride": values.itemsize * values.shape[1]}
        self.views.append(view)
        content += b"\0" * (-len(content) % 4)
        self.chunks.append(content)
        self.length += len(content)
        return len(self.views) - 1

    def add(self, values: np.ndarray, **more: Any) -> int:
        """Stores an attribute of all Gaussians (rows); returns the index of its accessor."""
        return self.add_accessor(self.add_view(values), values, **more)

    def add_accessor(self, view: int, values: np.ndarray, **more: Any) -> int:
        """Adds an accessor for a stored array; returns its index."""
        kind = _FLOAT if values.dtype == np.float32 else _BYTE
        accessor = {"bufferView": view, "componentType": kind, "count": len(values)}
        self.accessors.append(accessor | {"type": _SIZES[values.shape[1]]} | more)
        return len(self.accessors) - 1


def glb_bytes(scene: RelightableScene, harmonics: SharedHarmonics) -> bytes:
    """Content of a GLB file.

    Args:
        scene: Geometry and metadata of the lights; the harmonics of `scene.lights` are ignored.
        harmonics: The harmonics of the lights.

    Raises:
        UserError: The file would be larger than 4 GiB, the limit of GLB.
    """
    document = _Document()
    geometry = _add_geometry(document, scene)
    rest = [values.float().numpy() for values in harmonics.rest.unbind(dim=1)]
    views = [] if harmonics.all_own else [document.add_view(values) for values in rest]
    meshes, nodes, scenes = [], [], []
    for number, light in enumerate(scene.lights):
        colors = _add_base(document, harmonics, number, scene)
        colors |= _add_rest(document, harmonics, number, rest, views)
        extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        primitive = {"attributes": geometry | colors, "mode": 0, "extensions": {EXTENSION: extension}}
        name = printable(light.name)
        meshes.append({"name": name, "primitives": [primitive]})
        nodes += [{"name": name, "mesh": number}, _camera_node(scene.start.centered())]
        extras = {
            "photo": name,
            "captured": light.captured,
            "thumbnail": thumbnail_url(light.thumbnail),
        }
        extras = {key: value for key, value in extras.items() if value is not None}
        scenes.append({"name": name, "nodes": [2 * number, 2 * number + 1], "extras": extras})
    content = {
        "asset": {
            "version": "2.0",
            "generator": f"Wild-GS {__version__}",
            "extras": {"title": printable(scene.title), "to_colmap": scene.placement.to_dict()},
        },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": scenes,
        "nodes": nodes,
        "cameras": [_camera(scene)],
        "meshes": meshes,
        "accessors": document.accessors,
        "bufferViews": document.views,
        "buffers": [{"byteLength": document.length}],
    }
    return _container(json.dumps(content, separators=(",", ":")).encode(), document)


def _add_geometry(document: _Document, scene: RelightableScene) -> dict[str, int]:
    splats = scene.splats
    means = splats.means.float().numpy()
    quats = torch.nn.functional.normalize(splats.quats, dim=1).roll(-1, dims=1)  # to x, y, z, w
    ends = {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    return {
        "POSITION": document.add(means, **ends),
        f"{EXTENSION}:ROTATION": document.add(quats.float().numpy()),
        f"{EXTENSION}:SCALE": document.add(splats.scales.float().numpy()),
        f"{EXTENSION}:OPACITY": document.add(splats.opacities.float().clamp(0, 1)[:, None].numpy()),
    }


def _add_base(
    document: _Document, harmonics: SharedHarmonics, light: int, scene: RelightableScene
) -> dict[str, int]:
    """Degree 0 of one light, and linear point colours for programs without support for the extension."""
    base = harmonics.base[light].float()
    shown = (0.5 + 0.28209479177387814 * base).clamp(0, 1)
    linear = torch.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    points = torch.cat([linear, scene.splats.opacities.float().clamp(0, 1)[:, None]], dim=1)
    return {
        "COLOR_0": document.add((points * 255).round().byte().numpy(), normalized=True),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": document.add(base.numpy()),
    }


def _add_rest(
    document: _Document, harmonics: SharedHarmonics, light: int, rest: list[np.ndarray], views: list[int]
) -> dict[str, int]:
    """The higher degrees of one light: the shared ones with some rows replaced."""
    rows, own = harmonics.rows[light], harmonics.own[light].float()
    names = [
        f"{EXTENSION}:SH_DEGREE_{math.isqrt(basis)}_COEF_{basis - math.isqrt(basis) ** 2}"
        for basis in range(1, len(rest) + 1)
    ]
    if harmonics.all_own:
        return {name: document.add(own[:, index].numpy()) for index, name in enumerate(names)}
    if not len(rows):
        stored = zip(names, views, rest, strict=True)
        return {name: document.add_accessor(view, values) for name, view, values in stored}
    indices = document.add_view(rows.numpy().astype(np.uint32), vertices=False)
    found = {}
    for index, name in enumerate(names):
        replaced = document.add_view(own[:, index].numpy(), vertices=False)
        sparse = {
            "count": len(rows),
            "indices": {"bufferView": indices, "componentType": _INDEX},
            "values": {"bufferView": replaced},
        }
        found[name] = document.add_accessor(views[index], rest[index], sparse=sparse)
    return found


def _camera(scene: RelightableScene) -> dict[str, Any]:
    camera = scene.start.centered()
    lens = {
        "yfov": float(2 * torch.atan(0.5 * camera.height / camera.K[1, 1])),
        "aspectRatio": float(camera.width / camera.height * camera.K[1, 1] / camera.K[0, 0]),
        "znear": scene.near,
    }
    return {"name": "start", "type": "perspective", "perspective": lens}


def _camera_node(camera: Camera) -> dict[str, Any]:
    """Node of the camera, which looks along -z with +y up in glTF."""
    axes = camera.viewmat[:3, :3].double().T @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    )
    rotation = Rotation.from_matrix(axes.numpy()).as_quat()
    return {
        "name": "start",
        "camera": 0,
        "rotation": rotation.tolist(),
        "translation": camera.position.double().tolist(),
    }


def _container(text: bytes, document: _Document) -> bytes:
    """The GLB container: header, JSON chunk padded with spaces, binary chunk."""
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + document.length
    if total > _MOST_BYTES:
        raise UserError("a .glb file is limited to 4 GiB; give fewer lights, or a lower --sh-degree")

    def words(*values: int) -> bytes:
        return np.array(values, dtype="<u4").tobytes()

    header = words(0x46546C67, 2, total) + words(len(text), 0x4E4F534A)
    return b"".join([header, text, words(document.length, 0x004E4942), *document.chunks])
