"""The rasteriser benchmark's scene, and one timed run of it.

As a program it is the worker of `rasterize.py --against`: it prints `ready`, and for each line on stdin the
milliseconds of a forward and a backward pass. It uses nothing but the public functions `project` and `blend`: it
runs with the package of an earlier commit, too.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize import blend, project


def make_scene(n: int, width: int, height: int, seed: int = 0) -> tuple[list[Tensor], Camera]:
    """Means, quaternions, scales, opacities and colours, and the camera."""
    g = torch.Generator().manual_seed(seed)
    focal = 0.9 * width
    depth = torch.where(torch.arange(n) % 2 == 0, 4.0, 2 + 4 * torch.rand(n, generator=g))
    x = (torch.rand(n, generator=g) - 0.5) * width / focal * depth
    y = (torch.rand(n, generator=g) - 0.5) * height / focal * depth
    scales = torch.exp(math.log(0.01) + 0.5 * torch.randn(n, 3, generator=g))
    quats = torch.randn(n, 4, generator=g)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    inputs = [
        torch.stack([x, y, depth], 1),
        quats,
        scales,
        torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g),
    ]
    return inputs, Camera(torch.eye(4), K, width, height)


def timed(call: Callable[[], object]) -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    start = time.perf_counter()
    call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def time_once(leaves: list[Tensor], camera: Camera, backend: str) -> tuple[float, float, object]:
    """Milliseconds of a forward and a backward pass, and the projection."""
    found = []

    def forward() -> None:
        projection = project(*leaves[:4], camera, backend=backend)  # type: ignore[arg-type]
        rendering = blend(projection, leaves[4])
        found[:] = [projection, rendering.colors, rendering.depth, rendering.alpha]

    seconds = timed(forward)
    projection, *pictures = found
    pulls = [torch.rand_like(p) for p in pictures]
    for leaf in leaves:
        leaf.grad = None
    pull_back = timed(lambda: torch.autograd.backward(pictures, pulls))
    return 1e3 * seconds, 1e3 * pull_back, projection


def main() -> None:
    n, width, height = (int(v) for v in sys.argv[1:])
    inputs, camera = make_scene(n, width, height)
    leaves = [t.requires_grad_() for t in inputs]
    for _ in range(2):
        time_once(leaves, camera, "cpu")
    print("ready", flush=True)
    for _ in sys.stdin:
        forward, backward, _ = time_once(leaves, camera, "cpu")
        print(forward, backward, flush=True)


if __name__ == "__main__":
    main()
