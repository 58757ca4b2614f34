"""Depth by stereo against a reference: share of the estimates within 2% and 5%, and share of pixels with one.

    python benchmarks/stereo_accuracy.py demo
    wildgs depth SCENE --by stereo
    python benchmarks/stereo_accuracy.py SCENE

`demo` ray casts the generated landmark without its passers-by from the demo's cameras, so the reference is exact.
Of another scene, the reference is the disparity in `depth/*.png`, whose scale and shift are unknown and vary slowly
over the photo: on each photo it is fitted to stereo with 5 x 5 control values of each. Errors of stereo that vary
as slowly are therefore not seen.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from PIL import Image

import wildgs
from demo_generator.cameras import Viewpoint
from demo_generator.photos import build_place
from demo_generator.render_kernels import depth_and_kind
from demo_generator.solids import Solids
from wildgs.scene.colmap import read_model
from wildgs.scene.demo import write_demo_scene

CONTROLS = 5
"""Control values of scale and shift along each side of a photo."""
ROUNDS = 10
"""Rounds of reweighted least squares, which approach the least absolute error."""


@dataclass(frozen=True)
class Command:
    """Measures the depth maps of a scene."""

    scene: tyro.conf.Positional[str]
    """Scene with depth/*.tiff by stereo and disparity of another source in depth/*.png, or `demo`."""
    disparity: Path | None = None
    """Folder of the disparity; depth/ of the scene by default."""


def demo_pairs(root: Path) -> Iterator[tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]]:
    """Stereo and ray-cast depth of the demo's photos; 0 where there is none."""
    write_demo_scene(root)
    for file in (root / "depth").iterdir():
        file.unlink()
    wildgs.estimate_depth(root, by="stereo")
    whole, nobody = build_place().whole.arrays, Solids().build().arrays
    for image in read_model(root).images:
        file = root / "depth" / f"{Path(image.name).stem}.tiff"
        if not file.is_file():
            continue
        viewmat, camera = image.viewmat.double().numpy(), image.camera
        rotation = np.ascontiguousarray(viewmat[:3, :3].T)
        view = Viewpoint(
            -rotation @ viewmat[:3, 3], rotation, camera.focal_length_x, camera.width, camera.height
        )
        shape = (view.focal, view.center, view.width, view.height)
        yield np.asarray(Image.open(file)), depth_and_kind(whole, nobody, view.position, rotation, *shape)[0]


def scene_pairs(root: Path, disparity: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stereo and fitted disparity of all photos that have both; 0 where there is none."""
    for file in sorted((root / "depth").glob("*.tiff")):
        other = disparity / f"{file.stem}.png"
        if other.is_file():
            depth = np.asarray(Image.open(file))
            with Image.open(other) as image:
                prior = np.asarray(image.resize(depth.shape[::-1], Image.Resampling.NEAREST), dtype=float)
            yield depth, fitted(depth, prior / 65535)


def fitted(depth: Float[np.ndarray, "H W"], prior: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Depth from disparity whose scale and shift, smooth over the photo, are fitted to inverse depth; 0 without."""
    height, width = depth.shape
    controls = np.eye(CONTROLS**2, dtype=np.float32).reshape(-1, CONTROLS, CONTROLS)
    smooth = np.stack(
        [
            np.asarray(Image.fromarray(one).resize((width, height), Image.Resampling.BICUBIC))
            for one in controls
        ],
        -1,
    )
    design = np.concatenate([smooth * prior[..., None], smooth], axis=-1)
    both = (depth > 0) & (prior > 0)
    a, b = design[both], 1 / depth[both]
    weights, found = b**-2, np.zeros(a.shape[1])
    for _ in range(ROUNDS):
        scaled = a * weights[:, None]
        found = np.linalg.lstsq(scaled.T @ a, scaled.T @ b, rcond=1e-8)[0]
        relative = np.abs(a @ found - b) / b
        weights = b**-2 / np.maximum(relative, 1e-3)
    inverse = design @ found
    return np.where((prior > 0) & (inverse > 0), 1 / np.maximum(inverse, 1e-9), 0)


def main(command: Command) -> None:
    """Prints one line."""
    with tempfile.TemporaryDirectory() as folder:
        if command.scene == "demo":
            pairs = list(demo_pairs(Path(folder) / "demo"))
        else:
            scene = Path(command.scene)
            pairs = list(scene_pairs(scene, command.disparity or scene / "depth"))
    errors, complete = [], []
    for depth, reference in pairs:
        solid = reference > 0
        known = solid & (depth > 0)
        complete.append(known.sum() / max(solid.sum(), 1))
        errors.append(np.abs(depth[known] / reference[known] - 1))
    error = np.concatenate(errors)
    sky = np.mean(
        [(depth[reference == 0] > 0).mean() for depth, reference in pairs if (reference == 0).any()]
    )
    print(
        f"{len(pairs)} photos: {np.mean(error < 0.02):.1%} of the estimates within 2%, {np.mean(error < 0.05):.1%}"
        f" within 5%, median error {np.median(error):.2%}; {np.mean(complete):.1%} of the solid pixels"
        f" have an estimate, {sky:.1%} of the others"
    )


if __name__ == "__main__":
    main(tyro.cli(Command))
