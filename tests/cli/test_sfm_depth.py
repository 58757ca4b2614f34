from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image

from wildgs.cli import depth, sfm
from wildgs.cli import main as wildgs
from wildgs.config import RunConfig
from wildgs.config_file import write_config
from wildgs.library import pipeline
from wildgs.priors.config import StereoConfig
from wildgs.priors.depth import DepthEstimator
from wildgs.sfm import reconstruction
from wildgs.sfm.report import SfmReport


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sfm", "nowhere", "--output", "scene"], "nowhere: no such folder"),
        (["depth", "nowhere"], "nowhere: no such folder"),
    ],
)
def test_mistakes_end_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        wildgs(arguments)
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_progress_and_report_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    report = SfmReport(
        3, ("a.jpg", "b.jpg"), {"c [x].jpg": "matches no other photo"}, 9, 0.5, "gps", 3, (2,), 1.0
    )

    def reconstruct(photos: Path, output: Path, config: object, *, overwrite: bool, progress) -> SfmReport:
        assert (photos, output, overwrite) == (Path("p"), Path("s"), True)
        progress("reading photos", 1, 3)
        progress("reading photos", 3, 3)
        progress("undistorting", 0, 0)
        return report

    monkeypatch.setattr(reconstruction, "reconstruct", reconstruct)
    sfm.run(sfm.Command(Path("p"), Path("s"), overwrite=True))
    printed = capsys.readouterr().out
    assert "reading photos: 3 done" in printed
    assert "2 of 3 photos registered" in printed
    assert "c [x].jpg: matches no other photo" in printed


def test_depth_reports_what_it_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = {}

    def load(source: str, **options: object) -> object:
        asked.update(options, source=source)
        return object()

    def fill(root: Path, estimator: object, *, overwrite: bool, progress) -> tuple[int, int]:
        progress(3, 3)
        return 2, 1

    monkeypatch.setattr(pipeline, "load_depth_anything", load)
    monkeypatch.setattr(pipeline, "fill_depth_folder", fill)
    depth.run(depth.Command(tmp_path, model="here", device="cpu"))
    assert asked == {"source": "here", "device": "cpu", "required": True}
    assert "2 written, 1 already existed" in capsys.readouterr().out.replace("\n", " ")


def test_depth_by_stereo_needs_no_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(root: Path, config: StereoConfig, *, holdout: int, overwrite: bool, progress) -> tuple[int, int]:
        assert (root, config.max_side, holdout, overwrite) == (tmp_path, 200, 5, True)
        return 4, 0

    monkeypatch.setattr(pipeline, "load_depth_anything", None)
    monkeypatch.setattr(pipeline, "fill_metric_folder", fill)
    arguments = ["--by", "stereo", "--holdout", "5", "--stereo.max-side", "200", "--overwrite"]
    wildgs(["depth", str(tmp_path), *arguments])
    assert "4 written, 0 already existed" in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.filterwarnings("ignore:.*no other photos agree with:wildgs.errors.WildGSWarning")
def test_a_run_killed_while_depth_was_estimated_goes_on_with_it(
    make_scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos that have depth are not estimated again; once training has begun, depth stays as it was then."""
    root = make_scene(3)
    output = tmp_path / "run"
    output.mkdir()
    root.rename(output / "scene")
    depth_folder = output / "scene/depth"
    estimated: list[int] = []

    class Estimator(DepthEstimator):
        def __init__(self) -> None:
            super().__init__(torch.nn.Identity())

        def estimate(self, photo: torch.Tensor) -> torch.Tensor:
            estimated.append(len(photo))
            return torch.rand(photo.shape[:2])

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "load_depth_anything", Estimator)
    monkeypatch.setattr(pipeline, "_estimate_poses", lambda *_: None)
    monkeypatch.setattr(pipeline, "train", stop)
    depth_folder.mkdir()
    Image.new("I;16", (48, 32)).save(depth_folder / "p00.png")
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            pipeline.run(output / "scene/images", output)
        assert len(estimated) == 2
    (depth_folder / "p01.png").unlink()
    write_config(output / "config.yaml", RunConfig(output / "scene"))
    with pytest.raises(KeyboardInterrupt):
        pipeline.run(output / "scene/images", output)
    assert len(estimated) == 2


def test_pages_of_a_run_have_its_name(make_scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make_scene(3)
    output = tmp_path / "my-landmark"
    output.mkdir()
    root.rename(output / "scene")
    written: list[tuple[Any, ...]] = []
    monkeypatch.setattr(pipeline, "estimate_depth", lambda *_, **__: None)
    monkeypatch.setattr(pipeline, "load_depth_anything", lambda: None)
    monkeypatch.setattr(pipeline, "_estimate_poses", lambda *_: None)
    monkeypatch.setattr(pipeline, "train", lambda *_, **__: SimpleNamespace(steps=7, appearances={}))
    monkeypatch.setattr(pipeline, "load_run", lambda folder: folder)
    monkeypatch.setattr(pipeline, "LoadedScene", lambda *_: None)
    monkeypatch.setattr(pipeline, "evaluate", lambda *_, **__: {})
    monkeypatch.setattr(pipeline, "write_showcase", lambda *arguments: written.append(arguments[:3]))
    monkeypatch.setattr(pipeline, "write_scene_page", lambda *arguments: written.append(arguments[1:3]))
    photos = output / "scene/images"
    pipeline.run(photos, output)
    assert written == [
        (output / "report.html", "my-landmark", "3 photos from images, 7 steps of Wild-GS."),
        (output / "scene.html", "my-landmark"),
    ]
