"""Writes frames to a video file or a folder of PNGs, atomically."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from wildgs.errors import UserError
from wildgs.exporters.outputs import file_suffix, require_folder
from wildgs.files import written_aside

MUXERS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
"""Container formats of ffmpeg by file extension."""

SUFFIXES = tuple(MUXERS)

ENCODING: dict[str, Any] = {
    "codec": "libx264",
    "quality": None,
    "macro_block_size": 2,
    "ffmpeg_log_level": "quiet",
    "output_params": ["-crf", "18", "-movflags", "+faststart"],
}
"""Visually lossless H.264 that all browsers play."""

Frames = Iterable[UInt8[np.ndarray, "H W 3"]]


def is_video(path: Path) -> bool:
    """Whether a path names a video file rather than a folder."""
    return path.suffix.lower() in SUFFIXES


def check_output(path: Path) -> None:
    """Checks an output path before rendering starts.

    Raises:
        UserError: The video format is not supported, imageio-ffmpeg is not installed, or there is a file where a
            folder is needed.
    """
    if is_video(path):
        if path.is_dir():
            raise UserError(f"{path} is a folder; give another name for the video file")
        require_folder(path.parent)
        _ffmpeg()
        return
    if file_suffix(path) is not None:
        supported = ", ".join(SUFFIXES)
        raise UserError(
            f"{path}: unsupported file type; use {supported}, or a name without extension for a folder of PNGs"
        )
    require_folder(path)


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UserError(
            "videos need imageio-ffmpeg (`pip install imageio-ffmpeg`); or set --output to a folder for PNG frames"
        ) from error
    return imageio_ffmpeg


def write_frames(path: Path, frames: Frames, size: tuple[int, int], fps: float) -> None:
    """Writes a video (H.264) or, for a name without extension, a folder of PNGs.

    Args:
        path: Video file or folder.
        frames: Images; an iterator is consumed one image at a time.
        size: Width and height of all frames in pixels; even numbers for a video.
        fps: Frames per second.

    Raises:
        UserError: See `check_output`; or the video cannot be encoded or written.
    """
    check_output(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if is_video(path):
        _write_video(path, frames, size, fps)
    else:
        _write_folder(path, frames)


def _write_video(path: Path, frames: Frames, size: tuple[int, int], fps: float) -> None:
    if size[0] % 2 or size[1] % 2:
        raise UserError(f"{size[0]} x {size[1]}: width and height of a video must be even")
    encoding = ENCODING | {"output_params": [*ENCODING["output_params"], "-f", MUXERS[path.suffix.lower()]]}
    with written_aside(path) as aside:
        writer, sent = _ffmpeg().write_frames(str(aside), size, fps=fps, **encoding), 0
        try:
            writer.send(None)
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
                sent += 1
        except OSError as error:
            raise UserError(f"{path}: the video cannot be encoded: {str(error).splitlines()[0]}") from error
        finally:
            writer.close()
        if _count_frames(aside) != sent:
            raise UserError(f"{path}: ffmpeg could not write the whole video; free disk space and try again")


def _count_frames(video: Path) -> int:
    """Number of frames of a video; 0 if it cannot be read. imageio-ffmpeg does not report ffmpeg's exit code."""
    try:
        return _ffmpeg().count_frames_and_secs(str(video))[0]
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return 0


def _write_folder(path: Path, frames: Frames) -> None:
    with tempfile.TemporaryDirectory(
        dir=path.parent, prefix=f".{path.name}.part.", ignore_cleanup_errors=True
    ) as folder:
        for number, frame in enumerate(frames):
            Image.fromarray(np.ascontiguousarray(frame)).save(Path(folder, f"frame_{number:05d}.png"))
        path.mkdir(exist_ok=True)
        for old in path.glob("frame_*.png"):
            old.unlink()
        for picture in sorted(Path(folder).iterdir()):
            picture.replace(path / picture.name)
