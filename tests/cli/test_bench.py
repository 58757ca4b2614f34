"""`wildgs bench` on tiny scenes: what it trains, what it skips, and the table it leaves."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pycolmap
import pytest
from PIL import Image

from wildgs.config import RunConfig
from wildgs.engine.trainer import Trainer
from wildgs.scene import Scene

TINY = (
    "--steps",
    2,
    "--wrapping.resolution",
    8,
    "--parsing.max-side",
    32,
    "--parsing.encoder",
    "nobody/none",
)


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WILDGS_LPIPS", "off")


def table(output: Path) -> list[dict[str, str]]:
    with (output / "table.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_bench_goes_on_where_it_stopped_and_skips_what_is_done(
    landmark: Path, wildgs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("bench", landmark, "--output", tmp_path, *TINY, "--methods", "3dgs", "wildgs")
    advance, trained = Trainer.advance, []

    def stops_in_the_second_run(self: Trainer):
        if len(trained) == 3:
            raise KeyboardInterrupt
        trained.append(self.step)
        return advance(self)

    monkeypatch.setattr(Trainer, "advance", stops_in_the_second_run)
    assert wildgs(*command, "--seeds", 0) == 130
    assert {(row["method"], row["protocol"]) for row in table(tmp_path)} == {
        ("3dgs", "full"),
        ("3dgs", "half"),
    }
    first = tmp_path / "scene" / "3dgs" / "seed_0" / "eval" / "full" / "metrics.json"
    before = first.stat().st_mtime_ns

    trained.clear()
    monkeypatch.setattr(Trainer, "advance", lambda self: trained.append(self.step) or advance(self))
    assert wildgs(*command, "--seeds", 0, 1, "--image-cache", "1MB") == 0  # no other outcome, so no other run
    assert len(trained) <= 2 + 2 + 2  # the rest of the second run, and two new ones
    assert first.stat().st_mtime_ns == before
    rows = table(tmp_path)
    assert [(row["protocol"], row["method"], row["seeds"]) for row in rows] == [
        (protocol, method, "2") for protocol in ("full", "half") for method in ("3dgs", "wildgs")
    ]
    assert all(float(row["psnr_mean"]) > 3 and float(row["psnr_std"]) >= 0 for row in rows)
    wildgs_full = rows[1]
    assert 0 < float(wildgs_full["mask_ap_mean"]) <= 1
    assert float(wildgs_full["train_seconds_mean"]) > 0
    content = json.loads((tmp_path / "table.json").read_text(encoding="utf-8"))
    assert len(content["runs"]) == 4
    assert {(tmp_path / run["folder"] / "config.yaml").is_file() for run in content["runs"]} == {True}
    markdown = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "## scene, protocol half" in markdown
    assert "LPIPS: none" in markdown

    trained.clear()
    assert wildgs(*command, "--seeds", 0, 1) == 0
    assert trained == []


def test_a_run_that_fails_is_named_and_the_others_go_on(
    landmark: Path,
    wildgs,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from wildgs.library import benchmark as bench

    train = bench.train

    def refuses_the_first(scene: Scene, config: RunConfig, *, output: Path, **options: Any) -> None:
        if output.parent.name == "3dgs":
            raise MemoryError
        train(scene, config, output=output, **options)

    monkeypatch.setattr(bench, "train", refuses_the_first)
    variant = ("--methods", "3dgs", "--variant", "plain:method=3dgs,train.steps=1", "--seeds", 0)
    assert wildgs("bench", landmark, "--output", tmp_path, *TINY, *variant) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "1 of 2 runs failed" in errors[0]
    assert "3DGS, seed 0 (MemoryError)" in errors[0]
    assert {(row["method"], row["steps"]) for row in table(tmp_path)} == {("plain", "1")}
    assert "`method=3dgs,train.steps=1`" in (tmp_path / "table.md").read_text(encoding="utf-8")


def as_distributed(scene: Path, root: Path, dataset: str) -> None:
    """A scene as Phototourism's come: dense/images, dense/sparse, .jpg with Flickr's numbers, NeRF-W's split."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    (root / "dense" / "images").mkdir(parents=True)
    (root / "dense" / "sparse").mkdir()
    rows = ["filename\tid\tsplit\tdataset"]
    images = sorted(model.images.values(), key=lambda image: image.name)
    for index, image in enumerate(images):
        name = f"{10_000_000 + index}_{8_000_000_000 + 17 * index}.jpg"
        with Image.open(scene / "images" / image.name) as photo:
            photo.convert("RGB").save(root / "dense" / "images" / name)
        image.name = name
        number = "" if index == len(images) - 1 else f"{index + 1}.0"  # NeRF-W's authors set photos aside so
        rows.append(f"{name}\t{number}\t{'test' if index < 2 else 'train'}\t{dataset}")
    model.write_binary(root / "dense" / "sparse")
    (root / f"{dataset}.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def test_phototourism_as_distributed_beside_the_papers_figures(
    landmark: Path, wildgs, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    as_distributed(landmark, data / "brandenburg_gate", "brandenburg")
    for name, dataset in (("sacre_coeur", "sacre"), ("trevi_fountain", "trevi")):
        shutil.copytree(data / "brandenburg_gate" / "dense", data / name / "dense")
        shutil.copy(data / "brandenburg_gate" / "brandenburg.tsv", data / name / f"{dataset}.tsv")
    output = tmp_path / "bench"
    options = ("--methods", "3dgs", "--seeds", 0, *TINY)
    assert wildgs("bench", data, "--suite", "phototourism", "--output", output, *options) == 0
    rows = {(row["scene"], row["protocol"], row["method"]): row for row in table(output)}
    gate = rows["brandenburg_gate", "full", "3dgs"]
    assert (gate["paper_psnr"], gate["paper_ssim"], gate["paper_lpips"]) == ("19.63", "0.8817", "0.1378")
    assert float(gate["psnr_mean"]) > 3
    assert rows["trevi_fountain", "full", "cr-nerf"]["paper_psnr"] == "21.48"
    assert rows["sacre_coeur", "half", "3dgs"]["paper_psnr"] == ""
    folder = output / "sacre_coeur" / "3dgs" / "seed_0" / "eval" / "full"
    images = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["images"]
    assert [image["name"] for image in images] == ["10000000_8000000000.jpg", "10000001_8000000017.jpg"]
    photo = data / "sacre_coeur" / "dense" / "images" / images[0]["name"]
    with Image.open(photo) as full, Image.open(folder / f"{photo.stem}.png") as render:
        assert render.size == (full.width // 2, full.height // 2)
    text = (output / "table.md").read_text(encoding="utf-8")
    assert "| CR-NeRF |" in text
    assert "RTX 3090" in text
    assert "Preset of all rows except other presets: paper." in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "at least one scene"),
        (("{landmark}", "--seed", 3), "--seeds"),
        (("{landmark}", "--variant", "a:model.fusion.hiden=3"), "unknown entry 'hiden'"),
        (("{tmp}/nowhere",), "nowhere: no such folder"),
        (("{landmark}", "--steps", 0), "steps 0: must be 1 or more"),
    ],
)
def test_mistakes_are_one_line(
    options: tuple, said: str, landmark: Path, wildgs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    filled = [str(o).format(landmark=landmark, tmp=tmp_path) for o in options]
    assert wildgs("bench", "--output", tmp_path / "out", *filled) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning:")]
    assert said in line
    assert not (tmp_path / "out").exists()
