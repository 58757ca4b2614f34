"""Report of a run: one HTML file with scores and embedded images, which needs neither server nor network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from wildgs.exporters.depth_colors import color_depth, tint_hidden
from wildgs.exporters.report_scores import MethodScores, scores_section
from wildgs.files import printable, written_aside

__all__ = ["MethodScores", "Report", "ReportExample", "ReportMask", "ReportUnplaced", "write_report"]

Photo = UInt8[np.ndarray, "H W 3"]

_QUALITY = 88
MASK_SIDE = 240
"""Longer side, in pixels, of a training photo beside its mask."""


@dataclass(frozen=True)
class ReportExample:
    """Images of one view.

    Attributes:
        name: Name of the photo.
        photo: The photo.
        render: Render of this view under the appearance of the photo.
        mask: Visibility mask, 255 = static, 0 = transient.
        depth: Rendered depth (0 or non-finite = none), or an image of it.
        clean: The photo without transients (ground truth), if known.
        baseline: Render of the baseline.
        relit: Renders under other appearances: name of the other photo, that photo (of any size), and the render.
        baseline_name: Name of the baseline.
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
class ReportMask:
    """A training photo and what its mask hides.

    Attributes:
        name: Name of the photo.
        photo: The photo.
        visibility: Mask M, 1 = static; None for a method without masks.
        caption: Measurements of the photo.
    """

    name: str
    photo: UInt8[np.ndarray, "H W 3"]
    visibility: Float[np.ndarray, "H W"] | None
    caption: str


@dataclass(frozen=True)
class ReportUnplaced:
    """A photo without a pose.

    Attributes:
        name: Name of the photo.
        reason: Why it has no pose.
        matches: The photo beside the one it matches best, with their matches; None without matches.
    """

    name: str
    reason: str
    matches: UInt8[np.ndarray, "H W 3"] | None


@dataclass(frozen=True)
class Report:
    """Content of a report.

    Attributes:
        title: Title.
        summary: Paragraph below the title.
        methods: Rows of the table of scores.
        examples: Views, from top to bottom.
        misfits: Training photos that no appearance explains, worst first.
        masks: Other training photos and their masks, worst first.
        poses: Summary of structure from motion.
        unplaced: Photos without a pose.
    """

    title: str
    summary: str
    methods: tuple[MethodScores, ...] = ()
    examples: tuple[ReportExample, ...] = ()
    misfits: tuple[ReportMask, ...] = ()
    masks: tuple[ReportMask, ...] = ()
    poses: str = ""
    unplaced: tuple[ReportUnplaced, ...] = ()


def escape(text: str) -> str:
    """Escapes text for HTML; unprintable characters become visible escapes."""
    return html.escape(printable(text))


def write_report(report: Report, file: Path) -> None:
    """Writes a report atomically.

    Args:
        report: Content.
        file: HTML file; missing folders are created.
    """
    template = files("wildgs.exporters").joinpath("report_template.html").read_text(encoding="utf-8")
    page = Template(template).substitute(
        title=escape(report.title),
        summary=escape(report.summary),
        scores=scores_section(report.methods),
        examples=_examples(report.examples)
        + _misfits(report.misfits)
        + _masks(report.masks)
        + _poses(report),
        footer="Written by Wild-GS. All images are embedded; nothing is loaded from the network.",
    )
    with written_aside(file) as aside:
        aside.write_text(page, encoding="utf-8")


def _examples(examples: Sequence[ReportExample]) -> str:
    if not examples:
        return ""
    return (
        '<section><h2>Views</h2><p class="hint">Drag the line to compare the photo with the render. '
        "In the mask, white is predicted to be static and black transient (passers-by). In the depth map, "
        "bright is near.</p>" + "".join(map(_example, examples)) + "</section>"
    )


def _misfits(photos: Sequence[ReportMask]) -> str:
    hint = (
        "No appearance, not even their own, makes their renders resemble them: collages, drawings, other places, "
        "wrong poses, or parts of the scene that were not reconstructed. Training without them may be better. "
    )
    return _beside_masks("Misfits", hint, photos)


def _masks(photos: Sequence[ReportMask]) -> str:
    hint = (
        "Static observations are points of the landmark on which at least three photos agree; masks should not "
        "hide them. Photos in which masks hide most of them come first. "
    )
    return _beside_masks("Masks of training photos", hint, photos)


def _poses(report: Report) -> str:
    if not report.poses:
        return ""
    figures = []
    for photo in report.unplaced:
        name = escape(photo.name)
        picture = "" if photo.matches is None else _picture(photo.matches, f"Matches of {name}")
        figures.append(
            f"<figure>{picture}<figcaption><b>{name}</b>: {escape(photo.reason)}</figcaption></figure>"
        )
    text = f'<section><h2>Camera poses</h2><p class="hint">{escape(report.poses)}</p>'
    if figures:
        hint = (
            "Photos without a pose, beside the photo that they match best; lines connect matching features."
        )
        text += f'<h3>Left out</h3><p class="hint">{hint}</p><div class="masks">{"".join(figures)}</div>'
    return text + "</section>"


def _beside_masks(title: str, hint: str, photos: Sequence[ReportMask]) -> str:
    if not photos:
        return ""
    red = "Red is hidden by the mask (M is low)." if photos[0].visibility is not None else ""
    figures = "".join(map(_beside_mask, photos))
    return f'<section><h2>{title}</h2><p class="hint">{hint}{red}</p><div class="masks">{figures}</div></section>'


def _beside_mask(photo: ReportMask) -> str:
    name, picture = escape(photo.name), Image.fromarray(photo.photo)
    picture.thumbnail((MASK_SIDE, MASK_SIDE), Image.Resampling.LANCZOS)
    small = np.asarray(picture)
    pictures = _picture(small, f"Training photo {name}")
    if photo.visibility is not None:
        mask = Image.fromarray(photo.visibility.astype(np.float32)).resize(picture.size, Image.Resampling.BOX)
        pictures += _picture(tint_hidden(small, np.asarray(mask)), f"What the mask of {name} hides")
    caption = f"<figcaption><b>{name}</b>: {escape(photo.caption)}</figcaption>"
    return f'<figure><div class="beside">{pictures}</div>{caption}</figure>'


def _example(example: ReportExample) -> str:
    name = escape(example.name)
    tiles = [
        ("Mask", f"Visibility mask of {name}", np.repeat(example.mask[..., None], 3, axis=2)),
        ("Depth", f"Rendered depth of {name}", _depth_picture(example.depth)),
    ]
    if example.clean is not None:
        tiles.insert(0, ("Ground truth without transients", f"{name} without transients", example.clean))
    if example.baseline is not None:
        caption = f"{escape(example.baseline_name)}, for comparison"
        tiles.append((caption, f"{name} rendered by {escape(example.baseline_name)}", example.baseline))
    figures = "".join(
        f"<figure>{_picture(pixels, alt)}<figcaption>{caption}</figcaption></figure>"
        for caption, alt, pixels in tiles
    )
    height, width = example.photo.shape[:2]
    # Beside a portrait photo all other images fit, beside a landscape photo only the tiles.
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
    """Photo over render, with a slider between them."""
    name = escape(example.name)
    return (
        '<figure class="compare"><div class="stage">'
        f"{_picture(example.render, f'Render of {name} under its own appearance')}"
        f"{_picture(example.photo, f'Photo {name}', css='above')}"
        '<span class="knob" aria-hidden="true">&#8596;</span>'
        '<span class="tag left">photo</span><span class="tag right">render</span>'
        f'<input type="range" min="0" max="100" value="50" aria-label="Fraction of {name} that shows the photo">'
        "</div><figcaption>Photo, and render under the appearance of the photo</figcaption></figure>"
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
            f"{_picture(pixels, f'{escape(example.name)} rendered under the appearance of {light}')}"
            f"{_picture(np.asarray(small), f'Photo {light}, the source of the appearance', css='source')}"
            f"</div><figcaption>appearance of {light}</figcaption></figure>"
        )
    return (
        f'<h4>This view under the appearance of other photos</h4><div class="relit">{"".join(figures)}</div>'
    )


def _picture(pixels: Photo, alt: str, css: str = "") -> str:
    """An image element with embedded data; `alt` must be escaped."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "JPEG", quality=_QUALITY, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, width = pixels.shape[:2]
    kind = f' class="{css}"' if css else ""
    return f'<img{kind} src="data:image/jpeg;base64,{data}" width="{width}" height="{height}" alt="{alt}">'
