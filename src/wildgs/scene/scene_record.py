"""A scene without its photos, stored in a run and compared with the scene folder later."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from wildgs.errors import UserError
from wildgs.files import check_regular, written_aside
from wildgs.geometry.camera import Camera
from wildgs.scene.colmap_records import MAX_CAMERA_SIDE
from wildgs.scene.photo_store import PhotoStore
from wildgs.scene.scene import Alignment, Scene, View, observations_of

FORMAT = "wildgs-scene-1"

SAME_POSE = 1e-3
"""Tolerance for comparing poses (entries of rotation matrices) and positions (units of the aligned frame)."""

SAME_INTRINSICS = 0.01
"""Tolerance for comparing K, in pixels."""

MAX_CAMERA_PIXELS = 10**9

_FIELDS = ("viewmats", "K", "sizes", "is_test", "points", "point_colors", "observations")


@dataclass(frozen=True)
class SceneRecord:
    """Cameras, split, points and alignment of a scene.

    Attributes:
        names: Names of the photos.
        viewmats: World-to-camera transforms, in the aligned frame.
        K: Intrinsics at the size used in training, pixels.
        sizes: Width and height.
        is_test: 1 for held-out photos.
        points: Sparse points in the aligned frame.
        point_colors: Colours of the points.
        observations: Index of the photo and index of the point of each observation.
        alignment: Transform from the COLMAP model's frame to the aligned frame.
        contents: Digests of the files of each photo (`PhotoStore.fingerprint`); empty in records of earlier
            versions.
        carried: Digests of the files in the run's `lights/` by name; empty in records of earlier versions.
    """

    names: tuple[str, ...]
    viewmats: Float[Tensor, "V 4 4"]
    K: Float[Tensor, "V 3 3"]
    sizes: Int[Tensor, "V 2"]
    is_test: UInt8[Tensor, " V"]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]
    observations: Int[Tensor, "T 2"]
    alignment: Alignment
    contents: tuple[dict[str, str], ...] = ()
    carried: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene) -> SceneRecord:
        """The record of a scene."""
        cameras = [view.camera for view in scene.views]
        return cls(
            names=tuple(view.name for view in scene.views),
            viewmats=torch.stack([camera.viewmat.float().cpu() for camera in cameras]),
            K=torch.stack([camera.K.float().cpu() for camera in cameras]),
            sizes=torch.tensor([[camera.width, camera.height] for camera in cameras], dtype=torch.int32),
            is_test=torch.tensor([view.split == "test" for view in scene.views], dtype=torch.uint8),
            points=scene.points,
            point_colors=scene.point_colors,
            observations=scene.observations,
            alignment=scene.alignment,
            contents=tuple(view.photos.fingerprint(view.name) for view in scene.views),
        )

    def write(self, file: Path) -> None:
        """Writes the record atomically.

        Raises:
            UserError: The file cannot be written.
        """
        tensors = {name: getattr(self, name).contiguous() for name in _FIELDS}
        header = {"format": FORMAT, "names": self.names, "alignment": self.alignment.to_dict()}
        header |= {"contents": self.contents, "carried": self.carried}
        with written_aside(file, flush=True) as aside:
            try:
                save_file(tensors, aside, metadata={"wildgs": json.dumps(header)})
            except SafetensorError as error:  # raised on a full disk
                raise OSError(error) from error

    @classmethod
    def read(cls, file: Path) -> SceneRecord:
        """Reads a record.

        Raises:
            UserError: The file cannot be read, or is not a record.
        """
        try:
            check_regular(file)
            with safe_open(file, framework="pt") as opened:
                header = json.loads((opened.metadata() or {})["wildgs"])
                tensors = {name: opened.get_tensor(name).clone() for name in _FIELDS}
            if header["format"] != FORMAT:
                raise ValueError(
                    f"it was written by another version of Wild-GS, in the format {header['format']!r:.40}"
                )
            record = cls(
                names=tuple(str(name) for name in header["names"]),
                alignment=Alignment.from_dict(header["alignment"]),
                contents=tuple(dict(entry) for entry in header.get("contents", ())),
                carried={str(name): str(digest) for name, digest in header.get("carried", {}).items()},
                **tensors,
            )
            record._check()
        except (
            OSError, SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError
        ) as error:  # fmt: skip
            raise UserError(
                f"{file}: cannot be read as the scene of a run ({error}); copy the complete run folder again"
            ) from error
        return record

    def _check(self) -> None:
        """Raises `ValueError` if tensors are inconsistent."""
        views, points = len(self.names), len(self.points)
        if len(self.contents) not in (0, views):
            raise ValueError("the number of fingerprints is wrong")
        shapes: Mapping[str, Sequence[int]] = {
            "viewmats": (views, 4, 4),
            "K": (views, 3, 3),
            "sizes": (views, 2),
            "is_test": (views,),
            "points": (points, 3),
            "point_colors": (points, 3),
            "observations": (len(self.observations), 2),
        }
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != tuple(shape):
                raise ValueError(f"{name} has a wrong shape")
        if views == 0 or len(set(self.names)) != views:
            raise ValueError("it has no photos, or one of them twice")
        limits = torch.tensor([views, points])
        if bool(((self.observations < 0) | (self.observations >= limits)).any()):
            raise ValueError("an observation has an invalid index")
        if not all(bool(getattr(self, name).isfinite().all()) for name in ("viewmats", "K", "points")):
            raise ValueError("a camera or point is non-finite")
        turn, shift = self.alignment.rotation, self.alignment.translation
        if (
            not bool(turn.isfinite().all() and shift.isfinite().all())
            or not 0 < self.alignment.scale < math.inf
        ):
            raise ValueError("its alignment is invalid")
        if bool((self.sizes < 1).any()) or bool((self.K[:, [0, 1], [0, 1]] <= 0).any()):
            raise ValueError("a camera has an invalid size or focal length")
        if bool((self.sizes.long().prod(dim=1) > MAX_CAMERA_PIXELS).any()):
            raise ValueError("a camera has too many pixels")
        if bool((self.sizes > MAX_CAMERA_SIDE).any()):  # its photo would be enlarged to this size
            raise ValueError(f"a camera is over {MAX_CAMERA_SIDE:,} pixels wide or high")

    def camera(self, number: int) -> Camera:
        """The camera of a photo."""
        width, height = self.sizes[number].tolist()
        return Camera(self.viewmats[number].clone(), self.K[number].clone(), width, height)

    def scene(self, root: Path, photos: PhotoStore) -> Scene:
        """The scene, with photos from a store."""
        views = tuple(
            View(name, self.camera(number), "test" if self.is_test[number] else "train", photos)
            for number, name in enumerate(self.names)
        )
        return Scene(root, views, self.points, self.point_colors, self.alignment, self.observations)

    def adopt(self, found: Scene) -> tuple[Scene, list[str]]:
        """Combines the recorded scene with the photos of a scene folder, and describes the differences.

        Poses, split, points and alignment are those of the record; intrinsics are those of the scene folder.
        """
        now = {view.name: view for view in found.views}
        recorded = self.scene(found.root, found.views[0].photos)
        kept = [view for view in recorded.views if view.name in now]
        differences = _describe("missing", [name for name in self.names if name not in now])
        differences += _describe("new (not used)", [name for name in now if name not in set(self.names)])
        aligned = {view.name: self._aligned(now[view.name].camera, found.alignment) for view in kept}
        moved = [view.name for view in kept if not _same_pose(view.camera, aligned[view.name])]
        differences += _describe("with another pose (the run's is used)", moved)
        changed = [view.name for view in kept if not _same_intrinsics(view.camera, now[view.name].camera)]
        differences += _describe("with another size or focal length", changed)
        resplit = [view.name for view in kept if view.split != now[view.name].split]
        differences += _describe("in another split (the run's is used)", resplit)
        differences += self._other_files(now)
        if not self._same_points(found):
            differences.append("other sparse points (the run's are used)")
        views = tuple(
            replace(view, camera=_with_intrinsics(view.camera, now[view.name].camera))
            if view.name in changed
            else view
            for view in kept
        )
        observations = observations_of(self.observations, self.names, views)
        return replace(recorded, views=views, observations=observations), differences

    def is_of(self, found: Scene) -> bool:
        """Whether a scene is the recorded one, possibly with some photos added or removed."""
        now = {view.name: view for view in found.views}
        common = [number for number, name in enumerate(self.names) if name in now]
        if 2 * len(common) <= len(self.names):
            return False
        same = sum(
            _same_pose(self.camera(number), self._aligned(now[self.names[number]].camera, found.alignment))
            for number in common
        )
        return 2 * same > len(common)

    def _aligned(self, camera: Camera, alignment: Alignment) -> Camera:
        """Transforms a camera from another alignment to this one."""
        if alignment.to_dict() == self.alignment.to_dict():
            return camera
        double = replace(camera, viewmat=camera.viewmat.double())
        return self.alignment.apply_camera(alignment.inverse().apply_camera(double))

    def _other_files(self, now: Mapping[str, View]) -> list[str]:
        """Describes differences of the photos' files; files that cannot be read are ignored."""
        found: dict[str, list[str]] = {}
        for name, then in zip(self.names, self.contents, strict=False):
            files = now[name].photos.fingerprint(name) if name in now and then else then
            for what in ("content", "mask", "depth prior", "metric depth"):
                if files.get(what) != then.get(what):
                    found.setdefault(what, []).append(name)
        return [line for what, names in found.items() for line in _describe(f"with another {what}", names)]

    def _same_points(self, found: Scene) -> bool:
        if found.points.shape != self.points.shape:
            return False
        points = found.points.double()
        if found.alignment.to_dict() != self.alignment.to_dict():
            points = self.alignment.apply_points(found.alignment.inverse().apply_points(points))
        return bool(((points - self.points).abs() <= SAME_POSE * (1 + self.points.abs())).all())


def _same_pose(one: Camera, other: Camera) -> bool:
    reach = SAME_POSE * (1 + float(one.viewmat[:3, 3].abs().max()))
    return bool((one.viewmat.double() - other.viewmat.double()).abs().max() <= reach)


def _same_intrinsics(one: Camera, other: Camera) -> bool:
    if (one.width, one.height) != (other.width, other.height):
        return False
    return bool((one.K.double() - other.K.double()).abs().max() <= SAME_INTRINSICS)


def _with_intrinsics(pose: Camera, intrinsics: Camera) -> Camera:
    return replace(pose, K=intrinsics.K, width=intrinsics.width, height=intrinsics.height)


def _describe(how: str, names: Sequence[str]) -> list[str]:
    """Describes photos with one kind of difference, naming the first few."""
    if not names:
        return []
    shown = ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
    return [f"{len(names)} photo{'s' if len(names) > 1 else ''} {how}: {shown}"]
