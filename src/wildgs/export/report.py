"""A run's report: one HTML file with its scores and pictures inside, opened without server or network."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from wildgs.export.depth_colors import color_depth

Photo = UInt8[np.ndarray, "H W 3"]

_QUALITY = 88
_DASH = "–"
_METRICS = (("psnr", "PSNR (dB)", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3))
_PROTOCOLS = {
    "full": ("Whole photo", "the light is taken from the whole test photo, which is scored as a whole"),
    "half": (
        "Half photo",
        "the light is taken from the left half of the test photo, the right half is scored",
    ),
}


@dataclass(frozen=True)
class MethodScores:
    """Scores of one method.

    Attributes:
        name: Of the method.
        scores: Per protocol ("full", "half"), the mean of each metric; None where it could not be computed.
        steps: Training steps.
        train_seconds: Training time.
        num_gaussians: At the end of training.
        render_fps: Frames per second.
        device: On which it trained and rendered.
        notes: What a reader of the scores has to know, such as why a metric is missing.
    """

    name: str
    scores: Mapping[str, Mapping[str, float | None]]
    steps: int | None = None
    train_seconds: float | None = None
    num_gaussians: int | None = None
    render_fps: float | None = None
    device: str = ""
    notes: tuple[str, ...] = ()

    @classmethod
    def from_metrics(
        cls, name: str, metrics: Mapping[str, Mapping[str, Any]], steps: int | None = None
    ) -> MethodScores:
        """Takes scores from the contents of `metrics.json` files.

        Args:
            name: Of the method.
            metrics: Contents by protocol.
            steps: Training steps; by default the step that the files state.
        """
        any_file: Mapping[str, Any] = next(iter(metrics.values()), {})
        notes = [note for content in metrics.values() for note in _as_lines(content.get("notes"))]
        return cls(
            name=name,
            scores={
                protocol: {key: _as_float(content.get("mean", {}).get(key)) for key, _, _ in _METRICS}
                for protocol, content in metrics.items()
            },
            steps=any_file.get("step") if steps is None else steps,
            train_seconds=_as_float(any_file.get("train_seconds")),
            num_gaussians=any_file.get("num_gaussians"),
            render_fps=_as_float(any_file.get("render_fps")),
            device=str(any_file.get("device") or ""),
            notes=tuple(dict.fromkeys(notes)),
        )


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
    relit: tuple[tuple[str, UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "H W 3"]], ...] = ()
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
    template = files("wildgs.export").joinpath("report_template.html").read_text(encoding="utf-8")
    page = Template(template).substitute(
        title=escape(report.title),
        summary=escape(report.summary),
        scores=_scores(report.methods),
        examples=_examples(report.examples),
        footer="Written by Wild-GS. The pictures are part of this file; nothing is loaded from elsewhere.",
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    aside = file.with_name(f".{file.name}.part")
    aside.write_text(page, encoding="utf-8")
    aside.replace(file)


def _as_float(value: Any) -> float | None:
    return None if value is None else float(value)


def _as_lines(notes: Any) -> Iterable[str]:
    """Notes as lines, whether they were stored as one line, several, or by metric."""
    if not notes:
        return ()
    if isinstance(notes, Mapping):
        return tuple(f"{key}: {value}" for key, value in notes.items())
    return (notes,) if isinstance(notes, str) else tuple(str(note) for note in notes)


def _scores(methods: Sequence[MethodScores]) -> str:
    if not methods:
        return ""
    protocols = [p for p in _PROTOCOLS if any(p in method.scores for method in methods)]
    groups = "".join(f'<th colspan="3" scope="colgroup">{_PROTOCOLS[p][0]}</th>' for p in protocols)
    columns = "".join(
        f'<th scope="col"{_first(key)}>{label}</th>' for _ in protocols for key, label, _ in _METRICS
    )
    facts = "".join(
        f'<th scope="col" rowspan="2"{" class=first" * (i == 0)}>{label}</th>'
        for i, label in enumerate(("Steps", "Minutes", "Gaussians", "Frames/s"))
    )
    rows = "".join(_row(method, methods, protocols) for method in methods)
    meaning = "; ".join(f"{_PROTOCOLS[p][0].lower()}: {_PROTOCOLS[p][1]}" for p in protocols)
    hint = f"Means over the held-out photos ({escape(meaning)}). " if protocols else ""
    return (
        f'<section><h2>Scores</h2><p class="hint">{hint}Higher PSNR and SSIM, lower LPIPS are better.</p>'
        '<div class="scroll" tabindex="0" role="region" aria-label="Table of scores"><table><thead>'
        f'<tr><th scope="col" rowspan="2">Method</th>{groups}{facts}</tr><tr>{columns}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{_notes(methods)}</section>"
    )


def _first(key: str) -> str:
    return ' class="first"' if key == _METRICS[0][0] else ""


def _row(method: MethodScores, methods: Sequence[MethodScores], protocols: Sequence[str]) -> str:
    cells = [f'<th scope="row">{escape(method.name)}</th>']
    for protocol in protocols:
        for key, _, digits in _METRICS:
            value = method.scores.get(protocol, {}).get(key)
            names = [name for name, on in (("first", key == "psnr"), ("best", False)) if on]
            if value is not None and _is_best(value, key, protocol, methods):
                names.append("best")
            label = "not computed, see the notes" if value is None else f"{value:.{digits}f}"
            shown = f'<span role="img" aria-label="{label}">{_DASH}</span>' if value is None else label
            cells.append(f'<td class="{" ".join(names)}">{shown}</td>')
    minutes = None if method.train_seconds is None else method.train_seconds / 60.0
    facts = (
        _number(method.steps, 0),
        _number(minutes, 1),
        _number(method.num_gaussians, 0),
        _number(method.render_fps, 1),
    )
    cells += [f'<td class="{"first" * (i == 0)}">{fact}</td>' for i, fact in enumerate(facts)]
    return f"<tr>{''.join(cells)}</tr>"


def _is_best(value: float, key: str, protocol: str, methods: Sequence[MethodScores]) -> bool:
    """Whether no other method has a better value; with nothing to compare, none is best."""
    values = [method.scores.get(protocol, {}).get(key) for method in methods]
    known = [v for v in values if v is not None]
    return len(known) > 1 and value == (min(known) if key == "lpips" else max(known))


def _number(value: float | int | None, digits: int) -> str:
    return _DASH if value is None else f"{value:,.{digits}f}"


def _notes(methods: Sequence[MethodScores]) -> str:
    """Notes below the table; those that all methods share are said once."""
    by_note: dict[str, list[str]] = {}
    for method in methods:
        device = (f"measured on {method.device}",) if method.device else ()
        for note in (*device, *method.notes):
            by_note.setdefault(note, []).append(method.name)
    items = []
    for note, names in by_note.items():
        who = "" if len(names) == len(methods) else f"{', '.join(names)}: "
        items.append(f"<li>{escape(who + note)}</li>")
    return f'<ul class="notes">{"".join(items)}</ul>' if items else ""


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
