"""SqueezeNet 1.1 (Iandola et al. 2016) with the weights that ship with the package.

One file contains torchvision's ImageNet weights of the convolutions and the linear layers of LPIPS, in half
precision. The default encoder of 2D Parsing and LPIPS use them.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import torch
from jaxtyping import Float
from safetensors.torch import load
from torch import Tensor, nn
from torch.nn import functional

WEIGHTS_FILE = "squeezenet1_1_lpips.safetensors"
LPIPS_TAPS = (1, 4, 7, 9, 10, 11, 12)
"""Positions of the layers that LPIPS compares."""
LPIPS_WIDTHS = (64, 128, 256, 384, 384, 512, 512)
"""Channels of those layers."""


class Fire(nn.Module):
    """SqueezeNet's Fire module, with torchvision's parameter names, so that its weights can be loaded."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        """Features at the same resolution, after the ReLU."""
        x = functional.relu(self.squeeze(x))
        return torch.cat([functional.relu(self.expand1x1(x)), functional.relu(self.expand3x3(x))], dim=1)


def squeezenet_layers() -> nn.Sequential:
    """The untrained convolutional layers, at torchvision's positions."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        Fire(64, 16, 64),
        Fire(128, 16, 64),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        Fire(128, 32, 128),
        Fire(256, 32, 128),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        Fire(256, 48, 192),
        Fire(384, 48, 192),
        Fire(384, 64, 256),
        Fire(512, 64, 256),
    )


@cache
def packaged_weights() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weights of the convolutions (torchvision's names) and of LPIPS's linear layers (its names) in float32."""
    data = (resources.files("wildgs") / "weights" / WEIGHTS_FILE).read_bytes()
    tensors = {name: value.float() for name, value in load(data).items()}
    prefix = "features."
    layers = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
    return layers, {name: value for name, value in tensors.items() if not name.startswith(prefix)}
