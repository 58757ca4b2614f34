"""The fusion network M^F (paper, Hierarchical Appearance Modeling), which predicts spherical harmonics."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from wildgs import features
from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.config import FusionConfig
from wildgs.model.precision import MixedModule

PARTS = 128
LEAST_ROWS = 64 * PARTS
"""Smallest number of rows for `SplitLinear`."""


def linear_over_rows(
    rows: Float[Tensor, "N I"], weight: Float[Tensor, "O I"], bias: Float[Tensor, " O"]
) -> Float[Tensor, "N O"]:
    """``rows @ weight.T + bias``, one row per Gaussian, in the precision of the rows or of autocast."""
    if rows.is_cuda and len(rows) >= LEAST_ROWS and features.is_on("split_weights"):
        return SplitLinear.apply(rows, weight.to(rows.dtype), bias.to(rows.dtype))
    return functional.linear(rows, weight, bias)


class SplitLinear(torch.autograd.Function):
    """`torch.nn.functional.linear` whose weight gradient is summed in `PARTS` parts, for operands of one dtype.

    The gradient of a small weight matrix (64 x 48) is a reduction over all Gaussians. As one product it has a
    single output tile, which occupies few of a GPU's multiprocessors.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Computes [N, O] from rows [N, I], weight [O, I] and bias [O]."""
        ctx.save_for_backward(rows, weight)
        return functional.linear(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Gradients of rows, weight and bias."""
        rows, weight = ctx.saved_tensors
        gradient = gradients[0].to(rows.dtype)
        by_rows = gradient @ weight if ctx.needs_input_grad[0] else None
        whole = len(rows) // PARTS * PARTS
        parts = (
            gradient[:whole].view(PARTS, -1, weight.shape[0]),
            rows[:whole].view(PARTS, -1, weight.shape[1]),
        )
        sums = torch.bmm(parts[0].transpose(1, 2), parts[1]).sum(0, dtype=torch.float32)
        by_weight = sums + (gradient[whole:].T @ rows[whole:]).float()
        return by_rows, by_weight.to(weight.dtype), gradient.sum(0)


class Fusion(MixedModule):
    """sh_i = M^F(Emb^g ⊕ Emb^l_i ⊕ f^in_i), shared by all Gaussians.

    A linear skip connection leads from the intrinsic feature to the output. Initially it copies the feature's first
    three entries, which `initial_intrinsic` sets to the colour of the SfM point, to SH degree 0, and the hidden
    layers add little, so that training starts near the colours of the point cloud. The photo's colour transform,
    initially the identity, is applied to the output.
    """

    def __init__(self, config: FusionConfig, global_size: int, local_size: int) -> None:
        super().__init__()
        self.config = config
        self.coefficients = (config.sh_degree + 1) ** 2
        outputs = 3 * self.coefficients
        self.first_global = nn.Linear(global_size, config.hidden)
        self.first_rows = nn.Linear(local_size + config.intrinsic_size, config.hidden, bias=False)
        self.second = nn.Linear(config.hidden, config.hidden)
        self.output = nn.Linear(config.hidden, outputs)
        self.direct = nn.Linear(config.intrinsic_size, outputs, bias=False) if config.direct_path else None
        with torch.no_grad():
            self.output.weight.mul_(config.output_scale)
            self.output.bias.zero_()
            if self.direct is not None:
                self.direct.weight.zero_()
                self.direct.weight[:3, :3] = torch.eye(3)
        self.transform = nn.Linear(global_size, 12) if config.color_transform else None
        if self.transform is not None:
            nn.init.zeros_(self.transform.weight)
            nn.init.zeros_(self.transform.bias)

    def initial_intrinsic(self, colors: Float[Tensor, "P 3"]) -> Float[Tensor, "P I"]:
        """Initial intrinsic features: the SH coefficients of the colours, followed by small noise."""
        rows = 0.1 * torch.randn(len(colors), self.config.intrinsic_size)
        rows[:, :3] = rgb_to_sh0(colors)
        return rows

    def forward(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embeddings: Float[Tensor, "N L"],
        intrinsic: Float[Tensor, "N I"],
        color_map: Float[Tensor, "3 4"] | None = None,
    ) -> Float[Tensor, "N K 3"]:
        """SH coefficients of every Gaussian.

        The first layer is split, since the contribution of the global embedding is the same for all Gaussians.

        Args:
            global_embedding: Emb^g.
            local_embeddings: Emb^l.
            intrinsic: f^in.
            color_map: Another colour transform [A | b], applied after the predicted one.
        """
        output, direct, bias = self._last_layers(self._change(global_embedding, color_map))
        with self.mixed(intrinsic.device):
            hidden = self._first_layer(global_embedding, local_embeddings, intrinsic).relu_()
            hidden = linear_over_rows(hidden, self.second.weight, self.second.bias).relu_()
            fused = linear_over_rows(hidden, output, bias)
        fused = fused.float()
        if direct is not None:  # in full precision, because it contains the base colour
            fused = torch.addmm(fused, intrinsic, direct.T)
        return fused.reshape(-1, self.coefficients, 3)

    def _first_layer(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embeddings: Float[Tensor, "N L"],
        intrinsic: Float[Tensor, "N I"],
    ) -> Float[Tensor, "N H"]:
        """The first layer before its ReLU."""
        of_all, weight = self.first_global(global_embedding), self.first_rows.weight
        intrinsic = intrinsic.to(self.precision)
        if local_embeddings.stride(0) == 0 and len(local_embeddings) > 1:  # the expanded v, the same for all
            local = local_embeddings.shape[1]
            of_all = of_all + functional.linear(local_embeddings[:1], weight[:, :local])[0]
            return linear_over_rows(intrinsic, weight[:, local:], of_all)
        # Converted before concatenation, which would otherwise copy both in full precision.
        rows = torch.cat([local_embeddings.to(self.precision), intrinsic], dim=1)
        return linear_over_rows(rows, weight, of_all)

    def _change(
        self, global_embedding: Float[Tensor, " G"], color_map: Float[Tensor, "3 4"] | None
    ) -> Float[Tensor, "3 4"] | None:
        """The colour transform followed by the colour map as one transform [A | b]; None if there is neither."""
        if self.transform is None:
            return color_map
        first = self.transform(global_embedding)
        change = torch.cat([first[:9].reshape(3, 3), first[9:, None]], dim=1)
        if color_map is None:
            return change
        return change + color_map + color_map[:, :3] @ change

    def _last_layers(
        self, change: Float[Tensor, "3 4"] | None
    ) -> tuple[Float[Tensor, "O H"], Float[Tensor, "O I"] | None, Float[Tensor, " O"]]:
        """Weights of the output and the skip connection, and their bias, multiplied by a colour transform.

        All three are linear, so the transform ``c + A c + b`` needs no pass over the Gaussians.
        """
        output, bias = self.output.weight, self.output.bias
        direct = None if self.direct is None else self.direct.weight
        if change is None:
            return output, direct, bias
        matrix = torch.eye(3, dtype=change.dtype, device=change.device) + change[:, :3]
        # SH colours are relative to grey (0.5), which the transform changes as well.
        flat = rgb_to_sh0(matrix @ torch.full_like(change[:, 3], 0.5) + change[:, 3])

        def colors_mapped(weight: Float[Tensor, "O X"]) -> Float[Tensor, "O X"]:
            return (matrix @ weight.reshape(self.coefficients, 3, -1)).reshape(weight.shape)

        offset = torch.cat([flat, flat.new_zeros(3 * self.coefficients - 3)])
        mapped = None if direct is None else colors_mapped(direct)
        return colors_mapped(output), mapped, colors_mapped(bias[:, None])[:, 0] + offset
