"""Does a training that is killed again and again end in the same bits as one that is left alone?

Trains a tiny landmark once undisturbed, then again with SIGKILL at random moments, part of them inside the writing
of a checkpoint, going on with --resume after each. Prints a table and compares SHA-256 over all tensors.
Methods that are not reproducible from run to run cannot be judged; that is checked first (exit code 3).

Example: python benchmarks/kill_and_resume.py --moments 20
"""

from __future__ import annotations

import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from wildgs.data.synthetic import SyntheticConfig, make_landmark
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.model.registry import MethodName

STAGES = (
    "before writing",
    "half written",
    "written, not flushed",
    "flushed, not renamed",
    "renamed, old ones kept",
)
"""Moments inside the writing of a checkpoint."""

_CHILD = """
import os, signal, sys
from pathlib import Path
stage, count = os.environ.get("KILL_STAGE"), int(os.environ.get("KILL_COUNT", 1))
if stage:
    from wildgs.engine import checkpoint
    left = [count]
    def die():
        os.kill(os.getpid(), signal.SIGKILL)
    def now(name):
        return stage == name and left[0] <= 0
    save_file, flush, replace = checkpoint.save_file, checkpoint._flush, Path.replace
    def saving(tensors, path, metadata):
        left[0] -= 1
        if now("before writing"): die()
        save_file(tensors, path, metadata=metadata)
        if now("half written"):
            os.truncate(path, path.stat().st_size // 2); die()
        if now("written, not flushed"): die()
    def flushing(path):
        if path.is_dir() and now("renamed, old ones kept"): die()
        flush(path)
    def replacing(self, target):
        if self.suffix == ".partial" and "step_" in self.name and now("flushed, not renamed"): die()
        return replace(self, target)
    checkpoint.save_file, checkpoint._flush, Path.replace = saving, flushing, replacing
from wildgs.cli import main
main(sys.argv[1:])
"""


@dataclass(frozen=True)
class Command:
    """Kills and resumes."""

    moments: int = 20
    """How many kills."""
    writing: float = 0.4
    """Share of the kills that fall inside the writing of a checkpoint."""
    method: MethodName = "3dgs"
    """What is trained."""
    steps: int = 240
    """Length of the run."""
    every: int = 12
    """Steps between checkpoints."""
    seed: int = 0
    """Of the moments."""


def main(command: Command) -> int:
    folder = Path(tempfile.mkdtemp(prefix="kill-and-resume-"))
    try:
        return _run(command, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(command: Command, folder: Path) -> int:
    scene = folder / "scene"
    make_landmark(scene, SyntheticConfig(photos=9, test_every=4, long_side=48, points=800, least_views=2))
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
        if _train(command, scene, output, stage, delay) is not None:
            shutil.rmtree(output)  # it ended before it was killed: another round from its start
            print("     the run ended; once more from the start")
            continue
        killed += 1
        checkpoints = list_checkpoints(output / "checkpoints")
        newest = checkpoints[-1].stem if checkpoints else "none yet"
        partial = len(list(output.rglob("*.partial")))
        print(
            f"{killed:>3}  {stage or f'{delay:.2f} s after the first step':<32}  {newest:<17}  {partial}",
            flush=True,
        )
    _train(command, scene, output, None, None)
    found, last = _final(output)
    print(f"undisturbed, step {step}: {wanted}\nkilled {killed} times, step {last}: {found}")
    print("the same bits" if found == wanted else "DIFFERENT")
    return 0 if found == wanted else 1


def _train(
    command: Command, scene: Path, output: Path, stage: str | None, delay: float | None
) -> float | None:
    """Trains to the end, or kills; seconds of training, or None where it was killed."""
    arguments = ["train", scene, "--output", output, "--method", command.method, "--steps", command.steps]
    arguments += ["--checkpoint-every", command.every, "--wrapping.resolution", 16, "--parsing.max-side", 32]
    arguments += ["--parsing.encoder", "nobody/none"]
    if (output / "config.yaml").is_file():
        arguments.append("--resume")
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    if stage is not None:
        environment |= {"KILL_STAGE": stage, "KILL_COUNT": "2"}
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", _CHILD, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
    )
    try:
        text = _wait_for(process, b"training ")
        start = time.monotonic()
        if delay is not None and stage is None:
            time.sleep(delay)
            process.kill()
        rest, _ = process.communicate(timeout=500)
    finally:
        process.kill()
    if process.returncode == -signal.SIGKILL:
        return None
    if process.returncode != 0:
        raise SystemExit(f"training failed:\n{(text + rest).decode()}")
    return time.monotonic() - start


def _wait_for(process: subprocess.Popen[bytes], word: bytes) -> bytes:
    """Reads until training begins."""
    assert process.stdout is not None
    text = b""
    while word not in text:
        ready, _, _ = select.select([process.stdout], [], [], 300)
        piece = os.read(process.stdout.fileno(), 4096) if ready else b""
        if not piece:
            break
        text += piece
    return text


def _final(output: Path) -> tuple[str, int]:
    checkpoint = load_checkpoint(list_checkpoints(output / "checkpoints")[-1])
    return checkpoint.fingerprint, int(checkpoint.state["progress.step"])


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
