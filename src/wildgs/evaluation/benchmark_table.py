"""Rows of a benchmark as markdown, csv and JSON; and the published scores to compare with.

These are from table 1 of the paper: Phototourism at half resolution, one RTX 3090.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from wildgs.evaluation.benchmark import MIXED, QUANTITIES, Row, Spread

NETWORKS = {"alex": "AlexNet", "squeeze": "SqueezeNet 1.1"}
PUBLISHED = ("psnr", "ssim", "lpips", "train_seconds", "render_fps")
MISSING = "-"


@dataclass(frozen=True)
class Section:
    """The table of one scene under one protocol, as text.

    Attributes:
        title: Scene and protocol.
        header: Headings of the columns that are not empty.
        lines: One cell per column.
    """

    title: str
    header: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class _Column:
    header: str
    cell: Callable[[Row], str]


def sections(rows: Sequence[Row]) -> list[Section]:
    """One table per scene and protocol, since figures of the two protocols are not comparable."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.scene, row.protocol), []).append(row)
    return [_section(f"{scene}, protocol {protocol}", group) for (scene, protocol), group in groups.items()]


def _section(title: str, rows: Sequence[Row]) -> Section:
    columns = [(column.header, [column.cell(row) for row in rows]) for column in _COLUMNS]
    filled = [(header, cells) for header, cells in columns if any(cell != MISSING for cell in cells)]
    lines = zip(*(cells for _, cells in filled), strict=True)
    return Section(title, tuple(header for header, _ in filled), tuple(lines))


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}"


def _spread(value: Spread | None, digits: int, *, unit: float = 1.0, sign: bool = False) -> str:
    if value is None:
        return MISSING
    mean = f"{value.mean / unit:+.{digits}f}" if sign else _number(value.mean / unit, digits)
    return mean if value.std is None else f"{mean} ± {_number(value.std / unit, digits)}"


def _ours(name: str, digits: int, unit: float = 1.0) -> Callable[[Row], str]:
    return lambda row: _spread(row.quantities.get(name), digits, unit=unit)


def _paper(name: str, digits: int, unit: float = 1.0) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        return MISSING if row.published is None else _number(row.published[name] / unit, digits)

    return cell


_COLUMNS = (
    _Column("method", lambda row: row.label),
    _Column("seeds", lambda row: str(len(row.seeds)) if row.seeds else MISSING),
    _Column("steps", lambda row: MISSING if row.steps is None else f"{row.steps:,}"),
    _Column("PSNR ↑", _ours("psnr", 2)),
    _Column("paper", _paper("psnr", 2)),
    _Column("vs Wild-GS", lambda row: _spread(row.gain, 2, sign=True)),
    _Column("SSIM ↑", _ours("ssim", 4)),
    _Column("paper", _paper("ssim", 4)),
    _Column("LPIPS ↓", _ours("lpips", 4)),
    _Column("paper", _paper("lpips", 4)),
    _Column("landmark ↑", _ours("landmark", 2)),
    _Column("elsewhere ↑", _ours("elsewhere", 2)),
    _Column("detail", _ours("detail_energy", 2)),
    _Column("detail corr. ↑", _ours("detail_correlation", 3)),
    _Column("training, min", _ours("train_seconds", 1, 60.0)),
    _Column("paper", _paper("train_seconds", 1, 60.0)),
    _Column("frames/s", _ours("render_fps", 1)),
    _Column("paper", lambda row: MISSING if row.published is None else f"{row.published['render_fps']:g}"),
    _Column("Gaussians", _ours("num_gaussians", 0)),
    _Column("mask AP ↑", _ours("mask_ap", 3)),
    _Column("mask IoU ↑", _ours("mask_iou", 3)),
    _Column("static hidden, % ↓", _ours("static_hidden", 2, 0.01)),
    _Column("worst photo, %", _ours("static_hidden_worst", 1, 0.01)),
)


def legend(rows: Sequence[Row]) -> list[str]:
    """Explanations of the columns."""
    lines = []
    if any(len(row.seeds) > 1 for row in rows):
        lines.append("Mean ± sample standard deviation over seeds.")
    if any(row.gain is not None for row in rows):
        lines.append("vs Wild-GS: difference in PSNR (dB), run by run with the same seed.")
    if any(row.quantities.get("mask_ap") is not None for row in rows):
        lines.append("Masks: average precision and IoU of transients in training photos, all pixels pooled.")
    if any(row.quantities.get("landmark") is not None for row in rows):
        lines.append(
            "Landmark and elsewhere: PSNR (dB) within 3% of the photo's longer side of triangulated observations, "
            "and of all other pixels (sky, ground, passers-by)."
        )
    if any(row.quantities.get("detail_energy") is not None for row in rows):
        lines.append(
            "Detail: standard deviation of high frequencies relative to the ground truth (1 is best), and their "
            "correlation with the ground truth."
        )
    if any(row.quantities.get("static_hidden") is not None for row in rows):
        lines.append(
            "Static hidden: share of observations of points that three photos or more triangulated at which the "
            "mask of the training photo hides the landmark, over all photos, and in the worst one."
        )
    lines.append(_lpips_line(rows))
    devices = ", ".join(sorted({row.device for row in rows if row.device}))
    if devices:
        lines.append(f"Timed on {devices}.")
    if any(row.published is not None for row in rows):
        lines.append(
            "Paper: Xu, Mei, Patel 2024, table 1, photos at half resolution, one RTX 3090; training time and "
            "frames per second are one figure for its three scenes. It does not say which network its LPIPS uses."
        )
    return lines


def _lpips_line(rows: Sequence[Row]) -> str:
    networks = {row.lpips_network for row in rows if row.seeds}
    if networks == {None}:
        return "LPIPS: none, since its weights were not available."
    if len(networks) == 1 and MIXED not in networks:
        return (
            f"LPIPS v0.1 with {' '.join(NETWORKS.get(str(network), str(network)) for network in networks)}."
        )
    return (
        "LPIPS: runs were scored with different networks, or without one; figures of different networks are not "
        "comparable. The same command scores runs again if their checkpoints still exist."
    )


def to_markdown(rows: Sequence[Row], heading: str, notes: Sequence[str] = ()) -> str:
    """Formats the tables with their legend as markdown.

    Args:
        rows: Rows of `summarize`.
        heading: First line below the title.
        notes: Additional lines of the legend.
    """
    parts = ["# Benchmark", heading]
    for section in sections(rows):
        alignment = ("---", *("--:" for _ in section.header[1:]))
        table = [section.header, alignment, *section.lines]
        parts.append(f"## {section.title}")
        parts.append("\n".join("| " + " | ".join(map(_escape, line)) + " |" for line in table))
    parts.append("\n".join(f"- {line}" for line in [*legend(rows), *notes]))
    return "\n\n".join(parts) + "\n"


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|")


def to_records(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows as flat records (times in seconds): the columns of the csv, and `rows` of the JSON."""
    return [_record(row) for row in rows]


def _record(row: Row) -> dict[str, Any]:
    record: dict[str, Any] = {
        "scene": row.scene,
        "protocol": row.protocol,
        "method": row.method,
        "label": row.label,
        "steps": row.steps,
        "seeds": len(row.seeds),
    }
    spreads = {name: row.quantities.get(name) for name in QUANTITIES} | {"psnr_gain": row.gain}
    for name, spread in spreads.items():
        record[f"{name}_mean"] = None if spread is None else spread.mean
        record[f"{name}_std"] = None if spread is None else spread.std
    record |= {"lpips_network": row.lpips_network, "device": row.device}
    return record | {f"paper_{name}": (row.published or {}).get(name) for name in PUBLISHED}


def to_csv(rows: Sequence[Row]) -> str:
    """Formats one line per row with plain numbers; missing values are empty."""
    records = to_records(rows)
    if not records:
        return ""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


PHOTOTOURISM = ("brandenburg_gate", "sacre_coeur", "trevi_fountain")
"""Folder names of the scenes, as distributed."""

LABELS = {"nerf-w": "NeRF-W", "ha-nerf": "Ha-NeRF", "cr-nerf": "CR-NeRF"}
"""Labels of the table's methods that are not part of this package."""

_PUBLISHED_METRICS = ("psnr", "ssim", "lpips")
_PUBLISHED_TABLE: dict[str, tuple[float, ...]] = {
    # PSNR, SSIM, LPIPS of Brandenburg Gate, Sacre Coeur, Trevi Fountain; hours of training, frames per second
    "3dgs": (19.63, 0.8817, 0.1378, 17.95, 0.8455, 0.1633, 17.23, 0.6963, 0.2815, 0.12, 220),
    "nerf-w": (24.17, 0.8905, 0.1670, 19.20, 0.8076, 0.1915, 18.97, 0.6984, 0.2652, 60.3, 0.05),
    "ha-nerf": (24.04, 0.8873, 0.1391, 20.02, 0.8012, 0.1710, 20.18, 0.6908, 0.2225, 71.6, 0.05),
    "cr-nerf": (26.53, 0.9003, 0.1060, 22.07, 0.8233, 0.1520, 21.48, 0.7117, 0.2069, 101, 0.02),
    "wildgs-half-steps": (27.81, 0.9180, 0.1085, 23.85, 0.8567, 0.1575, 22.77, 0.7629, 0.2229, 0.23, 225),
    "wildgs": (29.65, 0.9333, 0.0951, 24.99, 0.8776, 0.1270, 24.45, 0.8081, 0.1622, 0.52, 227),
    "without-crop": (29.15, 0.9324, 0.0968, 24.93, 0.8761, 0.1323, 23.61, 0.7915, 0.1856, 0.85, 223),
    "without-reverse": (28.52, 0.9286, 0.1019, 24.37, 0.8623, 0.1379, 24.14, 0.8036, 0.1657, 0.47, 227),
    "without-global": (29.00, 0.9295, 0.1006, 24.82, 0.8761, 0.1309, 24.18, 0.8045, 0.1702, 0.53, 224),
    "without-mask": (28.85, 0.9292, 0.0981, 24.71, 0.8833, 0.1216, 23.91, 0.8063, 0.1590, 0.53, 205),
    "without-depth": (28.36, 0.9261, 0.1064, 23.36, 0.8573, 0.1672, 23.20, 0.7878, 0.1827, 0.48, 218),
}


def published_figures(scene: str, method: str) -> dict[str, float] | None:
    """Published figures of a scene and method, by the names of `metrics.json`; protocol `full`.

    Args:
        scene: One of `PHOTOTOURISM`.
        method: A method of `wildgs bench`, or of `LABELS`.

    Returns:
        ``psnr``, ``ssim``, ``lpips``, ``train_seconds`` and ``render_fps`` (the last two are the same for all
        three scenes); None if the table has no such row.
    """
    if scene not in PHOTOTOURISM or method not in _PUBLISHED_TABLE:
        return None
    row = _PUBLISHED_TABLE[method]
    first = 3 * PHOTOTOURISM.index(scene)
    figures = dict(zip(_PUBLISHED_METRICS, row[first : first + 3], strict=True))
    return figures | {"train_seconds": row[-2] * 3600, "render_fps": float(row[-1])}
