"""The web page of a run: what `wildgs export --format html`, `run` and `demo` write."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from wildgs.evaluation.photos import find_misfits, read_photos
from wildgs.exporters.cleanup import CleanupConfig, kept_rows
from wildgs.exporters.page import Page, PageLight, PageView, choose_start, write_page
from wildgs.exporters.splats import Splats
from wildgs.library.loaded import LoadedScene
from wildgs.library.looks import find_looks
from wildgs.library.showcase import different_lights, without
from wildgs.light.look import NEUTRAL, Look
from wildgs.model.gaussians import NEAR
from wildgs.progress import Progress
from wildgs.runs import Run
from wildgs.scene import View, match_view

PAGE_LIGHTS = 4


@dataclass(frozen=True)
class WrittenPage:
    """What came of it.

    Attributes:
        file: The page.
        megabytes: Its size.
        sh_degree: Degree of the spherical harmonics that it carries.
        num_gaussians: Gaussians that it carries.
    """

    file: Path
    megabytes: float
    sh_degree: int
    num_gaussians: int


@torch.no_grad()
def write_webpage(
    loaded: LoadedScene,
    looks: Sequence[Look],
    file: Path,
    *,
    title: str,
    cleanup: CleanupConfig | None = None,
) -> WrittenPage:
    """Writes the page of a run under some looks.

    Args:
        loaded: The run.
        looks: From left to right; the page opens under the first.
        file: The HTML file.
        title: Its headline.
        cleanup: What to leave out.

    Raises:
        ValueError: Nothing is left to show.
    """
    cleanup = cleanup or CleanupConfig()
    scene = loaded.scene
    views = scene.train_views or scene.views
    number, depth = choose_start([view.camera for view in views], scene.points)
    splats = baked(loaded, looks[0])
    keep = kept_rows(cleanup, splats, scene.points)
    lights = [
        PageLight(look.name, look.sh.cpu().detach()[keep], _thumbnail(loaded, look, views[number]))
        for look in looks
    ]
    page = Page(
        title=title,
        summary=f"{int(keep.sum()):,} Gaussians from {len(scene.views)} photos, by Wild-GS.",
        splats=splats.select(keep),
        lights=lights,
        start=PageView(views[number].camera, depth),
        near=NEAR,
    )
    degree = write_page(page, file, viewpoints=viewpoints_of(scene.views), sh_degree=cleanup.sh_degree)
    return WrittenPage(file, file.stat().st_size / 1e6, degree, len(page.splats))


def write_scene_page(run: Run, file: Path, title: str, progress: Progress | None = None) -> WrittenPage:
    """Writes the page of a run under lights chosen for it; ends `wildgs run` and `wildgs demo`."""
    loaded = LoadedScene(run)
    return write_webpage(loaded, page_looks(loaded, progress), file, title=title)


def page_looks(loaded: LoadedScene, progress: Progress | None = None) -> list[Look]:
    """The light of a few photos as unlike each other as the scene has them; the one look of plain 3DGS."""
    if not loaded.relightable:
        return [loaded.appearance(NEUTRAL)]
    views = loaded.scene.train_views or loaded.views
    misfits = find_misfits(read_photos(loaded.run.folder, loaded.run.step) or [])
    chosen = different_lights(without(views, misfits), PAGE_LIGHTS)
    return find_looks(loaded, [view.name for view in chosen], progress=progress)


def baked(loaded: LoadedScene, look: Look) -> Splats:
    """The run's Gaussians under a look, in main memory, in the scene's aligned frame."""
    gaussians = loaded.gaussians
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, look.sh)
    return Splats(*(value.detach().cpu().float() for value in values))


def viewpoints_of(views: Sequence[View]) -> torch.Tensor:
    """Camera centres, evenly chosen where there are many."""
    chosen = views[:: max(1, -(-len(views) // 64))]
    return torch.stack([view.camera.position for view in chosen]) if chosen else torch.zeros(0, 3)


def _thumbnail(loaded: LoadedScene, look: Look, start: View) -> np.ndarray:
    """The photo whose light it is; where it is none of the scene's, the first view under that light."""
    view = match_view(loaded.views, look.name)
    pixels = loaded.render(start.camera, look) if view is None else view.read_photo()
    return pixels.numpy()
