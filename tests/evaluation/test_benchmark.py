"""Means, spreads and gains over runs, and the table in its three forms."""

from __future__ import annotations

import csv
import io

import pytest

from wildgs.evaluation.benchmark import MIXED, Row, Score, summarize
from wildgs.evaluation.benchmark_table import (
    PHOTOTOURISM,
    legend,
    published_figures,
    sections,
    to_csv,
    to_markdown,
    to_records,
)

LABELS = {"3dgs": "3DGS", "wildgs": "Wild-GS", "without-mask": "w/o Mask"}


def score(
    method: str = "wildgs",
    seed: int = 0,
    psnr: float | None = 20.0,
    *,
    scene: str = "gate",
    protocol: str = "full",
    **entries: object,
) -> Score:
    metrics = {
        "protocol": protocol,
        "step": 100,
        "num_gaussians": 1000 + seed,
        "train_seconds": 60.0,
        "render_fps": 50.0,
        "device": "cpu, 2 threads",
        "lpips_network": "squeeze",
        "mean": {"psnr": psnr, "ssim": 0.5, "lpips": 0.25},
        "notes": [],
        **entries,
    }
    return Score(scene, method, seed, metrics)


def find(rows: list[Row], method: str, protocol: str = "full") -> Row:
    (row,) = [row for row in rows if row.method == method and row.protocol == protocol]
    return row


def test_mean_and_sample_deviation_over_seeds():
    rows = summarize([score(seed=seed, psnr=psnr) for seed, psnr in enumerate((20.0, 21.0, 23.0))], LABELS)
    psnr = find(rows, "wildgs").quantities["psnr"]
    assert psnr is not None
    assert psnr.mean == pytest.approx(64 / 3)
    assert psnr.std == pytest.approx((7 / 3) ** 0.5)
    assert find(rows, "wildgs").seeds == (0, 1, 2)


def test_a_single_run_has_no_spread_and_a_null_counts_in_no_mean():
    rows = summarize([score(psnr=20.0), score(seed=1, psnr=None)], LABELS)
    psnr = find(rows, "wildgs").quantities["psnr"]
    assert psnr is not None
    assert (psnr.mean, psnr.std, psnr.count) == (20.0, None, 1)


def test_protocols_never_share_a_row():
    rows = summarize([score(psnr=20.0), score(psnr=30.0, protocol="half")], LABELS)
    assert [(row.protocol, row.quantities["psnr"].mean) for row in rows if row.quantities["psnr"]] == [
        ("full", 20.0),
        ("half", 30.0),
    ]
    assert [section.title for section in sections(rows)] == ["gate, protocol full", "gate, protocol half"]


def test_gains_pair_runs_of_one_seed():
    scores = [score(seed=s, psnr=p) for s, p in ((0, 20.0), (1, 30.0))]
    scores += [score("3dgs", seed=s, psnr=p) for s, p in ((0, 18.0), (1, 28.0), (2, 5.0))]
    rows = summarize(scores, LABELS)
    gain = find(rows, "3dgs").gain
    assert gain is not None
    assert (gain.mean, gain.std, gain.count) == (-2.0, 0.0, 2)  # seed 2 has nothing to be paired with
    assert find(rows, "wildgs").gain is None
    assert find(summarize(scores[2:], LABELS), "3dgs").gain is None


def test_rows_stand_in_the_order_of_the_labels():
    rows = summarize([score("without-mask"), score("wildgs"), score("3dgs")], LABELS)
    assert [row.label for row in rows] == ["3DGS", "Wild-GS", "w/o Mask"]


def test_lpips_of_different_networks_is_not_averaged():
    rows = summarize([score(), score(seed=1, lpips_network="alex")], LABELS)
    row = find(rows, "wildgs")
    assert row.lpips_network == MIXED
    assert row.quantities["lpips"] is None
    assert any("different networks" in line for line in legend(rows))


@pytest.mark.parametrize(
    ("network", "expected"), [("alex", "with AlexNet"), ("squeeze", "with SqueezeNet"), (None, "none")]
)
def test_legend_names_the_network(network, expected):
    lines = legend(summarize([score(lpips_network=network)], LABELS))
    assert any(line.startswith("LPIPS") and expected in line for line in lines)


def test_masks_have_columns_only_where_they_were_scored():
    masks = {"average_precision": 0.75, "iou": 0.5, "images": 3}
    rows = summarize([score(masks=masks), score("3dgs"), score(protocol="half")], LABELS)
    full, half = sections(rows)
    assert "mask AP ↑" in full.header
    assert "mask AP ↑" not in half.header
    column = full.header.index("mask AP ↑")
    assert [line[column] for line in full.lines] == ["-", "0.750"]


def test_markdown_is_a_table_that_holds_what_was_measured():
    scores = [score(seed=0, psnr=20.0), score(seed=1, psnr=21.0), score("3dgs", psnr=15.0)]
    text = to_markdown(summarize(scores, LABELS), "3 runs", ["a note"])
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert "20.50 ± 0.71" in text
    assert "-5.00" in text
    assert "- a note" in text


def test_csv_and_records_hold_plain_numbers():
    rows = summarize([score(seed=0, psnr=20.0), score(seed=1, psnr=21.0)], LABELS)
    (line,) = list(csv.DictReader(io.StringIO(to_csv(rows))))
    assert float(line["psnr_mean"]) == 20.5
    assert float(line["num_gaussians_mean"]) == 1000.5
    assert line["lpips_network"] == "squeeze"
    assert line["mask_ap_mean"] == ""
    assert {
        key: str(value) if value is not None else "" for key, value in to_records(rows)[0].items()
    } == line


def test_papers_figures_stand_beside_ours_in_full_only():
    labels = LABELS | {"nerf-w": "NeRF-W"}
    scores = [
        score(scene="trevi_fountain", protocol=protocol, method=method)
        for protocol in ("full", "half")
        for method in ("3dgs", "wildgs")
    ]
    rows = summarize(scores, labels, published=published_figures)
    wildgs = find(rows, "wildgs")
    assert wildgs.published is not None
    assert wildgs.published["psnr"] == 24.45
    assert wildgs.published["train_seconds"] == pytest.approx(0.52 * 3600)
    assert find(rows, "nerf-w").seeds == ()
    assert all(row.published is None for row in rows if row.protocol == "half")
    assert "24.45" in to_markdown(rows, "")


def test_other_scenes_have_no_published_figures():
    assert published_figures("gate", "wildgs") is None
    assert published_figures("sacre_coeur", "without-local") is None


@pytest.mark.shared
def test_published_figures_are_the_papers(shared):
    """Every figure of ours, read from the table in the paper's own source."""
    text = (shared / "reference" / "wild-gs-paper.tex").read_text(encoding="utf-8")
    names = {
        "3DGS ": "3dgs",
        "NeRF-W ": "nerf-w",
        "Ha-NeRF ": "ha-nerf",
        "CR-NeRF ": "cr-nerf",
        "Wild-GS\\textsuperscript": "wildgs-half-steps",
        "Wild-GS &": "wildgs",
        "w/o Crop": "without-crop",
        "w/o $\\{c": "without-reverse",
        "w/o Global": "without-global",
        "w/o Mask": "without-mask",
        "w/o Depth": "without-depth",
    }
    for start, method in names.items():
        (line,) = [
            line
            for line in (raw.replace("\\rowcolor{cyan!20} ", "") for raw in text.splitlines())
            if line.startswith(start) and line.count("&") == 11
        ]
        cells = line.replace("\\textbf{", "").replace("\\underline{", "").replace("}", "").replace("\\\\", "")
        figures = [float(cell) for cell in cells.split("&")[1:]]
        for index, scene in enumerate(PHOTOTOURISM):
            published = published_figures(scene, method)
            assert published is not None
            assert [published[name] for name in ("psnr", "ssim", "lpips")] == figures[
                3 * index : 3 * index + 3
            ]
            assert published["train_seconds"] == pytest.approx(figures[9] * 3600)
            assert published["render_fps"] == figures[10]
