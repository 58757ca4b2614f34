"""LPIPS v0.1 (Zhang et al. 2018) in plain torch: SqueezeNet 1.1 from the package, or AlexNet from a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from wildgs.model.squeezenet import LPIPS_TAPS, LPIPS_WIDTHS, packaged_weights, squeezenet_layers

Network = Literal["alex", "squeeze"]
MIN_SIDE = 32
"""Minimum side in pixels for which the deepest layer of both backbones is not empty."""
ENVIRONMENT = "WILDGS_LPIPS"
"""Environment variable: a folder with a backbone and its linear layers, or ``off`` to disable LPIPS."""

# LPIPS's normalisation of inputs in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_BACKBONE_NAMES: dict[Network, str] = {"alex": "alexnet*.pth", "squeeze": "squeezenet1_1*.pth"}
_TITLES: dict[Network, str] = {"alex": "AlexNet", "squeeze": "SqueezeNet 1.1"}


class LPIPS(nn.Module):
    """Learned perceptual distance of two images.

    Features after each tapped ReLU are normalised to unit length over the channels; squared differences are
    weighted by the linear layer and averaged over the image.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network: Network = network
        if network == "alex":
            self.features, self.taps, widths = _alexnet_layers(), (1, 4, 7, 9, 11), (64, 192, 384, 256, 256)
        else:
            self.features, self.taps, widths = squeezenet_layers(), LPIPS_TAPS, LPIPS_WIDTHS
        self.linear = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in widths])
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        self.requires_grad_(False).eval()

    def load(self, backbone: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        """Loads weights in the layouts of torchvision and LPIPS.

        Args:
            backbone: torchvision's state dict of the whole network or of its `features`.
            linear: ``lin{i}.model.1.weight`` of LPIPS, each [1, C, 1, 1].

        Raises:
            RuntimeError: Names or shapes do not match.
        """
        prefix = "features."
        if any(name.startswith(prefix) for name in backbone):
            backbone = {k[len(prefix) :]: v for k, v in backbone.items() if k.startswith(prefix)}
        self.features.load_state_dict(dict(backbone))
        for i, weight in enumerate(self.linear):
            given = linear.get(f"lin{i}.model.1.weight")
            if given is None or given.numel() != weight.numel():
                raise RuntimeError(f"linear layer {i} is missing or does not have {weight.numel()} channels")
            weight.copy_(given.flatten())

    @torch.no_grad()
    def forward(self, first: UInt8[Tensor, "H W 3"], second: UInt8[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Computes the distance: 0 for identical images, about 0.7 for unrelated ones.

        Raises:
            ValueError: A side is shorter than `MIN_SIDE` pixels.
        """
        if min(first.shape[:2]) < MIN_SIDE:
            raise ValueError(f"LPIPS needs at least {MIN_SIDE} pixels per side")
        pair = torch.stack([first, second]).permute(0, 3, 1, 2).to(self.scale) / 127.5 - 1
        x = (pair - self.shift) / self.scale
        distance = x.new_zeros(())
        taps = iter(self.linear)
        for i, layer in enumerate(self.features):
            x = layer(x)
            if i in self.taps:
                unit = x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
                distance = distance + ((unit[0] - unit[1]).square().mean(dim=(1, 2)) * next(taps)).sum()
        return distance


def load_lpips(folder: Path | None = None) -> tuple[LPIPS | None, str]:
    """Loads the network; returns it with a note that names it, or None with a note that gives the reason.

    Args:
        folder: Folder of a backbone (AlexNet or SqueezeNet) and its linear layers. None uses the folder in
            `WILDGS_LPIPS`, and the packaged SqueezeNet if that is not set.
    """
    setting = os.environ.get(ENVIRONMENT, "").strip()
    if folder is None and setting.lower() == "off":
        return None, f"LPIPS is null: {ENVIRONMENT} is off"
    if folder is None and setting:
        folder = Path(setting).expanduser()
    if folder is None:
        model = LPIPS("squeeze")
        model.load(*packaged_weights())
        return model, _title(model)
    return _load_from(folder)


def _load_from(folder: Path) -> tuple[LPIPS | None, str]:
    found = _find_in(folder)
    if found is None:
        return None, (
            f"LPIPS is null: {folder} contains no backbone (alexnet*.pth or squeezenet1_1*.pth) "
            "with linear layers (linear.pth, alex.pth or squeeze.pth)"
        )
    network, backbone, linear = found
    model = LPIPS(network)
    try:
        model.load(_read(backbone), _read(linear))
    except (
        Exception
    ) as error:  # unpickling raises many kinds of errors; scores without LPIPS are better than none
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return None, f"LPIPS is null: cannot load {backbone} or {linear} ({reason})"
    return model, _title(model)


def _find_in(folder: Path) -> tuple[Network, Path, Path] | None:
    """Finds a backbone and its linear layers; AlexNet takes precedence over SqueezeNet."""
    for network, pattern in _BACKBONE_NAMES.items():
        backbone = next(iter(sorted(folder.glob(pattern))), None)
        names = (f"lpips_{network}.pth", f"{network}.pth", "linear.pth")
        linear = next((folder / name for name in names if (folder / name).is_file()), None)
        if backbone is not None and linear is not None:
            return network, backbone, linear
    return None


def _read(file: Path) -> dict[str, Any]:
    return torch.load(file, map_location="cpu", weights_only=True)


def _title(model: LPIPS) -> str:
    return f"LPIPS v0.1 with {_TITLES[model.network]} ({model.network})"


def _alexnet_layers() -> nn.Sequential:
    """Layers at the indices of torchvision's AlexNet."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
    )
