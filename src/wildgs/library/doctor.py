"""`wildgs.examine`: checks what works on this machine; and the text for bug reports, without personal names."""

from __future__ import annotations

import getpass
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from wildgs.config_file import CONFIG_FILE
from wildgs.files import check_regular
from wildgs.library.logs import LOG_FILE

State = Literal["works", "missing", "broken"]


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: What was checked.
        state: `missing` can be installed; `broken` is installed and fails.
        detail: The version found, or why it does not work and what is not available without it.
        remedy: The command that installs or repairs it, if there is one.
    """

    name: str
    state: State
    detail: str
    remedy: str | None = None


def examine() -> list[Check]:
    """Runs all checks; one that raises an exception is reported as broken."""
    probes: list[tuple[str, Callable[[], Check]]] = [
        ("Python", _python),
        ("PyTorch", _torch),
        ("CPU", _cpu),
        ("Numba", _numba),
        ("rasteriser on the CPU", lambda: _rasterize_one("rasteriser on the CPU", "cpu")),
        ("rasteriser on CUDA", _cuda_rasterizer),
        ("poses from photos", _pycolmap),
        ("encoder weights", _encoder_weights),
        ("depth weights", _depth_weights),
        ("LPIPS weights", _lpips),
        ("viewer", _viewer),
        ("videos", _videos),
    ]
    checks = []
    for name, probe in probes:
        try:
            checks.append(probe())
        except Exception as error:  # any failure is a finding
            first = (str(error).splitlines() or [""])[0]
            checks.append(Check(name, "broken", f"{type(error).__name__}: {first}"))
    return checks


def _python() -> Check:
    version = importlib.metadata.version("wildgs")
    return Check("Python", "works", f"{platform.python_version()} on {platform.system()}, wildgs {version}")


def _torch() -> Check:
    import torch

    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU only"
    return Check("PyTorch", "works", f"{torch.__version__}, {torch.get_num_threads()} threads, {device}")


def _cpu() -> Check:
    import torch

    features = [torch.backends.cpu.get_cpu_capability()]
    for name in ("avx512_bf16", "amx_tile"):
        probe = getattr(torch.cpu, f"_is_{name}_supported", None)
        if probe is not None and probe():
            features.append(name)
    return Check("CPU", "works", f"{_cpu_model()}, {os.cpu_count()} cores, {', '.join(features)}")


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _numba() -> Check:
    """Compiles and runs a kernel and checks its result."""
    import numba
    import torch

    from wildgs.losses.ssim import ssim
    from wildgs.threads import thread_count

    picture = torch.linspace(0, 1, 16 * 16 * 3).view(16, 16, 3)
    value = float(ssim(picture, picture))
    if abs(value - 1) > 1e-4:
        detail = f"{numba.__version__} computes {value} instead of 1"
        return Check("Numba", "broken", detail, _pip("numba", "-U"))
    cores = f"kernels run on {thread_count()} threads (change with WILDGS_NUM_THREADS)"
    return Check("Numba", "works", f"{numba.__version__}, {cores}")


def _cuda_rasterizer() -> Check:
    import torch

    name = "rasteriser on CUDA"
    if not torch.cuda.is_available():
        detail = "torch finds no NVIDIA GPU; everything runs on the CPU, but slower"
        if torch.version.cuda is None and shutil.which("nvidia-smi"):
            detail = "this build of torch has no CUDA, but the machine has an NVIDIA driver"
            return Check(name, "missing", detail, _pip("torch", "-U --force-reinstall"))
        return Check(name, "missing", detail)
    return _gsplat(name)


def _gsplat(name: str) -> Check:
    """Checks gsplat's version and whether its CUDA extension is built or can be built; builds nothing."""
    from wildgs.errors import UserError
    from wildgs.rasterize import gsplat_library

    try:
        gsplat_library.import_gsplat()
    except UserError as error:
        state = "missing" if importlib.util.find_spec("gsplat") is None else "broken"
        return Check(name, state, str(error), _pip(f"'{gsplat_library.REQUIREMENT}'"))
    if gsplat_library.is_built():
        return _rasterize_one(name, "cuda")
    problem = gsplat_library.toolkit_problem()
    if problem is not None:
        return Check(name, "broken", f"{problem}: {gsplat_library.build_help()}")
    detail = "gsplat's CUDA extension is not built yet; the first use builds it, which takes 2 to 15 minutes"
    return Check(name, "missing", detail, f"{sys.executable} -m wildgs doctor --build-gsplat")


def build_gsplat() -> None:
    """Builds gsplat's CUDA extension if necessary; raises `UserError` if that fails."""
    from wildgs.errors import UserError
    from wildgs.rasterize import gsplat_library

    gsplat_library.import_gsplat()
    problem = None if gsplat_library.is_built() else gsplat_library.toolkit_problem()
    if problem is not None:
        raise UserError(f"{problem}: {gsplat_library.build_help()}")
    gsplat_library.load_gsplat()


def _rasterize_one(name: str, device: str) -> Check:
    """Renders one Gaussian and checks the image."""
    import torch

    from wildgs.geometry.camera import Camera
    from wildgs.rasterize import blend, project

    K = torch.tensor([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 32, 32).to(device)
    means = torch.tensor([[0.0, 0.0, 2.0]], device=device)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
    ones = torch.ones(1, 3, device=device)
    projection = project(means, quats, 0.2 * ones, 0.9 * ones[:, 0], camera)
    alpha = float(blend(projection, ones).alpha[16, 16])
    if not 0.85 < alpha < 0.95:
        return Check(name, "broken", f"a Gaussian of opacity 0.9 is rendered with alpha {alpha:.2f}")
    return Check(name, "works", "rendered a test image")


def _pycolmap() -> Check:
    import pycolmap

    name = "poses from photos"
    cuda = "with CUDA" if getattr(pycolmap, "has_cuda", False) else "on the CPU"
    return Check(name, "works", f"pycolmap {pycolmap.__version__}, {cuda}")


def _encoder_weights() -> Check:
    from wildgs.model.encoder import load_encoder

    load_encoder()
    return Check("encoder weights", "works", "SqueezeNet 1.1, part of the package")


def _depth_weights() -> Check:
    """Checks whether the network is in the Hugging Face cache, without a network request."""
    from huggingface_hub import try_to_load_from_cache

    from wildgs.priors.config import DEPTH_ANYTHING

    name = "depth weights"
    # Only safetensors: weights in pickle files could execute code.
    if isinstance(try_to_load_from_cache(DEPTH_ANYTHING, "model.safetensors"), str):
        return Check(name, "works", f"{DEPTH_ANYTHING} is cached")
    detail = (
        f"{DEPTH_ANYTHING} is not cached; it is downloaded at its first use;"
        " without it only depth by stereo is used"
    )
    return Check(name, "missing", detail, f"hf download {DEPTH_ANYTHING}")


def _lpips() -> Check:
    from wildgs.evaluation.lpips import load_lpips

    model, note = load_lpips()
    return Check("LPIPS weights", "works" if model is not None else "broken", note)


def _viewer() -> Check:
    if importlib.util.find_spec("viser") is None:
        return Check("viewer", "missing", "`wildgs view` needs viser", _pip("'viser>=1.1,<1.2'"))
    return Check("viewer", "works", f"viser {importlib.metadata.version('viser')}")


def _videos() -> Check:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        detail = "`wildgs render` writes PNG frames only; videos need imageio-ffmpeg"
        return Check("videos", "missing", detail, _pip("imageio-ffmpeg"))
    import imageio_ffmpeg

    return Check("videos", "works", f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}")


def _pip(package: str, options: str = "") -> str:
    return " ".join(part for part in (sys.executable, "-m pip install", options, package) if part)


PACKAGES = (
    "wildgs",
    "torch",
    "numpy",
    "numba",
    "pycolmap",
    "transformers",
    "pillow",
    "safetensors",
    "gsplat",
)
LOG_LINES = 60
LOG_BYTES = 200_000
METRIC_LINES = 5
_HOMES = re.compile(r"(/home/|/Users/|[A-Za-z]:\\Users\\)[^/\\\s'\":]+")


def write_report(checks: Sequence[tuple[str, str, str]], run: Path | None) -> str:
    """A bug report as text: the checks (name, state, detail), and the configuration and log of a run folder."""
    parts = ["## Versions", *_versions(), "", "## This machine"]
    parts += [f"- {name}: {state}: {detail}" for name, state, detail in checks]
    if run is not None:
        parts += ["", "## Configuration", "```yaml", _tail(run / CONFIG_FILE, 500), "```"]
        parts += ["", "## Last log lines", "```", _tail(run / LOG_FILE, LOG_LINES), "```"]
        parts += ["", "## Last metrics", "```", _tail(run / "metrics.jsonl", METRIC_LINES), "```"]
        checkpoints = sorted((run / "checkpoints").glob("*")) if (run / "checkpoints").is_dir() else []
        parts += ["", "## Checkpoints", *(f"- {p.name}: {p.stat().st_size:,} bytes" for p in checkpoints)]
    return without_names("\n".join(parts))


def without_names(text: str) -> str:
    """Removes the path of the home folder and the names of the user and the machine from a text."""
    home = str(Path.home())
    if len(home) > 1:
        text = text.replace(home, "~")
    text = _HOMES.sub("~", text)
    for name, stand_in in ((_user(), "USER"), (socket.gethostname(), "HOST")):
        if name:
            text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", stand_in, text)
    return text


def _user() -> str:
    try:
        return getpass.getuser()
    except Exception:  # a user without an entry in the password database
        return ""


def _versions() -> list[str]:
    lines = [f"- Python {platform.python_version()} on {platform.system()} {platform.machine()}"]
    for package in PACKAGES:
        try:
            lines.append(f"- {package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            lines.append(f"- {package}: not installed")
    return lines


def _tail(path: Path, count: int) -> str:
    """The last lines of a file; reads at most its last `LOG_BYTES`."""
    try:
        check_regular(path)
        with path.open("rb") as file:
            file.seek(0, 2)
            file.seek(max(0, file.tell() - LOG_BYTES))
            text = file.read().decode("utf-8", errors="replace")
    except OSError as error:
        return f"(cannot be read: {error})"
    return "\n".join(text.splitlines()[-count:])
