"""Times this tree's CPU rasteriser and that of another commit in turns (`rasterize.py --against`).

Other programs and the clock of the processor change absolute times by a factor of two within minutes. Two processes
that take turns, a pass each, see the same of it: compare their minima, or the median of each turn's ratio.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tempfile
from io import BytesIO
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
WORKER = Path(__file__).with_name("rasterize_scene.py")


def unpack(commit: str, folder: Path) -> None:
    """Writes the commit's `src` into the folder."""
    archive = subprocess.run(
        ["git", "archive", "--format=tar", commit, "src/wildgs"], cwd=ROOT, capture_output=True
    )
    if archive.returncode != 0:
        sys.exit(archive.stderr.decode().strip())
    with tarfile.open(fileobj=BytesIO(archive.stdout)) as tar:
        tar.extractall(folder, filter="data")


def start(tree: Path, n: int, width: int, height: int) -> subprocess.Popen[str]:
    worker = subprocess.Popen(
        [sys.executable, str(WORKER), str(n), str(width), str(height)],
        env={**os.environ, "PYTHONPATH": str(tree / "src")},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert worker.stdout is not None
    if worker.stdout.readline() != "ready\n":
        sys.exit(f"the rasteriser of {tree} does not run")
    return worker


def turn(worker: subprocess.Popen[str]) -> tuple[float, float]:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write("\n")
    worker.stdin.flush()
    forward, backward = worker.stdout.readline().split()
    return float(forward), float(backward)


def compare(commit: str, counts: list[int], sizes: list[tuple[int, ...]], runs: int) -> str:
    """A table of this tree's times against the commit's."""
    lines = [
        "| N | size | pass | ms, median (min) | that commit's | ratio of minima | median of turns' ratios |",
        "|" + "---|" * 7,
    ]
    with tempfile.TemporaryDirectory() as folder:
        unpack(commit, Path(folder))
        for n in counts:
            for width, height in sizes:
                workers = [start(tree, n, width, height) for tree in (ROOT, Path(folder))]
                turns = [[turn(worker) for worker in workers] for _ in range(runs)]
                for worker in workers:
                    worker.communicate()
                for k, name in enumerate(("forward", "backward")):
                    ours, theirs = ([t[who][k] for t in turns] for who in (0, 1))
                    ratio = median(a / b for a, b in zip(ours, theirs, strict=True))
                    lines.append(
                        f"| {n} | {width}x{height} | {name} | {median(ours):.1f} ({min(ours):.1f}) |"
                        f" {median(theirs):.1f} ({min(theirs):.1f}) | {min(ours) / min(theirs):.2f} | {ratio:.2f} |"
                    )
    return "\n".join(lines)
