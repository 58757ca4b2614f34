"""A self-contained web page with a scene under several appearances, which needs neither server nor network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.exporters.lights import thumbnail_url
from wildgs.exporters.page_scene import PackedScene, pack_scene
from wildgs.exporters.splats import Splats
from wildgs.files import printable, written_aside
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import fit_truncation, truncate_sh
from wildgs.rasterize import EPS2D

BUDGET_BYTES = 25_000_000
"""Size limit of a page; spherical harmonics are truncated to stay below it."""


@dataclass(frozen=True)
class PageLight:
    """One light of the page.

    Attributes:
        name: Caption of the thumbnail.
        sh: Spherical harmonics of all Gaussians.
        thumbnail: Image of any size; its centre is shown.
    """

    name: str
    sh: Float[Tensor, "N K 3"]
    thumbnail: UInt8[np.ndarray, "_ _ 3"]


@dataclass(frozen=True)
class PageView:
    """Initial view of the page: a camera in the aligned frame, and the depth of the centre of rotation."""

    camera: Camera
    depth: float


@dataclass(frozen=True)
class Page:
    """Content of a page.

    Attributes:
        title: Title.
        summary: Sentence in the help panel.
        splats: Geometry, in the aligned frame.
        lights: Appearances, from left to right.
        start: Initial view.
        near: Near plane, in units of the aligned frame.
        eps2d: Added to the diagonal of 2D covariances, square pixels of the page.
        antialiased: Whether opacities compensate for it.
        day: Whether the lights are in the order of a day, which the page can play.
    """

    title: str
    summary: str
    splats: Splats
    lights: Sequence[PageLight]
    start: PageView
    near: float
    eps2d: float = EPS2D
    antialiased: bool = False
    day: bool = False


def write_page(
    page: Page,
    file: Path,
    *,
    viewpoints: Float[Tensor, "V 3"] | None = None,
    sh_degree: int | None = None,
) -> int:
    """Writes a page atomically.

    Args:
        page: Content.
        file: HTML file; missing folders are created.
        viewpoints: Camera centres; truncated harmonics are fitted to the directions from them.
        sh_degree: Degree of the spherical harmonics; None takes the highest with which the page stays below
            `BUDGET_BYTES`.

    Returns:
        Degree of the spherical harmonics in the page.

    Raises:
        ValueError: The page has no light or no Gaussians.
    """
    own = page.splats.sh_degree
    content = b""
    for degree in range(own, -1, -1) if sh_degree is None else [min(sh_degree, own)]:
        content = _compose(page, _pack(page, degree, viewpoints)).encode()
        if len(content) <= BUDGET_BYTES:
            break
    with written_aside(file) as aside:
        aside.write_bytes(content)
    return degree


def _pack(page: Page, degree: int, viewpoints: Float[Tensor, "V 3"] | None) -> PackedScene:
    fit = None
    if degree < page.splats.sh_degree and viewpoints is not None and len(viewpoints):
        fit = fit_truncation(page.splats.means, viewpoints, page.splats.sh_degree, degree)
    return pack_scene(page.splats, [truncate_sh(light.sh, degree, fit).numpy() for light in page.lights])


def _compose(page: Page, scene: PackedScene) -> str:
    """The HTML text."""
    web = files("wildgs.exporters").joinpath("web")
    header = {
        **scene.header,
        "near": page.near,
        "filter": {"eps2d": page.eps2d, "antialiased": page.antialiased},
        "day": page.day,
        "start": _start(page.start),
        "lights": [
            {"name": printable(light.name), "thumbnail": thumbnail_url(light.thumbnail)}
            for light in page.lights
        ],
    }
    return Template(web.joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=escape(printable(page.title)),
        summary=escape(printable(page.summary)),
        style=web.joinpath("style.css").read_text(encoding="utf-8"),
        licenses=escape(web.joinpath("LICENSES.txt").read_text(encoding="utf-8")),
        header=script_json(header),
        scene=base64.b64encode(scene.data).decode("ascii"),
        viewer=base64.b64encode(web.joinpath("viewer.js.gz").read_bytes()).decode("ascii"),
    )


def script_json(value: Any) -> str:
    """JSON in which HTML characters are escaped, so that file names cannot close the script element."""
    return json.dumps(value).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _start(view: PageView) -> dict[str, Any]:
    camera = view.camera.centered()
    target = camera.position + view.depth * camera.forward
    return {
        "position": camera.position.tolist(),
        "target": target.tolist(),
        "fov_y": float(2 * torch.atan(0.5 * camera.height / camera.K[1, 1])),
        "aspect": float(camera.width / camera.height * camera.K[1, 1] / camera.K[0, 0]),
    }
