"""The ResNet-18 that 2D Parsing reads photos with (paper, appendix B)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from wildgs.errors import UserError, WildGSWarning
from wildgs.hub import hub_reachable
from wildgs.model.config import RESNET18

if TYPE_CHECKING:
    from transformers import ResNetModel

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
FEATURE_WIDTHS = (64, 64, 128, 256, 512)


class FrozenBatchNorm(nn.Module):
    """Batch normalisation with statistics that never change after `calibrate` or loading.

    The function of a photo is then the same in training and at test time, whatever else is in the batch, and
    absolute brightness passes through it, which group or instance normalisation would remove.
    """

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, norm: nn.BatchNorm2d) -> None:
        super().__init__()
        self.eps = norm.eps
        self.weight = nn.Parameter(norm.weight.detach().clone())
        self.bias = nn.Parameter(norm.bias.detach().clone())
        mean, var = norm.running_mean, norm.running_var
        assert mean is not None
        assert var is not None
        self.register_buffer("running_mean", mean.clone())
        self.register_buffer("running_var", var.clone())
        self.calibrating = False

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Scaled and shifted features."""
        if self.calibrating:
            mean = x.mean(dim=(0, 2, 3))
            # A single value (one small photo, deepest level) has no unbiased variance.
            var = x.var(dim=(0, 2, 3), correction=min(1, x[:, 0].numel() - 1))
            self.running_mean.copy_(mean)
            # What hardly varies (blank photos) is not blown up: every other photo would then be far off.
            self.running_var.copy_(var.where(var > 1e-4 * (1 + mean.square()), 1.0))
        if x.device.type != "cpu":
            # One kernel each way; on CPUs it is the slower one.
            return functional.batch_norm(
                x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        scale = self.weight * (self.running_var + self.eps).rsqrt()
        shift = self.bias - self.running_mean * scale
        return torch.addcmul(shift.to(x.dtype)[:, None, None], x, scale.to(x.dtype)[:, None, None])


class Encoder(nn.Module):
    """ResNet-18 without its classifier; gives the feature maps of the stem and the four stages.

    Attributes:
        pretrained: Whether the weights are ImageNet's.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, resnet: ResNetModel, pretrained: bool) -> None:
        super().__init__()
        self.embedder = resnet.embedder
        self.stages = resnet.encoder.stages
        self.pretrained = pretrained
        _freeze_norms(self)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Feature maps from 1/4 (stem, first stage) to 1/32 of the resolution; widths `FEATURE_WIDTHS`.

        Args:
            images: RGB in [0, 1].
        """
        features = [self.embedder((images - self.mean) / self.std)]
        for stage in self.stages:
            features.append(stage(features[-1]))
        return features

    @torch.no_grad()
    def calibrate(self, images: Float[Tensor, "B 3 H W"]) -> None:
        """Sets the normalisation statistics of a fresh encoder from photos, once.

        Pretrained encoders keep the statistics that they came with.
        """
        if self.pretrained:
            return
        norms = [m for m in self.modules() if isinstance(m, FrozenBatchNorm)]
        for norm in norms:
            norm.calibrating = True
        self(images)
        for norm in norms:
            norm.calibrating = False


def load_encoder(source: str | None = RESNET18) -> Encoder:
    """ResNet-18 from a folder, the Hugging Face cache, or the hub, in this order.

    Where none of them has the weights, one `WildGSWarning` says what is lost, and the encoder starts fresh.

    Args:
        source: A folder in the hub's layout, a hub name, or None for a fresh encoder without a warning.

    Raises:
        UserError: `source` is an existing folder that does not hold a ResNet-18.
    """
    from transformers import ResNetConfig, ResNetModel

    if source is not None:
        resnet = _pretrained_resnet(source)
        if resnet is not None:
            return Encoder(resnet, pretrained=True)
        warnings.warn(
            f"no ImageNet weights for the encoder ({source} is neither cached nor reachable): masks and global "
            f"embeddings are learnt from scratch and will be weaker; get them with `hf download {source}`",
            WildGSWarning,
            stacklevel=2,
        )
    config = ResNetConfig(
        embedding_size=64, hidden_sizes=list(FEATURE_WIDTHS[1:]), depths=[2, 2, 2, 2], layer_type="basic"
    )
    return Encoder(ResNetModel(config), pretrained=False)


def _pretrained_resnet(source: str) -> ResNetModel | None:
    from transformers import ResNetModel

    if Path(source).is_dir():
        try:
            resnet = ResNetModel.from_pretrained(source, local_files_only=True, use_safetensors=True)
        except (OSError, ValueError, RuntimeError) as error:
            raise UserError(f"{source} does not hold a ResNet-18 in the hub's layout: {error}") from error
        if tuple(resnet.config.hidden_sizes or ()) != FEATURE_WIDTHS[1:]:
            raise UserError(f"{source} holds another network than ResNet-18; give the folder of {RESNET18}")
        return resnet
    for local in (True, False):
        if not local and not hub_reachable():
            return None
        try:
            return ResNetModel.from_pretrained(source, local_files_only=local, use_safetensors=True)
        except Exception:  # the hub's client raises many kinds of errors; all of them mean 'not to be had'
            continue
    return None


def _freeze_norms(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, FrozenBatchNorm(child))
        else:
            _freeze_norms(child)
