"""LPIPS v0.1 (Zhang et al. 2018) in plain torch: AlexNet and SqueezeNet 1.1, calibrated linear layers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

Network = Literal["alex", "squeeze"]
MIN_SIDE = 32
"""Smallest side in pixels for which the deepest layer of both backbones is not empty."""

# Normalisation of inputs in [-1, 1], from LPIPS.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class LPIPS(nn.Module):
    """Learned perceptual distance of two pictures.

    Features after each tapped ReLU are normalised to unit length over the channels; squared differences are
    weighted by the linear layer and averaged over the picture. `wildgs.evaluation.lpips_weights` loads the weights.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network: Network = network
        self.features, self.taps, widths = _alexnet() if network == "alex" else _squeezenet()
        self.linear = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in widths])
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        self.requires_grad_(False).eval()

    def load(self, backbone: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        """Loads weights in the layouts of torchvision and LPIPS.

        Args:
            backbone: State dict of torchvision, of the whole network or of its `features`.
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
        """Distance of two pictures: 0 if they are equal, about 0.7 if they are unrelated.

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


class _Fire(nn.Module):
    """Fire module of SqueezeNet, with the parameter names of torchvision."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        x = F.relu(self.squeeze(x))
        return torch.cat([F.relu(self.expand1x1(x)), F.relu(self.expand3x3(x))], dim=1)


def _alexnet() -> tuple[nn.Sequential, tuple[int, ...], tuple[int, ...]]:
    """Layers as in torchvision, indices of the tapped layers, and their widths."""
    features = nn.Sequential(
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
    return features, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256)


def _squeezenet() -> tuple[nn.Sequential, tuple[int, ...], tuple[int, ...]]:
    """Layers as in torchvision, indices of the tapped layers, and their widths."""
    features = nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(64, 16, 64),
        _Fire(128, 16, 64),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(128, 32, 128),
        _Fire(256, 32, 128),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(256, 48, 192),
        _Fire(384, 48, 192),
        _Fire(384, 64, 256),
        _Fire(512, 64, 256),
    )
    return features, (1, 4, 7, 9, 10, 11, 12), (64, 128, 256, 384, 384, 512, 512)
