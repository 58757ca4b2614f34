"""Table of scores of the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

_DASH = "–"
_METRICS = (("psnr", "PSNR (dB)", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3))
_PROTOCOLS = {
    "full": ("Protocol full", "appearance from the whole test photo, scored on the whole photo"),
    "half": ("Protocol half", "appearance from the left half of the test photo, scored on the right half"),
}


@dataclass(frozen=True)
class MethodScores:
    """Scores of one method.

    Attributes:
        name: Name of the method.
        scores: Per protocol ("full", "half"), the mean of each metric; None if it could not be computed.
        steps: Training steps.
        train_seconds: Training time.
        num_gaussians: Number of Gaussians at the end of training.
        render_fps: Rendered frames per second.
        device: Device of training and rendering.
        notes: Remarks on the scores, such as why a metric is missing.
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
        """Scores from the content of `metrics.json` files.

        Args:
            name: Name of the method.
            metrics: Content by protocol.
            steps: Training steps; by default those of the files.
        """
        any_file: Mapping[str, Any] = next(iter(metrics.values()), {})
        notes = [note for content in metrics.values() for note in _as_lines(content.get("notes"))]
        notes += _hidden_note(metrics.get("full", {}))
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


def _hidden_note(metrics: Mapping[str, Any]) -> list[str]:
    """Fraction of the static observations that masks hide, if known."""
    hidden, worst = metrics.get("static_hidden"), metrics.get("static_hidden_worst")
    if hidden is None or worst is None:
        return []
    return [
        f"masks hide {hidden:.2%} of the static observations in training photos ({worst:.1%} in the worst photo)"
    ]


def scores_section(methods: Sequence[MethodScores]) -> str:
    """HTML of the section with table and notes."""
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
        f'<section><h2>Scores</h2><p class="hint">{hint}Higher PSNR and SSIM and lower LPIPS are better.</p>'
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
            names = ["first"] if key == "psnr" else []
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
    """Whether a value is the best of several methods; False if there is only one."""
    values = [method.scores.get(protocol, {}).get(key) for method in methods]
    present = [v for v in values if v is not None]
    return len(present) > 1 and value == (min(present) if key == "lpips" else max(present))


def _number(value: float | int | None, digits: int) -> str:
    return _DASH if value is None else f"{value:,.{digits}f}"


def _notes(methods: Sequence[MethodScores]) -> str:
    """Notes below the table; notes that all methods share are listed once."""
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


def _as_float(value: Any) -> float | None:
    return None if value is None else float(value)


def _as_lines(notes: Any) -> Iterable[str]:
    """Notes as lines, from one line, several lines, or lines by metric."""
    if not notes:
        return ()
    if isinstance(notes, Mapping):
        return tuple(f"{key}: {value}" for key, value in notes.items())
    return (notes,) if isinstance(notes, str) else tuple(str(note) for note in notes)
