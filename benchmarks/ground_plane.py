"""Which plane is taken for the ground of a scene?

    python benchmarks/ground_plane.py ../shared/data/gate --true-height 0
    wildgs depth gate20 --by stereo && python benchmarks/ground_plane.py gate20

By the points of structure from motion alone, and by depth maps as well: the plane z = a x + b y + c in the aligned
frame (median depth = 1), the height of the training photos' cameras above it (median and lowest tenth), and how
clear it is (`wildgs.priors.ground_plane`). `--true-height`: height (z) of the true ground in the scene's own frame,
which has to be horizontal there; errors of the plane below the cameras follow, in units of that frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from wildgs.priors.config import DepthPointsConfig
from wildgs.priors.depth_points import depth_points
from wildgs.priors.ground_plane import clearness, find_ground, height_at, heights_above
from wildgs.scene import DataConfig, Scene, load_scene


@dataclass(frozen=True)
class Command:
    """Prints the ground planes of a scene."""

    scene: tyro.conf.Positional[Path]
    """Scene folder."""
    true_height: float | None = None
    """Height of the true ground in the scene's own frame."""


def errors(
    scene: Scene, plane: Float[Tensor, "3"], feet: Float[Tensor, "V 2"], truth: float
) -> Float[Tensor, " V"]:
    """Height of the plane above the true ground at horizontal positions, in the scene's own frame."""
    places = torch.cat([feet, height_at(plane, feet)[:, None]], dim=1).double()
    alignment = scene.alignment
    own = (places - alignment.translation.double()) / alignment.scale @ alignment.rotation.double()
    return own[:, 2] - truth


def main(command: Command) -> None:
    """Prints a line for each kind of points."""
    scene = load_scene(command.scene, DataConfig())
    centers = torch.stack([view.camera.position for view in scene.train_views])
    surface = torch.cat([scene.points, depth_points(scene, DepthPointsConfig())[0]])
    for name, points in (("structure from motion", scene.points), ("and depth maps", surface)):
        plane, clear = find_ground(points, centers), clearness(points, centers)
        if plane is None:
            print(f"{name}: no ground (the clearest layer has {clear:.1f})")
            continue
        above = heights_above(plane, centers)
        line = (
            f"{name}: z = {plane[0]:.4f} x {plane[1]:+.4f} y {plane[2]:+.4f}, clear by {clear:.1f}, cameras"
        )
        line += f" {above.median():.4f} above it ({above.quantile(0.1):.4f})"
        if command.true_height is not None:
            wrong = errors(scene, plane, centers[:, :2], command.true_height)
            line += f"; error {wrong.square().mean().sqrt():.3f} (mean {wrong.mean():.3f})"
        print(line)


if __name__ == "__main__":
    main(tyro.cli(Command))
