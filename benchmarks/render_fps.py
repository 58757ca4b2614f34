"""Does a relit scene render as fast as plain 3D Gaussian Splatting?

    python benchmarks/render_fps.py runs/gate

Frames of the same Gaussians from the same cameras, in turn: with a cached look, as `wildgs.load(RUN).render`
draws them; and as a plain 3DGS renderer would, from stored means, quaternions, scales, opacities and harmonics.
Both end in 8 bits. The ratio is that of the median frame times; its goal is at least 0.95. Beside it: what a new
light costs.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
import tyro

import wildgs
from wildgs.evaluation.metrics import to_8bit
from wildgs.geometry.camera import Camera
from wildgs.light.look import Look
from wildgs.light.photos import encode_view
from wildgs.model.gaussians import NEAR
from wildgs.rasterize import rasterize

WARM_UP = 3


@dataclass(frozen=True)
class Command:
    """Compares the frame rates of a relit and a plain scene."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    frames: int = 60
    """Frames of each kind."""
    json: bool = False
    """Print JSON instead of lines."""


def seconds_of(work: Callable[[], object]) -> float:
    """Time of one call, the GPU's part included."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def plain_renderer(look: Look) -> Callable[[Camera], torch.Tensor]:
    """A renderer of stored Gaussians that knows nothing of appearance."""
    gaussians, degree = look.method.gaussians, look.method.sh_degree
    stored = [
        value.detach().clone()
        for value in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, look.sh)
    ]

    @torch.no_grad()
    def render(camera: Camera) -> torch.Tensor:
        camera = camera.to(stored[0].device)
        return to_8bit(rasterize(*stored, camera, sh_degree=degree, near=NEAR, depth=False).colors).cpu()

    return render


def measure(command: Command) -> dict[str, float]:
    scene = wildgs.load(command.run)
    views = list(scene.scene.test_views or scene.views)
    look, other = (scene.appearance(view.name) for view in (scene.views * 2)[:2])
    plain = plain_renderer(look)
    cameras = [view.camera for view in views]
    for camera in cameras[:WARM_UP]:
        assert torch.equal(scene.render(camera, look), plain(camera)), (
            "the two renderers draw different pictures"
        )
    cached_seconds, plain_seconds = [], []
    for number in range(command.frames):
        camera = cameras[number % len(cameras)]
        both = [
            (cached_seconds, lambda camera=camera: scene.render(camera, look)),
            (plain_seconds, lambda camera=camera: plain(camera)),
        ]
        for record, work in both if number % 2 else both[::-1]:  # neither always comes first
            record.append(seconds_of(work))
    encode = [seconds_of(lambda view=view: encode_view(scene.run.method, view)) for view in views[:5]]
    shade = [
        seconds_of(lambda share=share: wildgs.mix([look, other], [share, 1 - share]).sh)
        for share in (0.2, 0.4, 0.6)
    ]
    return {
        "gaussians": len(scene.gaussians),
        "frames": command.frames,
        "cached_fps": 1 / median(cached_seconds),
        "plain_fps": 1 / median(plain_seconds),
        "ratio": median(plain_seconds) / median(cached_seconds),
        "encode_ms": 1000 * median(encode),
        "mix_ms": 1000 * median(shade),
    }


def main(command: Command) -> None:
    figures = measure(command)
    if command.json:
        print(json.dumps(figures, indent=2))
        return
    print(f"{figures['gaussians']:,} Gaussians, {command.frames} frames of each kind, in turn")
    print(f"cached look {figures['cached_fps']:.1f} frames/s, plain 3DGS {figures['plain_fps']:.1f} frames/s")
    print(f"ratio {figures['ratio']:.3f} (goal: at least 0.95)")
    print(f"a new photo's light: {figures['encode_ms']:.0f} ms; a new mix: {figures['mix_ms']:.0f} ms")


if __name__ == "__main__":
    main(tyro.cli(Command))
