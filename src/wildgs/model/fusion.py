"""The fusion network M^F (paper, Hierarchical Appearance Modeling), which predicts spherical harmonics."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.config import FusionConfig
from wildgs.model.fused_layers import fused_layers
from wildgs.model.fusion_layers import layers_over_rows, linear_over_rows
from wildgs.model.gaussians import take_rows
from wildgs.model.precision import MixedModule
from wildgs.rasterize.cpu.simd import has_avx512


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
        self.sky: Fusion | None = None
        """Network of the sky's Gaussians, which have no local embeddings; None: they share this one."""

    def separate_sky(self) -> None:
        """Gives the sky's Gaussians a network of their own. Not in the paper."""
        self.sky = Fusion(self.config, self.first_global.in_features, local_size=0)

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
        rows = intrinsic
        if _is_shared(local_embeddings):
            weights = self._layers(global_embedding, local_embeddings[0], color_map)
            if not intrinsic.is_cuda:
                fused = layers_over_rows(intrinsic, *weights, precision=self.precision)
                return fused.reshape(-1, self.coefficients, 3)
            first, first_bias, second, second_bias, output, bias, direct = weights
        else:
            output, direct, bias = self._last_layers(self._change(global_embedding, color_map))
            first, first_bias = self.first_rows.weight, self.first_global(global_embedding)
            second, second_bias = self.second.weight, self.second.bias
            # Converted before concatenation, which would otherwise copy both in full precision.
            rows = torch.cat([local_embeddings.to(self.precision), intrinsic.to(self.precision)], dim=1)
        with self.mixed(intrinsic.device):
            hidden = linear_over_rows(rows.to(self.precision), first, first_bias).relu_()
            hidden = linear_over_rows(hidden, second, second_bias).relu_()
            fused = linear_over_rows(hidden, output, bias)
        fused = fused.float()
        if direct is not None:  # in full precision, because it contains the base colour
            fused = torch.addmm(fused, intrinsic, direct.T)
        return fused.reshape(-1, self.coefficients, 3)

    def by_region(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embeddings: Float[Tensor, "V L"],
        landmark: Float[Tensor, "A I"],
        sky: Float[Tensor, "B I"],
    ) -> Float[Tensor, "V K 3"]:
        """SH coefficients of the landmark's Gaussians, followed by those of the sky.

        Args:
            global_embedding: Emb^g.
            local_embeddings: Emb^l of all Gaussians in this order.
            landmark: f^in of the landmark's Gaussians.
            sky: f^in of the sky's Gaussians.
        """
        if self.sky is None:
            return self(global_embedding, local_embeddings, torch.cat([landmark, sky]))
        below = self(global_embedding, local_embeddings[: len(landmark)], landmark)
        if not len(sky):
            return below
        return torch.cat([below, self.sky(global_embedding, _no_local(sky), sky)])

    def of_rows(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embeddings: Float[Tensor, "V L"],
        intrinsic: Float[Tensor, "N I"],
        rows: Int[Tensor, " V"],
        landmark: int,
        codes: Float[Tensor, "C I"] | None,
    ) -> tuple[Float[Tensor, "V K 3"], Float[Tensor, "A C"]]:
        """`by_region` of some of all Gaussians, and a linear function of the features of the landmark's.

        Args:
            global_embedding: Emb^g.
            local_embeddings: Emb^l of the rows.
            intrinsic: f^in of all Gaussians.
            rows: Indices of the landmark's Gaussians, followed by those of the sky's.
            landmark: Number of the former, A.
            codes: Weights of the linear function; None for C = 0.
        """
        if intrinsic.is_cuda or not _is_shared(local_embeddings) or not has_avx512():
            below, above = take_rows(intrinsic, rows).split([landmark, len(rows) - landmark])
            harmonics = self.by_region(global_embedding, local_embeddings, below, above)
            return harmonics, below[:, :0] if codes is None else functional.linear(below, codes)
        weights = self._layers(global_embedding, local_embeddings[0])
        regions = [(rows[:landmark], (*weights, codes))]
        if landmark < len(rows):
            if self.sky is not None:
                weights = self.sky._layers(global_embedding, local_embeddings[0, :0])
            regions.append((rows[landmark:], (*weights, None)))
        harmonics, found = fused_layers(intrinsic, regions)
        if codes is None:
            found = intrinsic.new_empty(landmark, 0)
        return harmonics.reshape(-1, self.coefficients, 3), found

    def with_sky(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embeddings: Float[Tensor, "N L"],
        intrinsic: Float[Tensor, "N I"],
        which: Bool[Tensor, " N"] | None,
        color_map: Float[Tensor, "3 4"] | None = None,
    ) -> Float[Tensor, "N K 3"]:
        """Like `by_region` for Gaussians in any order.

        Args:
            global_embedding: Emb^g.
            local_embeddings: Emb^l.
            intrinsic: f^in.
            which: Sky Gaussians; None if there are none.
            color_map: As in `forward`.
        """
        harmonics = self(global_embedding, local_embeddings, intrinsic, color_map)
        if self.sky is None or which is None:
            return harmonics
        rows = which.nonzero()[:, 0]
        above = intrinsic[rows]
        return harmonics.index_copy(0, rows, self.sky(global_embedding, _no_local(above), above, color_map))

    def _layers(
        self,
        global_embedding: Float[Tensor, " G"],
        local_embedding: Float[Tensor, " L"],
        color_map: Float[Tensor, "3 4"] | None = None,
    ) -> tuple[Any, ...]:
        """Weights of the layers where both embeddings are the same for all Gaussians, for `layers_over_rows`.

        Some hundred small operations, forward and backward, which CUDA graphs replay.
        """
        embeddings, size = torch.cat([global_embedding, local_embedding]), len(local_embedding)
        if color_map is None:
            networks = [self.first_global, self.first_rows, self.output, self.direct, self.transform]
            used = [network for network in networks if network is not None]
            first, first_bias, *last = self.replays(self._weights, used, embeddings, (size,))
        else:
            first, first_bias, *last = self._weights(embeddings, size, color_map)
        output, bias, direct = last if self.direct is not None else (*last, None)
        return first, first_bias, self.second.weight, self.second.bias, output, bias, direct

    def _weights(
        self, embeddings: Float[Tensor, " E"], local_size: int, color_map: Float[Tensor, "3 4"] | None = None
    ) -> tuple[Tensor, ...]:
        """W1, b1, W3, b3 and D, unless it is None, for global and local embedding, concatenated."""
        common, local = embeddings.tensor_split((len(embeddings) - local_size,))
        by_local, first = self.first_rows.weight.tensor_split((local_size,), dim=1)
        first_bias = self.first_global(common) + functional.linear(local[None], by_local)[0]
        output, direct, bias = self._last_layers(self._change(common, color_map))
        weights = (first.contiguous(), first_bias, output, bias)
        return weights if direct is None else (*weights, direct)

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


def _is_shared(local_embeddings: Float[Tensor, "N L"]) -> bool:
    """Whether the local embeddings are one embedding, expanded to all Gaussians (the learnt v)."""
    return local_embeddings.stride(0) == 0 and len(local_embeddings) > 1


def _no_local(rows: Float[Tensor, "N I"]) -> Float[Tensor, "N 0"]:
    """Local embeddings of length 0."""
    return rows.new_zeros(1, 0).expand(len(rows), 0)
