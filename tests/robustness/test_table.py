"""Every input with every fault does what docs/robustness.md says."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from wildgs.config import RunConfig
from wildgs.config_file import write_config
from wildgs.engine import checkpoint as checkpoint_module
from wildgs.engine.checkpoint import load_checkpoint
from wildgs.errors import UserError, WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.geometry.camera_file import read_camera_path, write_camera_path
from wildgs.light.look import look_of
from wildgs.light.saved import load_look, save_look
from wildgs.model.encoder import load_encoder
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.model.wrapping import WrappingConfig
from wildgs.runs import load_run, save_run, start_training
from wildgs.scene import DataConfig, load_scene


def _sibling(name: str):
    """A module beside this file: tests are no package."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


table = _sibling("table")
PHOTO = "p02.png"
DOCS = Path(__file__).parents[2] / "docs" / "robustness.md"
EXISTING = [(i, f) for i, cells in table.TABLE.items() for f in table.FAULTS if cells[f] is not None]


def test_the_documents_table_is_this_one() -> None:
    assert table.markdown() in DOCS.read_text(encoding="utf-8")


def picture(path: Path, pixels: np.ndarray, kind: str = "PNG") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, format=kind)


def huge_png() -> bytes:
    """A picture of 200,000 x 200,000 pixels in a hundred bytes."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 2, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(b"\0" * 100))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


def spoil_file(path: Path, fault: str) -> bool:
    """Faults that are the same for every file; whether this was one."""
    content = path.read_bytes() if path.is_file() else b""
    if fault == "missing":
        path.unlink()
    elif fault == "empty":
        path.write_bytes(b"")
    elif fault == "truncated":
        path.write_bytes(content[: int(0.7 * len(content))])
    elif fault == "wrong type":
        path.write_bytes(b"\x80\x04\x95 this is no such file \xff\xfe\n" * 3)
    elif fault == "link loop":
        path.unlink()
        path.symlink_to(path)
    elif fault in ("read-only", "full disk"):
        for folder, _, _ in os.walk(path.parents[1]):
            Path(folder).chmod(0o555)
    else:
        return False
    return True


def spoil_picture(path: Path, fault: str, channels: int) -> None:
    shape = (16, 24, 3) if channels == 3 else (16, 24)
    if fault in ("duplicate", "names"):
        picture(path, np.full(shape, 90, np.uint8))
        return
    if not path.is_file():
        picture(path, np.random.default_rng(0).integers(1, 255, shape, dtype=np.uint8))
    if spoil_file(path, fault):
        return
    if fault == "wrong size":
        picture(path, np.full((16, 40, *shape[2:]), 90, np.uint8))
    elif fault == "NaN":
        values = np.full((16, 24), 0.5, np.float32)
        values[3:5] = [[np.nan], [np.inf]]
        picture(path, values, "TIFF")
    elif fault == "huge":
        path.write_bytes(huge_png())


def rename_photo(root: Path, model) -> None:
    """To a name of blanks, letters of many alphabets and a byte that is no UTF-8; the model is not written."""
    model.names[2] = "Fotos ü 写真/p\udcff 2.png".encode(errors="surrogateescape")
    spoil_picture(root / "images" / os.fsdecode(model.names[2]), "names", 3)


def spoil_photo(root: Path, fault: str, model) -> None:
    if fault == "names":
        rename_photo(root, model)
        model.write_binary(root / "sparse/0")
    elif fault == "duplicate":
        first, second = root / "images/p01.png", root / "images" / PHOTO
        second.write_bytes(first.read_bytes())
    else:
        spoil_picture(root / "images" / PHOTO, fault, 3)


def spoil_model(root: Path, fault: str, model, ending: str) -> None:
    folder = root / "sparse/0"
    write = model.write_text if ending == "txt" else model.write_binary
    for path in folder.iterdir():
        path.unlink()
    changes: dict[str, Callable[[], None]] = {
        "wrong size": lambda: setattr(model, "size", (0, 16)),
        "NaN": lambda: (
            model.poses.__setitem__(2, (1, 0, 0, 0, float("nan"), 0, 0)),
            model.points.__setitem__((3, 1), np.inf),
        ),
        "duplicate": lambda: model.names.__setitem__(2, b"p01.png"),
        "names": lambda: None,
    }
    if fault in changes:
        changes[fault]()
    write(folder)
    if fault == "huge":
        if ending == "txt":
            (folder / "points3D.txt").write_text("1 1 2 3 999999999999999999999999 0 0 0.1\n")
        else:
            path = folder / "points3D.bin"
            path.write_bytes(struct.pack("<Q", 2**61) + path.read_bytes()[8:])
    elif fault == "names":
        rename_photo(root, model)
        write(folder)
    elif fault not in changes:
        spoil_file(folder / f"images.{ending}", fault)


def spoil_split(root: Path, fault: str, model) -> None:
    path = root / "split.tsv"
    rows = [f"p{i:02d}.png\t{i}.0\t{'test' if i == 0 else 'train'}\tx\n" for i in range(6)]
    head = "filename\tid\tsplit\tdataset\n"
    special = {
        "wrong size": head + "".join(row.rstrip("\n") + "\tmore\tand more\n" for row in rows),
        "NaN": head + "".join(row.replace("2.0", "nan") for row in rows),
        "huge": head + "a" * 200_000 + "\t1\ttrain\tx\n",
        "duplicate": head + "".join(rows) + "p01.png\t9\ttest\tx\n",
        "names": "\ufeff" + head + "".join(rows) + "Fotos ü/写真.png\t\ttrain\tx\n",
        "truncated": head + "".join(rows[:3]) + "p03.png\t3.0\ttr",
    }
    path.write_text(special.get(fault, head + "".join(rows)), encoding="utf-8")
    if fault not in special:
        spoil_file(path, fault)


def spoil_mask(root: Path, fault: str, model) -> None:
    if fault == "names":
        spoil_photo(root, fault, model)
        name = os.fsdecode(model.names[2])
        spoil_picture(root / "masks" / f"{name}.png", fault, 1)
        return
    spoil_picture(root / "masks" / PHOTO, fault, 1)
    if fault == "duplicate":
        picture(root / "masks" / f"{PHOTO}.png", np.eye(16, 24, dtype=np.uint8))


def spoil_depth(root: Path, fault: str, model) -> None:
    if fault == "names":
        spoil_photo(root, fault, model)
        spoil_picture((root / "depth" / os.fsdecode(model.names[2])).with_suffix(".png"), fault, 1)
    else:
        spoil_picture(root / "depth" / PHOTO, fault, 1)


SCENE_INPUTS = {
    "photo": spoil_photo,
    "COLMAP binary": lambda root, fault, model: spoil_model(root, fault, model, "bin"),
    "COLMAP text": lambda root, fault, model: spoil_model(root, fault, model, "txt"),
    "split .tsv": spoil_split,
    "mask": spoil_mask,
    "depth": spoil_depth,
}


def observe(action: Callable[[], object]) -> tuple[str, str]:
    """The kind of the outcome and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            action()
        except UserError as error:
            return "error", str(error)
    others = [str(w.message) for w in caught if not issubclass(w.category, WildGSWarning)]
    assert not others
    said = "\n".join(str(w.message) for w in caught)
    return ("left out" if said else "used"), said


@pytest.mark.parametrize(("name", "fault"), [cell for cell in EXISTING if cell[0] in SCENE_INPUTS])
def test_scenes(name: str, fault: str, scene: Path, make_model) -> None:
    kind, pattern, _ = table.TABLE[name][fault]
    SCENE_INPUTS[name](scene, fault, make_model())
    before = sorted(map(str, scene.rglob("*")))
    views: list = []

    def read() -> None:
        loaded = load_scene(scene, DataConfig(holdout=0))
        views.extend(loaded.views)
        assert torch.isfinite(loaded.points).all()
        for view in views:
            view.read_disparity()

    found, said = observe(read)
    assert (found, bool(re.search(pattern, said))) == (kind, True), said
    assert sorted(map(str, scene.rglob("*"))) == before
    if kind == "used":
        assert len(views) == 6
    if kind == "left out":
        assert len(views) == (6 if name == "depth" else 5)


def test_points_that_no_photo_observes_make_a_scene_all_the_same(scene: Path, make_model) -> None:
    """Found by benchmarks/fuzz.py; other programs write such models too."""
    spoil_model(scene, "names", make_model(), "txt")
    path = scene / "sparse/0/points3D.txt"
    path.write_text("".join(f"{i} {0.1 * i} 0.2 4 9 8 7 0.5\n" for i in range(1, 9)))
    loaded = load_scene(scene, DataConfig(holdout=0))
    assert len(loaded.views) == 6
    assert len(loaded.points) == 8


def test_a_text_cut_between_two_lines_is_noticed_by_its_comment(scene: Path, make_model) -> None:
    spoil_model(scene, "names", make_model(), "txt")
    path = scene / "sparse/0/images.txt"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:9]))
    kind, said = observe(lambda: load_scene(scene, DataConfig(holdout=0)))
    assert kind == "left out"
    assert "its comment declares 6 entries, but it has 4" in said


@pytest.fixture
def run(scene: Path, tmp_path: Path) -> Path:
    """A run with two checkpoints."""
    folder = tmp_path / "a run ü"
    config = RunConfig(scene, "3dgs")
    loaded = load_scene(scene)
    trainer = start_training(folder, config, loaded)
    for trainer.step in (1, 2):
        save_run(folder, trainer, config, loaded.alignment)
    return folder


def fail_with(error: OSError) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


WRITE_ERRORS = {
    "read-only": PermissionError(13, "Permission denied"),
    "full disk": OSError(28, "No space left on device"),
}


@pytest.mark.parametrize("fault", [f for i, f in EXISTING if i == "checkpoint"])
def test_checkpoints(fault: str, run: Path, monkeypatch) -> None:
    kind, pattern, _ = table.TABLE["checkpoint"][fault]
    older, newest = sorted((run / "checkpoints").iterdir())
    loaded = load_run(run)
    state = {f"method.{name}": value for name, value in loaded.method.state_dict().items()}

    def act() -> None:
        assert load_run(run).step in (1, 2)

    if fault == "missing":
        older.unlink()
        newest.unlink()
    elif fault == "wrong size":
        means = {"method.gaussians.rows.means": torch.zeros(3, 7)}
        checkpoint_module.save_checkpoint(newest.parent, 2, state | means, {})
    elif fault == "NaN":
        means = {"method.gaussians.rows.means": torch.full((30, 3), float("nan"))}
        progress = {"progress.step": torch.tensor(2), "progress.seconds": torch.tensor(0.0)}
        header = load_checkpoint(newest).header
        checkpoint_module.save_checkpoint(newest.parent, 2, state | means | progress, header)
    elif fault == "huge":
        newest.write_bytes(struct.pack("<Q", 2**60) + newest.read_bytes()[8:])
    elif fault in WRITE_ERRORS:
        monkeypatch.setattr(checkpoint_module, "save_file", fail_with(WRITE_ERRORS[fault]))

        def act() -> None:
            checkpoint_module.save_checkpoint(run / "checkpoints", 3, state, {})
    elif fault != "names":
        spoil_file(newest, fault)
    found, said = observe(act)
    assert (found, bool(re.search(pattern, said))) == (kind, True), said
    if fault in WRITE_ERRORS:
        assert sorted((run / "checkpoints").iterdir()) == [older, newest]


@pytest.mark.parametrize("fault", [f for i, f in EXISTING if i == "config.yaml"])
def test_configurations(fault: str, run: Path, monkeypatch) -> None:
    kind, pattern, _ = table.TABLE["config.yaml"][fault]
    path = run / "config.yaml"
    plain = yaml.safe_load(path.read_text())

    def act() -> None:
        load_run(run)

    if fault == "wrong size":
        plain["train"]["more"] = 1
        path.write_text(yaml.safe_dump(plain))
    elif fault == "NaN":
        plain["train"]["steps"] = float("nan")
        path.write_text(yaml.safe_dump(plain))
    elif fault == "huge":
        lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
        lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
        path.write_text("\n".join([*lines, "train: {steps: *a11}", "method: *a11"]))
    elif fault == "duplicate":
        path.write_text(path.read_text() + f"\nmethod: {plain['method']}\n")
    elif fault in WRITE_ERRORS:
        monkeypatch.setattr(Path, "open", fail_with(WRITE_ERRORS[fault]))

        def act() -> None:
            write_config(path, RunConfig(Path("scene")))
    elif fault != "names":
        spoil_file(path, fault)
    found, said = observe(act)
    assert (found, bool(re.search(pattern, said))) == (kind, True), said[:500]
    assert len(said) < 2000


@pytest.fixture(scope="module")
def method() -> WildGS:
    torch.manual_seed(0)
    config = WildGSConfig(wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)))
    colors = torch.full((30, 3), 128, dtype=torch.uint8)
    return WildGS.from_points(config, torch.rand(30, 3), colors, encoder=load_encoder(None)).eval()


@pytest.mark.parametrize("fault", [f for i, f in EXISTING if i == "appearance"])
def test_appearances(fault: str, method: WildGS, tmp_path: Path, monkeypatch) -> None:
    kind, pattern, _ = table.TABLE["appearance"][fault]
    appearance = method.encode(torch.rand(32, 48, 3), Camera(torch.eye(4), 30 * torch.eye(3), 48, 32))
    look = look_of(method, appearance, "evening")
    file = save_look(look, tmp_path / ("ü 写真 2.safetensors" if fault == "names" else "evening.safetensors"))
    tensors = load_file(file)
    with safe_open(file, framework="pt") as opened:
        metadata = opened.metadata()

    def act() -> None:
        assert load_look(method, file).name == "evening"

    if fault == "wrong size":
        save_file(tensors | {"shared_local": torch.zeros(7)}, file, metadata=metadata)
    elif fault == "NaN":
        save_file(tensors | {"global_embedding": torch.full((16,), float("nan"))}, file, metadata=metadata)
    elif fault == "huge":
        file.write_bytes(struct.pack("<Q", 2**60) + file.read_bytes()[8:])
    elif fault in WRITE_ERRORS:
        monkeypatch.setattr(Path, "write_bytes", fail_with(WRITE_ERRORS[fault]))

        def act() -> None:
            save_look(look, tmp_path / "other.safetensors")
    elif fault != "names":
        spoil_file(file, fault)
    found, said = observe(act)
    assert (found, bool(re.search(pattern, said))) == (kind, True), said


@pytest.mark.parametrize("fault", [f for i, f in EXISTING if i == "camera file"])
def test_camera_files(fault: str, tmp_path: Path, monkeypatch) -> None:
    kind, pattern, _ = table.TABLE["camera file"][fault]
    cameras = [Camera(torch.eye(4), torch.diag(torch.tensor([30.0, 30.0, 1.0])), 48, 32) for _ in range(3)]
    file = tmp_path / ("ü 写真 2.json" if fault == "names" else "path.json")
    write_camera_path(file, cameras, fps=24.0)
    content = json.loads(file.read_text())
    second = content["cameras"][1]

    def act() -> None:
        path = read_camera_path(file)
        assert (len(path.cameras), path.fps) == (4 if fault == "duplicate" else 3, 24)

    changes: dict[str, Callable[[], None]] = {
        "wrong size": lambda: second.__setitem__("viewmat", [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        "NaN": lambda: second["viewmat"][0].__setitem__(3, float("nan")),
        "huge": lambda: second.__setitem__("width", 10**9),
        "duplicate": lambda: content["cameras"].append(second),
    }
    if fault in changes:
        changes[fault]()
        file.write_text(json.dumps(content))
    elif fault in WRITE_ERRORS:
        monkeypatch.setattr(Path, "write_text", fail_with(WRITE_ERRORS[fault]))

        def act() -> None:
            write_camera_path(tmp_path / "other.json", cameras, fps=24.0)
    elif fault != "names":
        spoil_file(file, fault)
    found, said = observe(act)
    assert (found, bool(re.search(pattern, said))) == (kind, True), said
