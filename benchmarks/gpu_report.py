"""Gathers what the stages of gpu.sh left into OUTPUT/gpu.json.

    python benchmarks/gpu_report.py OUTPUT

What a stage did not leave is null or empty; its exit code says why.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree


def read_json(path: Path) -> Any:
    """A JSON file's content, or None where there is none, or half of one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def read_lines(path: Path) -> list[Any]:
    """JSON lines, without those that were cut off."""
    if not path.is_file():
        return []
    entries = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entries.append(json.loads(line))
        except ValueError:
            continue
    return entries


def versions() -> dict[str, str | None]:
    """Of what has a say in the figures."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("torch", "triton", "gsplat", "numba"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = None
    found["nvcc"] = _last_line("nvcc", "--version")
    found["driver"] = _last_line("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    found["commit"] = _last_line("git", "rev-parse", "--short", "HEAD")
    return found


def _last_line(*command: str) -> str | None:
    try:
        lines = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=20
        ).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return None
    return lines[-1].strip() if lines else None


def device() -> dict[str, Any] | None:
    """The GPU."""
    import torch

    if not torch.cuda.is_available():
        return None
    properties = torch.cuda.get_device_properties(0)
    return {
        "name": properties.name,
        "memory_gb": round(properties.total_memory / 1e9, 1),
        "capability": f"{properties.major}.{properties.minor}",
        "cuda": torch.version.cuda,
    }


def tests(path: Path) -> dict[str, Any] | None:
    """Numbers of pytest's report, and the names of what failed."""
    try:
        suites = list(ElementTree.parse(path).getroot().iter("testsuite"))
    except (OSError, ElementTree.ParseError):
        return None
    counts = {
        key: sum(int(suite.get(key, 0)) for suite in suites)
        for key in ("tests", "failures", "errors", "skipped")
    }
    cases = [case for suite in suites for case in suite.iter("testcase")]
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    return {**counts, "failed": [f"{case.get('classname')}.{case.get('name')}" for case in failed]}


def training(run: Path) -> dict[str, Any] | None:
    """How far training came, and how fast."""
    lines = read_lines(run / "metrics.jsonl")
    if not lines:
        return None
    last = lines[-1]
    keys = ("step", "seconds", "steps_per_second", "num_gaussians", "total")
    scores = {protocol: read_json(run / "eval" / protocol / "metrics.json") for protocol in ("full", "half")}
    for metrics in scores.values():
        if metrics is not None:
            metrics.pop("images", None)
    return {**{key: last.get(key) for key in keys}, "eval": scores}


def gather(output: Path) -> dict[str, Any]:
    """The whole report."""
    parts = output / "parts"
    rows = {
        name: read_lines(parts / f"{name}.out")
        for name in ("eager", "graphs", "profile", "host", "steps", "features")
    }
    render = read_lines(parts / "render.out")
    return {
        "device": device(),
        "versions": versions(),
        "stages": read_lines(parts / "stages.jsonl"),
        "tests": {name: tests(parts / f"{name}.xml") for name in ("parity", "tests")},
        **rows,
        "render": [{**row, "frames_per_second": 1e3 / row["forward_ms"]} for row in render],
        "training": training(output / "run"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path, help="the folder that gpu.sh wrote")
    output: Path = parser.parse_args().output
    report = gather(output)
    (output / "gpu.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({"gpu.json": str(output / "gpu.json"), "device": report["device"]}))


if __name__ == "__main__":
    main()
