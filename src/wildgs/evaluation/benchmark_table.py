"""Rows of a benchmark as markdown, csv and JSON."""

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
            "Detail: standard deviation of high frequencies over the truth's (1 is best), and their correlation "
            "with the truth's."
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
