"""Feeds damaged files to every reader, in a child process that may neither crash, hang, nor take much memory.

Each round takes a valid file, damages it (bits, numbers, cuts, insertions, repetitions) and reads it. Right are a
result, a `UserError`, or a reader's own exception for unreadable files; anything else is a finding, and so are a
killed child, a round of more than `--seconds`, and memory beyond `--megabytes`.

Example: python benchmarks/fuzz.py --minutes 10
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import random
import resource
import shutil
import signal
import struct
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import tyro


@dataclass(frozen=True)
class Command:
    """Fuzzes."""

    minutes: float = 10.0
    """CPU time over all readers."""
    reader: str = "all"
    """One of the readers, or `pycolmap` to see how COLMAP's own does with the same files."""
    seed: int = 0
    """Of the damage."""
    seconds: float = 20.0
    """CPU time after which a round counts as a hang."""
    megabytes: int = 1500
    """Address space that a child may take beyond its start."""
    findings: Path = Path("fuzz-findings")
    """Where files that broke a reader are kept."""


@dataclass(frozen=True)
class Reader:
    """What is fuzzed.

    Attributes:
        seeds: Writes valid files into a folder; gives the names of those that are damaged.
        read: Reads the folder.
    """

    seeds: Callable[[Path], list[str]]
    read: Callable[[Path], object]


def _model(folder: Path, kind: str) -> list[str]:
    """A small model whose tracks agree with its images, or COLMAP would refuse it undamaged."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3)) + [0, 0, 4]
    names = ["a.png", "sub/b c.png", "ü.png"]
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "txt":
        cameras = "# x\n1 PINHOLE 24 16 20 20 12 8\n2 OPENCV 24 16 20 20 12 8 0.1 0 0 0\n"
        images = "".join(
            f"{i + 1} 1 0 0 0 0.{i} 0 0 {1 + i % 2} {n}\n"
            + " ".join(f"{k}.5 2.0 {k if i < 2 else -1}" for k in range(len(points)))
            + "\n"
            for i, n in enumerate(names)
        )
        rows = "".join(f"{i} {x} {y} {z} 9 8 7 0.5 1 {i} 2 {i}\n" for i, (x, y, z) in enumerate(points))
        content = [cameras.encode(), images.encode(), rows.encode()]
    else:
        cameras = struct.pack("<QIiQQ4d", 2, 1, 1, 24, 16, 20, 20, 12, 8)
        cameras += struct.pack("<IiQQ8d", 2, 4, 24, 16, 20, 20, 12, 8, 0.1, 0, 0, 0)
        images = struct.pack("<Q", len(names))
        for index, name in enumerate(names):
            images += struct.pack("<I7dI", index + 1, 1, 0, 0, 0, 0.1 * index, 0, 0, 1 + index % 2)
            images += name.encode() + b"\0" + struct.pack("<Q", len(points))
            for k in range(len(points)):
                images += struct.pack("<2dQ", k + 0.5, 2.0, k if index < 2 else 2**64 - 1)
        rows = struct.pack("<Q", len(points))
        for index, point in enumerate(points):
            rows += struct.pack("<Q3d3Bd", index, *point, 9, 8, 7, 0.5)
            rows += struct.pack("<QIIII", 2, 1, index, 2, index)
        content = [cameras, images, rows]
    files = [f"{name}.{kind}" for name in ("cameras", "images", "points3D")]
    for name, data in zip(files, content, strict=True):
        (folder / name).write_bytes(data)
    return files


def _scene(kind: str) -> Callable[[Path], list[str]]:
    def write(folder: Path) -> list[str]:
        (folder / "images").mkdir()
        return [f"sparse/0/{name}" for name in _model(folder / "sparse" / "0", kind)]

    return write


def _read_scene(folder: Path) -> object:
    from wildgs.scene import DataConfig
    from wildgs.scene.colmap import read_model
    from wildgs.scene.undistort import PixelGrid

    model = read_model(folder)
    limit = DataConfig().max_image_pixels
    for image in model.images:
        if image.camera.width * image.camera.height <= limit and not image.camera.is_spherical():
            PixelGrid.from_colmap(image.camera, 2)
    return model


def _read_pycolmap(folder: Path) -> object:
    import pycolmap

    return pycolmap.Reconstruction(folder / "sparse" / "0")


def _exif(folder: Path) -> list[str]:
    from PIL import Image

    photo = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    exif = photo.getexif()
    exif[0x010F], exif[0x0110] = "Canon", "Canon EOS 5D"
    camera, gps = exif.get_ifd(0x8769), exif.get_ifd(0x8825)
    camera[0xA405], camera[0x920A], camera[0xA20E], camera[0xA210] = 35, 24.0, 3000.0, 2
    gps[1], gps[2], gps[3], gps[4], gps[6] = "N", (48.0, 53.0, 12.0), "E", (2.0, 20.0, 35.0), 130.0
    gps[7], gps[29] = (17.0, 30.0, 0.0), "2019:07:01"
    camera[0x9003], camera[0x9011] = "2019:07:01 19:30:00", "+02:00"
    photo.save(folder / "photo.jpg", exif=exif)
    return ["photo.jpg"]


def _infer_camera(folder: Path) -> object:
    """As `wildgs sfm` does: COLMAP gets what Pillow could read."""
    import pycolmap

    from wildgs.scene.images import read_photo

    _tolerate(
        lambda: read_photo(folder / "photo.jpg") and pycolmap.infer_camera_from_image(folder / "photo.jpg")
    )


def _pictures(folder: Path) -> list[str]:
    from PIL import Image

    rng = np.random.default_rng(0)
    colours = Image.fromarray(rng.integers(0, 255, (16, 24, 3), dtype=np.uint8))
    files = []
    for ending in ("jpg", "png", "tif", "webp", "bmp", "gif", "ppm", "jp2"):
        exif = colours.getexif()
        exif[0x0112] = 6
        extra: dict[str, Any] = {"exif": exif} if ending in ("jpg", "png", "webp") else {}
        colours.save(folder / f"photo.{ending}", **extra)
        files.append(f"photo.{ending}")
    Image.fromarray(rng.integers(0, 65535, (16, 24), dtype=np.uint16)).save(folder / "deep.png")
    depth = Image.fromarray(rng.random((16, 24), dtype=np.float32))
    depth.save(folder / "float.tif")
    depth.save(folder / "depth.tiff", compression="tiff_deflate")
    colours.convert("RGBA").save(folder / "alpha.png")
    return [*files, "deep.png", "float.tif", "depth.tiff", "alpha.png"]


def _read_pictures(folder: Path) -> object:
    from wildgs.scene.images import read_depth, read_disparity, read_mask, read_photo

    limit = 10_000_000
    for path in folder.iterdir():
        for read in (
            lambda path: read_photo(path, size=(12, 8), max_pixels=limit),
            lambda path: read_mask(path, (12, 8), limit),
            lambda path: read_disparity(path, (12, 8), limit),
            lambda path: read_depth(path, (12, 8), limit),
        ):
            _tolerate(lambda read=read, path=path: read(path))
    return None


def _tolerate(action: Callable[[], object]) -> None:
    from wildgs.scene.images import UnreadableImageError

    with contextlib.suppress(UnreadableImageError):
        action()


def _split(folder: Path) -> list[str]:
    rows = [f"p{i}.png\t{i}.0\t{'test' if i % 3 == 0 else 'train'}\tx\n" for i in range(9)]
    (folder / "split.tsv").write_text("filename\tid\tsplit\tdataset\n" + "".join(rows))
    return ["split.tsv"]


def _read_split(folder: Path) -> object:
    from wildgs.scene.split import assign_splits

    return assign_splits([f"p{i}.png" for i in range(9)], folder, 8)


def _config(folder: Path) -> list[str]:
    from wildgs.config import RunConfig
    from wildgs.config_file import write_config

    write_config(folder / "config.yaml", RunConfig(Path("scene")))
    return ["config.yaml"]


def _read_config(folder: Path) -> object:
    from wildgs.config_file import read_config

    return read_config(folder / "config.yaml")


def _checkpoints(folder: Path) -> list[str]:
    import torch

    from wildgs.engine.checkpoint import save_checkpoint

    for step in (1, 2):
        save_checkpoint(folder, step, {"x": torch.rand(5, 3), "step": torch.tensor(step)}, {"a": [1, "ü"]})
    return ["step_00000002.safetensors"]


def _read_checkpoints(folder: Path) -> object:
    from wildgs.engine.checkpoint import load_newest

    newest = load_newest(folder)
    assert newest is not None
    assert int(newest.state["step"]) in (1, 2)
    return newest


@functools.cache
def _method() -> Any:
    import torch

    from wildgs.model.encoder import load_encoder
    from wildgs.model.wildgs import WildGS, WildGSConfig
    from wildgs.model.wrapping import WrappingConfig

    torch.manual_seed(0)
    config = WildGSConfig(wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)))
    colors = torch.full((30, 3), 128, dtype=torch.uint8)
    return WildGS.from_points(config, torch.rand(30, 3), colors, encoder=load_encoder(None)).eval()


def _appearance(folder: Path) -> list[str]:
    import torch

    from wildgs.geometry.camera import Camera
    from wildgs.light.look import look_of
    from wildgs.light.saved import save_look

    camera = Camera(torch.eye(4), 30 * torch.eye(3), 48, 32)
    look = look_of(_method(), _method().encode(torch.rand(32, 48, 3), camera), "evening")
    save_look(look, folder / "evening.safetensors")
    return ["evening.safetensors"]


def _read_appearance(folder: Path) -> object:
    from wildgs.light.saved import load_look

    return load_look(_method(), folder / "evening.safetensors")


def _cameras(folder: Path) -> list[str]:
    pose = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]"
    ours = f'{{"viewmat": {pose}, "K": [[30, 0, 24], [0, 30, 16], [0, 0, 1]], "width": 48, "height": 32}}'
    (folder / "ours.json").write_text(f'{{"frame": "scene", "fps": 24, "cameras": [{ours}, {ours}]}}')
    theirs = f'{{"camera_to_world": {pose}, "fov": 50, "aspect": 1.5}}'
    size = '"render_width": 48, "render_height": 32, "fps": 24'
    (folder / "theirs.json").write_text(
        f'{{{size}, "camera_type": "perspective", "camera_path": [{theirs}]}}'
    )
    (folder / "dataparser_transforms.json").write_text(
        '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]], "scale": 0.5}'
    )
    return ["ours.json", "theirs.json", "dataparser_transforms.json"]


def _read_cameras(folder: Path) -> object:
    from wildgs.geometry.camera_file import read_camera_path

    return read_camera_path(folder / "ours.json"), read_camera_path(folder / "theirs.json")


def _carried(folder: Path) -> list[str]:
    """What a run folder carries of its scene."""
    import torch

    from wildgs.geometry.camera import Camera
    from wildgs.scene.carried import SCENE_FILE, carry_scene
    from wildgs.scene.images import Photo
    from wildgs.scene.photo_store import PhotoStore
    from wildgs.scene.scene import Alignment, Scene, View

    class Store(PhotoStore):
        def get(self, name: str) -> Photo:
            pixels = np.random.default_rng(len(name)).integers(0, 255, (32, 48, 3), dtype=np.uint8)
            return Photo(pixels, np.eye(32, 48, dtype=np.uint8) * 255)

    camera = Camera(torch.eye(4), torch.tensor([[30.0, 0, 24], [0, 30, 16], [0, 0, 1]]), 48, 32)
    views = tuple(View(name, camera, "train", Store()) for name in ("a.jpg", "ü b.jpg"))
    colors = torch.full((9, 3), 128, dtype=torch.uint8)
    carry_scene(folder, Scene(folder, views, torch.rand(9, 3), colors, Alignment.identity()))
    return [SCENE_FILE, *(f"lights/{path.name}" for path in (folder / "lights").iterdir())]


def _read_carried(folder: Path) -> object:
    from wildgs.scene.carried import read_carried_scene

    scene = read_carried_scene(folder)
    assert scene is not None
    return [(view.read_photo(), view.read_mask()) for view in scene.views]


def _read_exif(folder: Path) -> object:
    """As `wildgs sfm`, the viewer's uploads, `load_scene` and the order of a day read photos."""
    from wildgs.light.sun import phases_of
    from wildgs.scene.capture import read_capture
    from wildgs.scene.images import read_photo
    from wildgs.sfm.upright import copy_upright

    _tolerate(lambda: read_photo(folder / "photo.jpg", max_pixels=10_000_000))
    capture = read_capture(folder / "photo.jpg")
    if capture is not None:  # alone, and beside a photo that tells the place
        placed = replace(capture, place=(48.0, 2.0))
        for captures in ({"photo": capture}, {"photo": capture, "other": placed}):
            assert np.isfinite(list(phases_of(captures).values())).all()
    (folder / "p").mkdir(exist_ok=True)
    shutil.copyfile(folder / "photo.jpg", folder / "p" / "photo.jpg")
    return copy_upright(folder / "p", folder / "copies", folder / "masks", max_pixels=10_000_000)


def _names(folder: Path) -> list[str]:
    (folder / "names").write_bytes("a.jpg\nü b.png\n2023-07-14 18:22:31.jpg\nsub/c.heic\nphoto".encode())
    return ["names"]


def _read_names(folder: Path) -> object:
    """Names that a disk may hold become names that a model can hold."""
    import os

    from wildgs.files import printable
    from wildgs.sfm.upright import scene_names

    lines = (folder / "names").read_bytes().replace(b"\0", b"").split(b"\n")
    paths = [Path(os.fsdecode(line[:4000])) for line in lines]
    names = [
        path.as_posix()
        for path in paths
        # As `list_photos` finds them: no hidden files.
        if path.name and not path.is_absolute() and not any(part.startswith(".") for part in path.parts)
    ]
    for name in names:
        printable(name).encode()
    safe = scene_names(names)
    assert len(set(safe)) == len(names)
    for name in safe:
        assert max(len(part.encode()) for part in name.split("/")) <= 255
    return safe


def _messages(folder: Path) -> list[str]:
    import msgspec

    camera = {"wxyz": [1, 0, 0, 0], "position": [0.5, 1, 2], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
    camera |= {"fov": 0.8, "near": 0.01, "far": 1000, "image_height": 700, "image_width": 1000}
    part = {"source_component_uuid": "button", "transfer_uuid": "t"}
    start = part | {"filename": "a.png", "mime_type": "image/png", "part_count": 2, "size_bytes": 8}
    messages = {
        "camera": {"type": "ViewerCameraMessage", **camera},
        "update": {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"value": 0.5}},
        "start": {"type": "FileTransferStartUpload", **start},
        "part": {"type": "FileTransferPart", **part, "part_index": 0, "content": b"abcd"},
    }
    for name, message in messages.items():
        (folder / name).write_bytes(msgspec.msgpack.encode(message))
    return list(messages)


class _Silent:
    """Replies to uploads that nobody hears."""

    def progress(self, connection: object, upload: object, received: int) -> None:
        pass

    def failed(self, connection: object, upload: object, reason: str) -> None:
        pass


def _read_messages(folder: Path) -> object:
    from wildgs.viewer.access import MalformedMessageError, decode, is_acceptable
    from wildgs.viewer.uploads import Uploads

    uploads = Uploads(_Silent())
    uploads.receive("button", lambda name, content: None)
    with contextlib.suppress(MalformedMessageError):
        for name in ("camera", "update", "start", "part"):
            message = decode((folder / name).read_bytes())
            if message["type"] == "FileTransferStartUpload":
                uploads.start("browser", message)
            elif message["type"] == "FileTransferPart":
                uploads.part("browser", message)
            else:
                is_acceptable(message, {}.get)
    uploads.close()


READERS = {
    "EXIF": Reader(_exif, _read_exif),
    "names": Reader(_names, _read_names),
    "viewer messages": Reader(_messages, _read_messages),
    "COLMAP binary": Reader(_scene("bin"), _read_scene),
    "COLMAP text": Reader(_scene("txt"), _read_scene),
    "pictures": Reader(_pictures, _read_pictures),
    "split": Reader(_split, _read_split),
    "config": Reader(_config, _read_config),
    "checkpoints": Reader(_checkpoints, _read_checkpoints),
    "appearance": Reader(_appearance, _read_appearance),
    "camera files": Reader(_cameras, _read_cameras),
    "carried scene": Reader(_carried, _read_carried),
}
PYCOLMAP = {
    "pycolmap binary": Reader(_scene("bin"), _read_pycolmap),
    "pycolmap text": Reader(_scene("txt"), _read_pycolmap),
    "pycolmap EXIF": Reader(_exif, _infer_camera),
}
_NUMBERS = [0, 1, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1, 10**6, 10**9]
_TOKENS = [
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"99999999999999999999",
    b"",
    b"\t",
    b"\n",
    b"*a",
    b"&a",
    b"!!python/none",
]


def damage(content: bytes, rng: random.Random) -> bytes:
    """A file with one to six faults."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 6)):
        place = rng.randrange(len(data) + 1)
        match rng.randrange(8):
            case 0 if data:
                data[place % len(data)] ^= 1 << rng.randrange(8)
            case 1:
                del data[place:]
            case 2:
                data[place : place + rng.randint(1, 8)] = rng.randbytes(rng.randint(0, 8))
            case 3:
                data[place : place + 8] = struct.pack("<Q", rng.choice(_NUMBERS))
            case 4:
                data[place : place + 4] = struct.pack("<I", rng.choice(_NUMBERS) % 2**32)
            case 5:
                data[place:place] = data[place : place + rng.randint(1, 64)] * rng.randint(1, 20)
            case 6:
                data[place : place + rng.randint(0, 6)] = rng.choice(_TOKENS)
            case 7:
                values = [float("nan"), float("inf"), 1e300, -1e300, 0.0]
                data[place : place + 8] = struct.pack("<d", rng.choice(values))
    return bytes(data)


def _work(name: str, folder: Path, command: Command, pipe: Connection, seed: int) -> None:
    """Rounds until told to stop; says before each what it is about to read."""
    from wildgs.errors import UserError

    warnings.simplefilter("ignore")
    reader = (READERS | PYCOLMAP)[name]
    pristine, files = folder / "pristine", []
    shutil.rmtree(pristine, ignore_errors=True)
    pristine.mkdir()
    files = reader.seeds(pristine)
    reader.read(pristine)  # everything is imported and valid files are read, before memory is limited
    contents = {file: (pristine / file).read_bytes() for file in files}
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + command.megabytes * 2**20,) * 2)
    rng = random.Random(seed)
    while True:
        file = rng.choice(files)
        (pristine / file).write_bytes(damage(contents[file], rng))
        pipe.send(("start", file))
        signal.setitimer(signal.ITIMER_PROF, command.seconds)
        try:
            reader.read(pristine)
            outcome = "read"
        except UserError:
            outcome = "refused"
        except Exception as error:
            refused = name in PYCOLMAP and not isinstance(error, MemoryError)
            outcome = "refused" if refused else f"{type(error).__name__}: {str(error)[:100]}"
        signal.setitimer(signal.ITIMER_PROF, 0)
        if outcome not in ("read", "refused"):
            shutil.copyfile(pristine / file, folder / "found")
        pipe.send(("done", outcome))
        (pristine / file).write_bytes(contents[file])


def fuzz(name: str, command: Command, cpu_seconds: float) -> tuple[Counter[str], float]:
    """Counts of outcomes, and CPU seconds spent in children."""
    counts: Counter[str] = Counter()
    spent, seed = 0.0, command.seed
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        while spent < cpu_seconds:
            here, there = multiprocessing.Pipe()
            child = multiprocessing.Process(
                target=_work, args=(name, folder, command, there, seed), daemon=True
            )
            child.start()
            there.close()
            spent += _listen(name, child, here, folder, counts, cpu_seconds - spent, command)
            seed += 1
    return counts, spent


def _listen(
    name: str,
    child: multiprocessing.Process,
    pipe: Connection,
    folder: Path,
    counts: Counter[str],
    cpu_seconds: float,
    command: Command,
) -> float:
    """Counts what a child says until its time is up or it dies; its CPU seconds."""
    cpu, file = 0.0, ""
    while True:
        try:
            kind, text = pipe.recv()
        except EOFError:
            child.join()
            if child.exitcode == 0 or not file:
                raise SystemExit(f"{name}: the child could not begin") from None
            outcome = (
                "hang" if child.exitcode == -signal.SIGPROF else f"killed by signal {-(child.exitcode or 0)}"
            )
            _keep(name, folder, file, outcome, counts, command)
            return cpu
        cpu = max(cpu, _cpu_seconds(child.pid))
        if kind == "start":
            file = text
        elif text in ("read", "refused"):
            counts[text] += 1
        else:
            _keep(name, folder, file, text, counts, command)
        if cpu >= cpu_seconds and kind == "done":
            child.kill()
            child.join()
            return cpu


def _keep(name: str, folder: Path, file: str, outcome: str, counts: Counter[str], command: Command) -> None:
    """Counts a finding; keeps the first file of each kind."""
    counts[outcome] += 1
    if counts[outcome] == 1:
        command.findings.mkdir(parents=True, exist_ok=True)
        found = folder / "found"
        source = found if found.is_file() else folder / "pristine" / file  # of a child that was killed
        shutil.copyfile(source, command.findings / f"{name} {len(counts)} {Path(file).name}")
        found.unlink(missing_ok=True)


def _cpu_seconds(pid: int | None) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100
    except OSError:
        return 0.0


def main(command: Command) -> int:
    if command.reader == "all":
        chosen = READERS
    elif command.reader == "pycolmap":
        chosen = PYCOLMAP
    else:
        chosen = {command.reader: READERS[command.reader]}
    findings, start = 0, time.monotonic()
    for name in chosen:
        counts, spent = fuzz(name, command, 60 * command.minutes / len(chosen))
        bad = {outcome: count for outcome, count in counts.items() if outcome not in ("read", "refused")}
        findings += sum(bad.values())
        rounds = sum(counts.values())
        print(
            f"{name}: {rounds:,} files in {spent:.0f} CPU seconds: {counts['read']:,} read, "
            f"{counts['refused']:,} refused, {sum(bad.values())} findings",
            flush=True,
        )
        for outcome, count in sorted(bad.items(), key=lambda item: -item[1]):
            print(f"    {count} x {outcome}", flush=True)
    print(f"{findings} findings in {time.monotonic() - start:.0f} s")
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Command)))
