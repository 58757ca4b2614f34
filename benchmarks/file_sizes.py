"""How large are files with several lights, and the web page?

    python benchmarks/file_sizes.py runs/gate [--gaussians 100000] [--page-gaussians 200000]

The Gaussians of a run are repeated, with random offsets so that they do not compress as copies, up to a given
number. They are written as .glb with 1, 4 and 8 lights, and as a page with six lights and the day.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

import wildgs
from wildgs.exporters.glb import glb_bytes
from wildgs.exporters.lights import ExportLight, RelightableScene, share_harmonics, upright
from wildgs.exporters.page import Page, PageLight, PageView, write_page
from wildgs.exporters.splats import CleanupConfig, Splats
from wildgs.library.loaded import LoadedScene, find_looks
from wildgs.library.pages import baked, viewpoints_of
from wildgs.model.gaussians import NEAR
from wildgs.scene.start import choose_start

LIGHTS = (1, 4, 8)
PAGE_LIGHTS = 6


@dataclass(frozen=True)
class Command:
    """Measures sizes of files."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    gaussians: int = 100_000
    """Number of Gaussians in the .glb files."""
    page_gaussians: int = 200_000
    """Number of Gaussians in the page."""


def repeat(values: Tensor, count: int, offset: float = 0.0) -> Tensor:
    """Repeats rows up to a count; the copies have random offsets."""
    rows = torch.arange(count)
    repeated = values[rows % len(values)]
    noise = torch.randn(repeated.shape, generator=torch.Generator().manual_seed(0))
    return repeated + offset * noise * (rows >= len(values)).view(-1, *[1] * (values.ndim - 1))


def repeat_splats(splats: Splats, count: int) -> Splats:
    """Splats up to a count."""
    spread = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    return Splats(
        repeat(splats.means, count, 0.01),
        repeat(splats.quats, count, 0.02),
        repeat(splats.scales, count) * (0.8 + 0.4 * spread),
        repeat(splats.opacities, count),
        repeat(splats.sh, count, 0.02),
    )


def print_glb(loaded: LoadedScene, lights: list[Splats], names: list[str], count: int) -> None:
    motion = upright(loaded.run.alignment, aligned=False)
    start = choose_start(loaded.scene)[0]
    splats = repeat_splats(lights[0], count)
    shs = [splats.with_sh(repeat(each.sh, count, 0.02)).moved(motion).sh for each in lights]
    moved, viewpoints, single = (
        splats.moved(motion),
        motion.apply_points(viewpoints_of(loaded.scene.train_views)),
        0,
    )
    for number in LIGHTS:
        harmonics = share_harmonics(moved, shs[:number], viewpoints, CleanupConfig().own_harmonics)
        shown = [
            ExportLight(name, sh, start.read_photo().numpy())
            for name, sh in zip(names[:number], shs, strict=False)
        ]
        scene = RelightableScene(
            "", moved, shown, motion.apply_camera(start.camera), NEAR * motion.scale, motion
        )
        size = len(glb_bytes(scene, harmonics))
        single = single or size
        print(f"glb, {count:,} Gaussians of degree {moved.sh_degree}, {number} lights: ", end="")
        print(f"{size / 1e6:.1f} MB, {size / single:.2f} times one light's")


def print_page(loaded: LoadedScene, lights: list[Splats], names: list[str], count: int) -> None:
    start, depth = choose_start(loaded.scene)
    photo = start.read_photo().numpy()
    shown = [
        PageLight(name, repeat(each.sh, count, 0.02), photo)
        for name, each in zip(names[:PAGE_LIGHTS], lights, strict=False)
    ]
    page = Page(
        title="sizes", summary="", splats=repeat_splats(lights[0], count), lights=shown,
        start=PageView(start.camera, depth), near=NEAR, day=True,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "page.html")
        degree = write_page(page, file, viewpoints=viewpoints_of(loaded.views), sh_degree=None)
        size = file.stat().st_size / 1e6
    print(f"page, {count:,} Gaussians of degree {degree}, {len(shown)} lights: {size:.1f} MB")


def main(command: Command) -> None:
    torch.set_grad_enabled(False)
    loaded = wildgs.load(command.run, device="cpu")
    views, most = loaded.scene.train_views, max(LIGHTS)
    names = [views[index * (len(views) - 1) // (most - 1)].name for index in range(most)]
    lights = [baked(loaded, look) for look in find_looks(loaded, names)]
    print_glb(loaded, lights, names, command.gaussians)
    print_page(loaded, lights, names, command.page_gaussians)


if __name__ == "__main__":
    main(tyro.cli(Command))
