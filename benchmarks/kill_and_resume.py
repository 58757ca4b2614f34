"""Does a training that is killed again and again end in the same bits as one that is left alone?

Trains a tiny landmark once undisturbed, then again with SIGKILL at random moments, part of them inside the writing
of a checkpoint, and with SIGHUP (a closed terminal), continuing with --resume after each. In every second training
nobody reads what is printed: the pipe is closed after the first line. Prints a table and compares SHA-256 over all
tensors.
Methods that are not reproducible from run to run cannot be judged; that is checked first (exit code 3).

Example: python benchmarks/kill_and_resume.py --moments 20
"""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from resized_demo import write_resized_demo
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.model.registry import MethodName

SERVER = multiprocessing.get_context("forkserver")

STAGES = (
    "before writing",
    "half written",
    "written, not flushed",
    "flushed, not renamed",
    "renamed, old ones kept",
)
"""Moments inside the writing of a checkpoint."""

PRELOADED = [
    "wildgs.cli.train",
    "wildgs.library.training",
    "wildgs.rasterize.cpu",
    "torch.utils.tensorboard",
    "transformers",
]
"""Imported once by the server from which trainings are forked: kills are many, and imports slow."""


def _kill_inside(stage: str, saves: int) -> None:
    """Lets this process kill itself at a stage of its n-th checkpoint."""
    from wildgs import files
    from wildgs.engine import checkpoint

    left = saves

    def die_at(name: str) -> None:
        if stage == name and left <= 0:
            os.kill(os.getpid(), signal.SIGKILL)

    save_file, flush, replace = checkpoint.save_file, files._flush, Path.replace

    def saving(tensors: dict[str, Any], path: Path, metadata: dict[str, str]) -> None:
        nonlocal left
        left -= 1
        die_at("before writing")
        save_file(tensors, path, metadata=metadata)
        if stage == "half written" and left <= 0:
            os.truncate(path, path.stat().st_size // 2)
        die_at("half written")
        die_at("written, not flushed")

    def flushing(path: Path) -> None:
        if path.is_dir() and path.name == "checkpoints":
            die_at("renamed, old ones kept")
        flush(path)

    def replacing(self: Path, target: Path) -> Path:
        if self.name.startswith(".step_"):
            die_at("flushed, not renamed")
        return replace(self, target)

    checkpoint.save_file, files._flush = saving, flushing
    Path.replace = replacing  # pyright: ignore[reportAttributeAccessIssue]


def _leave_after_first_line(output: Path) -> None:
    """Puts a pipe in the place of the output, whose reader leaves once training has begun."""
    reader, writer = os.pipe()
    os.dup2(writer, 1)
    os.dup2(writer, 2)
    os.close(writer)

    def read() -> None:
        with os.fdopen(reader, "rb") as pipe, output.open("ab") as copy:
            for line in pipe:
                copy.write(line)
                copy.flush()
                if b"training " in line:
                    return

    threading.Thread(target=read, daemon=True).start()


def _child(arguments: list[str], output: Path, stage: str | None, unread: bool) -> None:
    """One training: its output goes to a file, or to a pipe that closes; and it may kill itself."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored under nohup, which a training respects
    handle = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    if unread:
        _leave_after_first_line(output)
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115 - for the process's life
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    from wildgs.cli import main

    if stage is not None:
        _kill_inside(stage, 2)
    main(arguments)


@dataclass(frozen=True)
class Command:
    """Kills and resumes."""

    moments: int = 20
    """How many kills."""
    writing: float = 0.4
    """Share of the kills that fall inside the writing of a checkpoint."""
    hangups: float = 0.3
    """Share of the other kills that are SIGHUP, on which training saves and ends."""
    method: MethodName = "3dgs"
    """What is trained."""
    steps: int = 240
    """Length of the run."""
    every: int = 12
    """Steps between checkpoints."""
    seed: int = 0
    """Random seed of the moments."""


def main(command: Command) -> int:
    os.environ["HF_HUB_OFFLINE"] = "1"  # a tiny landmark needs no pretrained weights
    SERVER.set_forkserver_preload(PRELOADED)
    folder = Path(tempfile.mkdtemp(prefix="kill-and-resume-"))
    try:
        return _run(command, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(command: Command, folder: Path) -> int:
    scene = write_resized_demo(folder / "scene", photos=9, long_side=48, points=500)
    seconds = _train(command, scene, folder / "a", None, None)
    _train(command, scene, folder / "b", None, None)
    wanted, step = _final(folder / "a")
    if _final(folder / "b")[0] != wanted:
        print(f"{command.method} does not end in the same bits when run twice: resuming cannot be judged")
        return 3
    rng = random.Random(command.seed)
    output, killed = folder / "killed", 0
    print(f"{'#':>3}  {'killed':<32}  newest checkpoint  left aside")
    while killed < command.moments:
        stage = rng.choice(STAGES) if rng.random() < command.writing else None
        # Early enough that the run does not end before the last kill.
        delay = rng.uniform(0, seconds * 2 / command.moments)
        hangup = stage is None and rng.random() < command.hangups
        unread = bool(killed % 2)
        if _train(command, scene, output, stage, delay, hangup=hangup, unread=unread) is not None:
            shutil.rmtree(output)  # it ended before it was killed: another round from its start
            print("     the run ended; once more from the start")
            continue
        killed += 1
        checkpoints = list_checkpoints(output / "checkpoints")
        newest = checkpoints[-1].stem if checkpoints else "none yet"
        partial = len(list(output.rglob(".*.part")))
        name = "SIGHUP, " if hangup else ""
        print(
            f"{killed:>3}  {stage or f'{name}{delay:.2f} s after the start':<32}  {newest:<17}  {partial}",
            flush=True,
        )
    _train(command, scene, output, None, None)
    found, last = _final(output)
    print(f"undisturbed, step {step}: {wanted}\nkilled {killed} times, step {last}: {found}")
    print("the same bits" if found == wanted else "DIFFERENT")
    return 0 if found == wanted else 1


def _train(
    command: Command,
    scene: Path,
    output: Path,
    stage: str | None,
    delay: float | None,
    *,
    hangup: bool = False,
    unread: bool = False,
) -> float | None:
    """Trains to the end, or kills; seconds of training, or None where it was killed."""
    arguments = ["train", scene, "--output", output, "--method", command.method, "--steps", command.steps]
    arguments += ["--checkpoint-every", command.every]
    if command.method == "wildgs":
        arguments += ["--wrapping.resolution", 16, "--parsing.max-side", 32]
    if (output / "config.yaml").is_file():
        arguments.append("--resume")
    log = output.parent / "output.txt"
    log.write_text("")
    process = SERVER.Process(
        target=_child, args=([str(a) for a in arguments], log, stage, unread), daemon=True
    )
    process.start()
    while process.is_alive() and "training " not in log.read_text():
        time.sleep(0.05)
    start = time.monotonic()
    if delay is not None and stage is None:
        time.sleep(delay)
        if hangup and process.pid is not None:
            os.kill(process.pid, signal.SIGHUP)
        else:
            process.kill()
    process.join()
    if process.exitcode in (-signal.SIGKILL, -signal.SIGHUP, 128 + signal.SIGHUP):
        return None
    if process.exitcode != 0:
        raise SystemExit(f"training failed:\n{log.read_text()}")
    return time.monotonic() - start


def _final(output: Path) -> tuple[str, int]:
    checkpoint = load_checkpoint(list_checkpoints(output / "checkpoints")[-1])
    return checkpoint.fingerprint, int(checkpoint.state["progress.step"])


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
