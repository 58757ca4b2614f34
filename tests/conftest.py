"""Shape checks for the whole package, and visible skips for what a machine lacks."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

from wildgs.processes import LIBRARY_DEFAULTS

# Tests need no network: what is not on disk is not to be had, at once.
os.environ["HF_HUB_OFFLINE"] = "1"
# As the command line does before anything computes: MKL reads its part once, and the first test would decide.
for _name, _value in LIBRARY_DEFAULTS.items():
    os.environ.setdefault(_name, _value)

# Under nohup and in the background of a script, processes that tests start would ignore these signals.
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Workers of pytest-xdist share the cores; set before torch and the processes that tests start read it. Numba's
# OpenMP layer (gsply, demo_generator) sets torch's number of threads to its own: two threads of each worker would
# wait for each other in all later tests.
if "PYTEST_XDIST_WORKER" in os.environ:
    _threads = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "WILDGS_NUM_THREADS"):
        os.environ[_name] = str(_threads)

SOURCE = Path(__file__).parent.parent / "src"
SHARED = Path(__file__).parents[2] / "shared"


def _modules_to_check() -> list[str]:
    """Every module but packages and those that hold Numba or Triton kernels, which a decorator would break."""
    modules = []
    for file in sorted(SOURCE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if file.name != "__init__.py" and "njit" not in text and "triton.jit" not in text:
            modules.append(".".join(file.relative_to(SOURCE).with_suffix("").parts))
    return modules


install_import_hook(_modules_to_check(), "beartype.beartype")

pytest_plugins = ["tests.scene_files"]


@pytest.fixture(autouse=True)
def few_suns(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shadow maps of few directions, for speed; tests/light/test_shadows.py has all of them."""
    if request.module.__name__.endswith("test_shadows"):
        return
    import torch

    from wildgs.light import shadows

    monkeypatch.setattr(shadows, "_ELEVATIONS", torch.tensor([10.0, 50.0]))
    monkeypatch.setattr(shadows, "_AZIMUTHS", torch.tensor([0.0, 120.0, 240.0]))


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Runs the whole suite in one process per core, at most four, where pytest-xdist is installed.

    Parts of the suite run in this process: each worker has to import everything and to make its own fixtures. `-n`
    overrides this.
    """
    # Workers call this hook, too, and would start workers of their own.
    if "PYTEST_XDIST_WORKER" in os.environ:
        return
    whole = (
        config.args_source != config.ArgsSource.ARGS
        or Path(config.args[0]).resolve() == Path(__file__).parent
    )
    if whole and config.pluginmanager.hasplugin("xdist") and not config.option.usepdb:
        if config.option.numprocesses is None:
            config.option.numprocesses = min(os.cpu_count() or 1, 4)
        if config.option.dist == "no":
            config.option.dist = "loadfile"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Escapes what was captured of file names that are not UTF-8, which pytest-xdist cannot send."""
    report = yield
    report.sections = [
        (title, text.encode(errors="backslashreplace").decode()) for title, text in report.sections
    ]
    return report


def _missing(marker: str) -> str | None:
    if marker == "shared" and not (SHARED / "data").is_dir():
        return "no ../shared folder beside the checkout"
    if marker == "chromium" and not (shutil.which("chromium") or shutil.which("google-chrome")):
        return "no Chromium on the PATH"
    if marker == "cuda":
        import torch

        if not torch.cuda.is_available():
            return "no CUDA device"
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    reasons = {marker: _missing(marker) for marker in ("shared", "chromium", "cuda")}
    for item in items:
        for marker, reason in reasons.items():
            if reason and item.get_closest_marker(marker):
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real photos and scenes; tests that use it carry the marker `shared`."""
    return SHARED


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of four megabytes."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("may not mount a file system here; injected failures stand in for it elsewhere")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.fixture(scope="session")
def forking_python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A Python that starts at once (Linux)."""
    if sys.platform != "linux":
        pytest.skip("needs bash and /proc")
    folder, root = tmp_path_factory.mktemp("python"), SOURCE.parent
    places = os.pathsep.join(map(str, (SOURCE, root / "benchmarks", root)))
    environment = os.environ | {"PYTHONPATH": places, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    script = Path(__file__).with_name("forking_python.py")
    server = subprocess.Popen([sys.executable, str(script), str(folder)], env=environment)
    while not (folder / "python").exists():
        assert server.poll() is None
        time.sleep(0.05)
    yield folder / "python"
    server.kill()
    server.wait()


TRAIN = (
    "--steps",
    40,
    "--wrapping.resolution",
    16,
    "--parsing.max-side",
    32,
    "--parsing.encoder",
    "nobody/none",
)


@pytest.fixture(scope="session")
def landmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photos of the demo's landmark at 48 pixels, two of them held out; tests must not change it."""
    from benchmarks.resized_demo import write_resized_demo

    folder = tmp_path_factory.mktemp("landmark") / "scene"
    return write_resized_demo(folder, photos=9, long_side=48, points=1000)


@pytest.fixture(scope="session")
def trained(landmark: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on the landmark, forty steps; tests must not change it."""
    from wildgs.cli import main

    output = tmp_path_factory.mktemp("runs") / "a run"
    main([str(a) for a in ("train", landmark, "--output", output, *TRAIN)])
    return output
