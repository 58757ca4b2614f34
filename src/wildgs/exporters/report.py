"""A run's report: one HTML file with its scores and pictures inside, opened without server or network."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from wildgs.exporters.depth_colors import color_depth
from wildgs.exporters.report_scores import MethodScores, scores_section
from wildgs.files import written_aside

__all__ = ["MethodScores", "Report", "ReportExample", "write_report"]

Photo = UInt8[np.ndarray, "H W 3"]

_QUALITY = 88


@dataclass(frozen=True)
class ReportExample:
    """Pictures of one view.

    Attributes:
        name: Of the photo.
        photo: As taken.
        render: The scene from there under the photo's own light.
        mask: Visibility: 255 = static, 0 = transient.
        depth: Rendered depth in world units (0 or not finite = none), or a picture of it.
        clean: The photo without its transients, where it is known.
        baseline: The baseline's render.
        relit: Name of another photo, that photo (of any size), and this view under its light.
        baseline_name: What to call the baseline.
    """

    name: str
    photo: UInt8[np.ndarray, "H W 3"]
    render: UInt8[np.ndarray, "H W 3"]
    mask: UInt8[np.ndarray, "H W"]
    depth: UInt8[np.ndarray, "H W 3"] | Float[np.ndarray, "H W"]
    clean: UInt8[np.ndarray, "H W 3"] | None = None
    baseline: UInt8[np.ndarray, "H W 3"] | None = None
    relit: tuple[tuple[str, UInt8[np.ndarray, "_ _ 3"], UInt8[np.ndarray, "H W 3"]], ...] = ()
    baseline_name: str = "3DGS"


@dataclass(frozen=True)
class Report:
    """All that the page shows.

    Attributes:
        title: Its headline.
        summary: A paragraph below it.
        methods: Rows of the table of scores.
        examples: Views, from top to bottom.
    """

    title: str
    summary: str
    methods: tuple[MethodScores, ...] = ()
    examples: tuple[ReportExample, ...] = ()


def write_report(report: Report, file: Path) -> None:
    """Writes the page, aside first and then renamed, so that no half page is ever left.

    Args:
        report: What to show.
        file: The HTML file; its folder is made where it is missing.
    """
    template = files("wildgs.exporters").joinpath("report_template.html").read_text(encoding="utf-8")
    page = Template(template).substitute(
        title=escape(report.title),
        summary=escape(report.summary),
        scores=scores_section(report.methods),
        examples=_examples(report.examples),
        footer="Written by Wild-GS. The pictures are part of this file; nothing is loaded from elsewhere.",
    )
    with written_aside(file) as aside:
        aside.write_text(page, encoding="utf-8")


def _examples(examples: Sequence[ReportExample]) -> str:
    if not examples:
        return ""
    return (
        '<section><h2>Views</h2><p class="hint">Drag the line to compare the photo with the render. '
        "In the mask, white is what the method takes for the scene and black what it takes for passers-by. "
        "In the depth picture, bright is near.</p>" + "".join(map(_example, examples)) + "</section>"
    )


def _example(example: ReportExample) -> str:
    name = escape(example.name)
    tiles = [
        ("Mask", f"Visibility mask of {name}", np.repeat(example.mask[..., None], 3, axis=2)),
        ("Depth", f"Rendered depth of {name}", _depth_picture(example.depth)),
    ]
    if example.clean is not None:
        tiles.insert(0, ("Photo without passers-by (truth)", f"{name} without its passers-by", example.clean))
    if example.baseline is not None:
        caption = f"{escape(example.baseline_name)}, for comparison"
        tiles.append((caption, f"{name} rendered by {escape(example.baseline_name)}", example.baseline))
    figures = "".join(
        f"<figure>{_picture(pixels, alt)}<figcaption>{caption}</figcaption></figure>"
        for caption, alt, pixels in tiles
    )
    height, width = example.photo.shape[:2]
    # Beside an upright photo there is room for all other pictures; beside a wide one only for the tiles.
    wide = width >= height
    columns, tall, least = (2, "430px", "240px") if wide else (min(len(tiles), 4), "560px", "150px")
    layout = f"--ratio:{width / height:.4f};--columns:{columns};--tall:{tall};--least:{least}"
    beside, below = ("", _relit(example)) if wide else (_relit(example), "")
    return (
        f'<article class="view" style="{layout}"><h3>{name}</h3><div class="top">{_compare(example)}'
        f'<div><div class="tiles">{figures}</div>{beside}</div></div>{below}</article>'
    )


def _depth_picture(depth: np.ndarray) -> Photo:
    return depth if depth.ndim == 3 else color_depth(depth)


def _compare(example: ReportExample) -> str:
    """The photo over the render, with a line to drag."""
    name = escape(example.name)
    return (
        '<figure class="compare"><div class="stage">'
        f"{_picture(example.render, f'Render of {name} under its own light')}"
        f"{_picture(example.photo, f'Photo {name}', css='above')}"
        '<span class="knob" aria-hidden="true">&#8596;</span>'
        '<span class="tag left">photo</span><span class="tag right">render</span>'
        f'<input type="range" min="0" max="100" value="50" aria-label="Share of {name} that shows the photo">'
        "</div><figcaption>Photo and render under the photo&#x27;s own light</figcaption></figure>"
    )


def _relit(example: ReportExample) -> str:
    if not example.relit:
        return ""
    figures = []
    for source, thumb, pixels in example.relit:
        light = escape(source)
        small = Image.fromarray(thumb)
        small.thumbnail((160, 160))
        figures.append(
            f'<figure><div class="pair">'
            f"{_picture(pixels, f'{escape(example.name)} rendered under the light of {light}')}"
            f"{_picture(np.asarray(small), f'Photo {light}, whose light it is', css='source')}"
            f"</div><figcaption>light of {light}</figcaption></figure>"
        )
    return (
        f'<h4>The same view under the light of other photos</h4><div class="relit">{"".join(figures)}</div>'
    )


def _picture(pixels: Photo, alt: str, css: str = "") -> str:
    """An image element with its data inside; `alt` is escaped already."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "JPEG", quality=_QUALITY, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, width = pixels.shape[:2]
    kind = f' class="{css}"' if css else ""
    return f'<img{kind} src="data:image/jpeg;base64,{data}" width="{width}" height="{height}" alt="{alt}">'
