"""Aggregates scores of many runs: one row per scene, protocol and method, with mean and deviation over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wildgs.model.registry import DEFAULT_METHOD

MIXED = "mixed"
PROTOCOLS = ("full", "half")
METRICS = ("psnr", "ssim", "lpips", "landmark", "elsewhere", "detail_energy", "detail_correlation")
_PLAIN = ("train_seconds", "render_fps", "num_gaussians", "static_hidden", "static_hidden_worst")
_MASKS = {"mask_ap": "average_precision", "mask_iou": "iou"}
QUANTITIES = (*METRICS, *_PLAIN, *_MASKS)


@dataclass(frozen=True)
class Score:
    """One run under one protocol.

    Attributes:
        scene: The scene's name.
        method: The method's name in the bench.
        seed: The run's seed.
        metrics: Content of its `metrics.json`.
    """

    scene: str
    method: str
    seed: int
    metrics: Mapping[str, Any]


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation over runs (None for one run)."""

    mean: float
    std: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float | None]) -> Spread | None:
        """Statistics of the values that are not None; None if there are none."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        mean = math.fsum(known) / len(known)
        return cls(mean, statistics.stdev(known) if len(known) > 1 else None, len(known))


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        scene: The scene's name.
        protocol: `full` or `half`.
        method: The method's name.
        label: The method's label in the table.
        seeds: Seeds of its runs; empty for a method that has published figures only.
        steps: Training steps.
        quantities: Statistics by the names in `QUANTITIES`; None if a quantity could not be computed.
        gain: PSNR minus the baseline's of the same seed; None for the baseline itself or without it.
        lpips_network: `alex`, `squeeze`, None without LPIPS, or `mixed`; then LPIPS is None, since figures of
            different networks are not comparable.
        device: The device on which it was timed.
        published: The paper's figures, by the same names.
    """

    scene: str
    protocol: str
    method: str
    label: str
    seeds: tuple[int, ...]
    steps: int | None
    quantities: Mapping[str, Spread | None]
    gain: Spread | None
    lpips_network: str | None
    device: str
    published: Mapping[str, float] | None = None


Published = Callable[[str, str], Mapping[str, float] | None]


def summarize(
    scores: Sequence[Score],
    labels: Mapping[str, str],
    *,
    published: Published | None = None,
    baseline: str = DEFAULT_METHOD,
) -> list[Row]:
    """Builds rows by scene (in the order of the scores), protocol, and method (in the order of `labels`).

    Args:
        scores: Scores of any number of runs; the two protocols go to different rows.
        labels: Method name to label in the table.
        published: Function from scene and method to published figures, shown in rows of protocol `full`. Methods
            in `labels` without runs get a row if they have such figures.
        baseline: The method relative to which gains are computed.
    """
    rows = []
    for scene in dict.fromkeys(score.scene for score in scores):
        for protocol in PROTOCOLS:
            here = [s for s in scores if s.scene == scene and s.metrics["protocol"] == protocol]
            reference = {s.seed: s.metrics["mean"]["psnr"] for s in here if s.method == baseline}
            for method, label in labels.items():
                runs = [s for s in here if s.method == method]
                figures = published(scene, method) if published and protocol == "full" else None
                if runs:
                    gain = None if method == baseline else _gain(runs, reference)
                    rows.append(_row(label, runs, gain, figures))
                elif here and figures is not None:
                    rows.append(Row(scene, protocol, method, label, (), None, {}, None, None, "", figures))
    return rows


def _row(
    label: str, runs: Sequence[Score], gain: Spread | None, published: Mapping[str, float] | None
) -> Row:
    networks = {score.metrics.get("lpips_network") for score in runs}
    quantities = {name: Spread.of([_value(score, name) for score in runs]) for name in QUANTITIES}
    if len(networks) > 1:
        quantities["lpips"] = None
    return Row(
        scene=runs[0].scene,
        protocol=runs[0].metrics["protocol"],
        method=runs[0].method,
        label=label,
        seeds=tuple(sorted(score.seed for score in runs)),
        steps=runs[0].metrics["step"],
        quantities=quantities,
        gain=gain,
        lpips_network=networks.pop() if len(networks) == 1 else MIXED,
        device=" / ".join(sorted({score.metrics["device"] for score in runs})),
        published=published,
    )


def _value(score: Score, name: str) -> float | None:
    metrics = score.metrics
    if name in METRICS:
        value = metrics["mean"].get(name)
    elif name in _MASKS:
        value = metrics.get("masks", {}).get(_MASKS[name])
    else:
        value = metrics.get(name)
    return None if value is None else float(value)


def _gain(runs: Sequence[Score], reference: Mapping[int, float | None]) -> Spread | None:
    gains: list[float | None] = []
    for score in runs:
        own, other = score.metrics["mean"]["psnr"], reference.get(score.seed)
        gains.append(None if own is None or other is None else own - other)
    return Spread.of(gains)
