"""Finds LPIPS weights: a folder, the cache of torch.hub, an installed package, or the official download."""

from __future__ import annotations

import importlib.util
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch

from wildgs.evaluation.lpips import LPIPS, Network

ENVIRONMENT = "WILDGS_LPIPS"
"""Environment variable: a folder with a backbone and its linear layers, or ``off`` to disable LPIPS."""

OFFICIAL = {"alex": "alexnet-owt-7be5be79.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
_BACKBONE_URL = "https://download.pytorch.org/models/"
_LINEAR_URL = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
_BACKBONE_NAMES = {"alex": "alexnet*.pth", "squeeze": "squeezenet1_1*.pth"}
_TIMEOUT_SECONDS = 10.0


@dataclass(frozen=True)
class LpipsFiles:
    """Files of the weights.

    Attributes:
        network: Backbone.
        backbone: Weights of the backbone, in the layout of torchvision.
        linear: Linear layers of LPIPS.
    """

    network: Network
    backbone: Path
    linear: Path


def find_lpips(folder: Path | None = None) -> LpipsFiles | None:
    """Finds weights on this machine, AlexNet before SqueezeNet, without downloading.

    Args:
        folder: The only folder to search. By default the folder in `WILDGS_LPIPS`, otherwise the cache of
            torch.hub, with linear layers beside the backbone or in an installed `lpips` or `torchmetrics`.
    """
    chosen = folder or _folder_from_environment()
    if chosen is not None:
        return _find_in([chosen], [chosen])
    checkpoints = _hub_folder()
    return _find_in([checkpoints], [checkpoints, *_package_folders()])


def load_lpips(folder: Path | None = None, download: bool = True) -> tuple[LPIPS | None, str]:
    """Loads LPIPS, or states why it is not available.

    Args:
        folder: As for `find_lpips`.
        download: Download the official AlexNet weights (240 MB) if none are found; tried once.

    Returns:
        The network or None, and a line for the notes of `metrics.json`.
    """
    setting = os.environ.get(ENVIRONMENT, "").strip()
    if folder is None and setting.lower() == "off":
        return None, f"LPIPS is null: {ENVIRONMENT} is off"
    explicit = folder or _folder_from_environment()
    files = find_lpips(folder)
    if files is None and explicit is not None:
        return None, (
            f"LPIPS is null: {explicit} contains no backbone (alexnet*.pth or squeezenet1_1*.pth) "
            "with linear layers (linear.pth, alex.pth or squeeze.pth)"
        )
    if files is None and download:
        files = _download()
    if files is None:
        return None, f"LPIPS is null: weights not found; get them with `{how_to_get_lpips()}`"
    try:
        model = LPIPS(files.network)
        model.load(_read(files.backbone), _read(files.linear))
    except Exception as error:  # unpickling raises many kinds; other scores must not be lost
        return None, f"LPIPS is null: cannot load {files.backbone} or {files.linear} ({_first_line(error)})"
    return model, f"LPIPS v0.1 with {'AlexNet' if files.network == 'alex' else 'SqueezeNet 1.1'}"


def how_to_get_lpips() -> str:
    """Shell command that downloads the official weights."""
    checkpoints = _hub_folder()
    name = OFFICIAL["alex"]
    return (
        f"mkdir -p {checkpoints} && curl -L {_BACKBONE_URL}{name} -o {checkpoints / name} "
        f"&& curl -L {_LINEAR_URL}alex.pth -o {checkpoints / 'lpips_alex.pth'}"
    )


def _folder_from_environment() -> Path | None:
    setting = os.environ.get(ENVIRONMENT, "").strip()
    return Path(setting).expanduser() if setting and setting.lower() != "off" else None


def _hub_folder() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _find_in(backbones: list[Path], linears: list[Path]) -> LpipsFiles | None:
    networks: tuple[Network, Network] = ("alex", "squeeze")
    for network in networks:
        for folder in backbones:
            backbone = next(iter(sorted(folder.glob(_BACKBONE_NAMES[network]))), None)
            names = (f"lpips_{network}.pth", f"{network}.pth", "linear.pth")
            linear = next((f / n for f in linears for n in names if (f / n).is_file()), None)
            if backbone is not None and linear is not None:
                return LpipsFiles(network, backbone, linear)
    return None


def _package_folders() -> list[Path]:
    """Folders of installed packages that contain the linear layers of LPIPS; the packages are not imported."""
    places = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}
    folders = []
    for package, place in places.items():
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.submodule_search_locations:
            folders.append(Path(next(iter(spec.submodule_search_locations))) / place)
    return folders


@cache
def _download() -> LpipsFiles | None:
    """Downloads the official AlexNet weights into the cache of torch.hub; None if that fails. Tried once."""
    # The small file first, in a thread: name resolution has no timeout.
    small = threading.Thread(target=_fetch, args=(_LINEAR_URL + "alex.pth", "lpips_alex.pth"), daemon=True)
    small.start()
    small.join(_TIMEOUT_SECONDS)
    if small.is_alive() or not (_hub_folder() / "lpips_alex.pth").is_file():
        return None
    _fetch(_BACKBONE_URL + OFFICIAL["alex"], OFFICIAL["alex"])
    return find_lpips()


def _fetch(url: str, name: str) -> None:
    """Downloads a file into the hub cache; a failure leaves no file."""
    hashed = name == OFFICIAL["alex"]
    try:
        with _socket_timeout(_TIMEOUT_SECONDS):
            torch.hub.load_state_dict_from_url(
                url, map_location="cpu", progress=hashed, check_hash=hashed, file_name=name, weights_only=True
            )
    except Exception:  # urllib, ssl, socket, unpickling or hash errors: there are no weights
        return


@contextmanager
def _socket_timeout(seconds: float) -> Iterator[None]:
    previous = socket.getdefaulttimeout()
    socket.setdefaulttimeout(seconds)
    try:
        yield
    finally:
        socket.setdefaulttimeout(previous)


def _read(file: Path) -> dict[str, Any]:
    return torch.load(file, map_location="cpu", weights_only=True)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
