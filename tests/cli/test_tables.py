"""Tables of scores: whole numbers at any width."""

from __future__ import annotations

import pytest
from rich.console import Console

from wildgs.cli import bench, screen
from wildgs.evaluation import benchmark_table

RUN = "runs/of/last/week/brandenburg_gate_2026"
METRICS = {
    "mean": {
        "psnr": 18.43, "ssim": 0.712, "lpips": 0.345, "landmark": 21.98, "elsewhere": 15.67,
        "detail_energy": 0.83, "detail_correlation": 0.456,
    },
    "num_gaussians": 1_234_567, "render_fps": 89.0, "static_hidden": 0.0321, "static_hidden_worst": 0.2468,
}  # fmt: skip
NUMBERS = ("18.43", "0.712", "0.345", "21.98", "15.67", "0.83", "0.456", "1,234,567", "89", "3.21%", "24.68%")


def narrow(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    """Pretends that stdout is a terminal of some width."""
    terminal = Console(
        file=screen.OUT,  # pyright: ignore[reportArgumentType]
        width=width,
        force_terminal=True,
        color_system=None,
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    monkeypatch.setattr(screen, "console", terminal)


@pytest.mark.parametrize("width", [10, 30, 50, 80, 200])
def test_scores_are_never_cut(width: int, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    narrow(monkeypatch, width)
    screen.print_scores({RUN: {"full": METRICS}})
    printed = capsys.readouterr().out
    assert "…" not in printed
    assert all(number in printed for number in NUMBERS)
    first = "".join(line.split("│")[1].strip() for line in printed.splitlines() if line.startswith("│"))
    assert first == RUN * 2  # the path continues on the next line
    if width >= 80:
        assert max(map(len, printed.splitlines())) <= width


def test_scores_in_a_file_are_one_line_for_each_run(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    screen.print_scores({RUN: {"full": METRICS}})
    printed = capsys.readouterr().out
    assert printed.count(RUN) == 2
    assert all(number in printed for number in NUMBERS)


def test_a_benchmark_is_never_cut(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    narrow(monkeypatch, 15)
    section = benchmark_table.Section(
        "gate, full", ("method", "PSNR", "SSIM"), (("Wild-GS", "18.43 ± 0.12", "0.712"),)
    )
    monkeypatch.setattr(benchmark_table, "sections", lambda _: [section])
    bench._print_table([])
    printed = capsys.readouterr().out
    assert "…" not in printed
    assert all(part in printed for part in ("Wild-GS", "18.43", "0.12", "0.712"))
