"""`torchrun -m wildgs`: one voice, one writer, a clean stop, a lost rank, other numbers, and a bench spread out."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from wildgs.engine.checkpoint import list_checkpoints
from wildgs.runs import load_run

pytestmark = pytest.mark.timeout(1200)
SOURCE = Path(__file__).parents[2] / "src"
TRAIN = ("--method", "3dgs", "--steps", "400", "--checkpoint-every", "20")
LAUNCH = (
    sys.executable,
    "-m",
    "torch.distributed.run",
    "--standalone",
    "--nproc-per-node",
    "2",
    "-m",
    "wildgs",
)


def torchrun(*arguments: object) -> subprocess.Popen[str]:
    """Starts two processes."""
    environment = os.environ | {"PYTHONPATH": str(SOURCE), "WILDGS_NUM_THREADS": "1", "NO_COLOR": "1"}
    return subprocess.Popen(
        [*LAUNCH, *map(str, arguments)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def torchrun_to_the_end(python: Path, folder: Path, *arguments: object) -> tuple[int, str, str]:
    """Exit code, output and errors of two processes of a Python that starts at once."""
    environment = os.environ | {"PYTHONPATH": str(SOURCE), "WILDGS_NUM_THREADS": "1", "NO_COLOR": "1"}
    environment["PYTHON_EXEC"] = str(python)  # torchrun starts ranks with it
    # Files, because a rank that torchrun stops early keeps its output open for a while.
    logs = Path(tempfile.mkdtemp(dir=folder))
    with (logs / "output").open("a") as output, (logs / "errors").open("a") as errors:
        command = [*LAUNCH, *map(str, arguments)]
        code = subprocess.run(command, env=environment, stdout=output, stderr=errors, check=False).returncode
    return code, (logs / "output").read_text(), (logs / "errors").read_text()


def wait_for_checkpoint(process: subprocess.Popen[str], run: Path, beyond: int) -> None:
    """Until the run has a checkpoint of a later step."""
    while process.poll() is None:
        paths = list_checkpoints(run / "checkpoints")
        if paths and int(paths[-1].stem.removeprefix("step_")) > beyond:
            return
        time.sleep(0.05)
    pytest.fail(f"ended before its checkpoint: {process.communicate()[1]}")


def rank_processes(launcher: int) -> dict[int, int]:
    """Process ids of the launcher's children by rank."""
    found = {}
    for child in Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split():
        variables = Path(f"/proc/{child}/environ").read_bytes().split(b"\0")
        ranks = [int(entry[5:]) for entry in variables if entry.startswith(b"RANK=")]
        found |= {rank: int(child) for rank in ranks}
    return found


def told(text: str) -> list[str]:
    """The program's own lines, without torchrun's report."""
    return [line for line in text.splitlines() if line.startswith(("error: ", "rank ", "interrupted"))]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the ranks through /proc")
def test_stop_then_lose_a_rank_then_go_on_alone(landmark: Path, tmp_path: Path, wildgs) -> None:
    run = tmp_path / "run"
    process = torchrun("train", landmark, "--output", run, *TRAIN)
    wait_for_checkpoint(process, run, 0)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate()
    assert process.returncode != 0
    (line,) = told(errors)
    assert "saved in" in line
    step = load_run(run).step
    assert line.startswith(f"interrupted at step {step}")
    assert step % 2 == 0
    assert output.count("training 3dgs on 2 processes: 400 steps") == 1
    assert output.count("held-out photos,") == 1

    process = torchrun("train", landmark, "--output", run, "--resume", *TRAIN[-2:])
    wait_for_checkpoint(process, run, step + 20)
    os.kill(rank_processes(process.pid)[1], signal.SIGKILL)
    errors = process.communicate()[1]
    assert process.returncode != 0
    (line,) = told(errors)
    assert "another process of this training ended" in line
    assert "--resume" in line
    assert load_run(run).step > step

    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert load_run(run).step == 400
    steps = [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps))
    assert steps[-1] == 400


def test_a_mistake_is_told_once(forking_python: Path, tmp_path: Path) -> None:
    options = ("train", tmp_path / "nowhere", "--output", tmp_path / "run", *TRAIN)
    code, _, errors = torchrun_to_the_end(forking_python, tmp_path, *options)
    assert code != 0
    (line,) = told(errors)
    assert line.startswith("error: ")
    assert "nowhere" in line
    assert str(SOURCE / "wildgs") not in errors  # no traceback of this program


BENCH = ("--steps", "4", "--methods", "3dgs")


def test_bench_spreads_its_runs_and_tells_once_what_failed(
    forking_python: Path, landmark: Path, tmp_path: Path
) -> None:
    obstacle = tmp_path / landmark.name / "3dgs" / "seed_1" / "checkpoints"
    obstacle.parent.mkdir(parents=True)
    obstacle.write_text("in the way")
    bench = ("bench", landmark, "--output", tmp_path, "--seeds", "0", "1", "2", *BENCH)
    code, output, errors = torchrun_to_the_end(forking_python, tmp_path, *bench)
    assert code != 0
    (line,) = told(errors)
    assert "1 of 3 runs failed" in line
    speakers = [line.split(":")[0] for line in output.splitlines() if ": run " in line]
    assert sorted(set(speakers)) == ["rank 0", "rank 1"]
    assert len(speakers) == 3  # each run once
    assert finished_seeds(tmp_path) == [0, 2]

    obstacle.unlink()
    code, output, errors = torchrun_to_the_end(forking_python, tmp_path, *bench)
    assert code == 0, errors
    (only,) = runs_of(output)
    assert only.startswith("2 of 3")
    assert finished_seeds(tmp_path) == [0, 1, 2]


def runs_of(output: str) -> list[str]:
    """What ranks said that they run."""
    return [line.split(": run ", 1)[1] for line in output.splitlines() if ": run " in line]


def finished_seeds(folder: Path) -> list[int]:
    table = json.loads((folder / "table.json").read_text(encoding="utf-8"))
    return sorted(run["seed"] for run in table["runs"])


def test_other_verbs_refuse_torchrun(wildgs, monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert wildgs("eval", tmp_path) == 2
    assert "without torchrun" in capsys.readouterr().err
