"""UNet blocks of 2D Parsing and 3D Wrapping."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

LEAST_SPREAD = 1e-4
"""Outputs with a smaller standard deviation over the samples are not scaled."""


class ConvBlock(nn.Module):
    """Two 3x3 convolutions with leaky ReLUs.

    There is no normalisation, because the networks have to preserve absolute brightness and must not depend on
    batch statistics.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        for layer in (self.first, self.second):
            nn.init.kaiming_normal_(layer.weight, a=0.1, nonlinearity="leaky_relu")
            layer.bias.data.zero_()  # pyright: ignore[reportOptionalMemberAccess]

    def forward(self, x: Float[Tensor, "B I H W"]) -> Float[Tensor, "B O H W"]:
        """Features at the same resolution."""
        x = functional.leaky_relu(self.first(x), 0.1, inplace=True)
        return functional.leaky_relu(self.second(x), 0.1, inplace=True)


class UpBlock(nn.Module):
    """Doubles the resolution to that of the skip connection and merges with it."""

    def __init__(self, inputs: int, skip: int, outputs: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(inputs, outputs, 1)
        self.merge = ConvBlock(outputs + skip, outputs)

    def forward(
        self, x: Float[Tensor, "B I h w"], skip: Float[Tensor, "B S H W"]
    ) -> Float[Tensor, "B O H W"]:
        """Features at the skip connection's resolution."""
        x = functional.interpolate(self.reduce(x), size=skip.shape[-2:], mode="bilinear", align_corners=False)
        return self.merge(torch.cat([x, skip.to(x.dtype)], dim=1))


class UNet(nn.Module):
    """A plain UNet with `widths[0]` channels at full resolution; each further level halves the resolution."""

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.down = nn.ModuleList()
        for width in widths:
            self.down.append(ConvBlock(inputs, width))
            inputs = width
        self.up = nn.ModuleList(
            UpBlock(below, width, width)
            for width, below in zip(reversed(widths[:-1]), reversed(widths[1:]), strict=True)
        )
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Float[Tensor, "B I H W"]) -> Float[Tensor, "B O H W"]:
        """Features at the input's resolution."""
        skips = []
        for index, block in enumerate(self.down):
            x = block(x if index == 0 else functional.max_pool2d(x, 2, ceil_mode=True))
            skips.append(x)
        skips.pop()
        for block in self.up:
            x = block(x, skips.pop())
        return self.head(x)


@torch.no_grad()
def standardize_output(layer: nn.Linear, samples: Float[Tensor, "B O"]) -> None:
    """Scales a layer so that its outputs, of which `samples` are examples, have mean 0 and standard deviation 1.

    A data-dependent initialisation after Mishkin and Matas 2016 ('All you need is a good init').
    """
    spread = samples.std(dim=0)
    spread = spread.where(spread > LEAST_SPREAD, 1.0)
    layer.weight.div_(spread[:, None])
    layer.bias.sub_(samples.mean(dim=0)).div_(spread)
