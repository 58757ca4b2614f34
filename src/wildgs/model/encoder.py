"""Image encoders of 2D Parsing: frozen SqueezeNet, or the fine-tuned ResNet-18 of the paper's appendix B."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from wildgs.errors import UserError, WildGSWarning
from wildgs.hub import hub_reachable
from wildgs.model.config import RESNET18, SQUEEZENET
from wildgs.model.squeezenet import packaged_weights, squeezenet_layers

if TYPE_CHECKING:
    from transformers import ResNetModel

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
RESNET_WIDTHS = (64, 64, 128, 256, 512)
SQUEEZENET_LEVELS = (4, 7, 9, 12)
"""Layers whose features are used, at 1/4, 1/8, 1/16 and 1/16 of the resolution."""
SQUEEZENET_WIDTHS = (128, 256, 384, 512)
LEAST_VARIANCE = 1e-4
"""Lower bound on the variance of a level over the collection, so that blank photos are not amplified."""


class FrozenBatchNorm(nn.Module):
    """Batch normalisation with fixed statistics, set by `calibrate` or loaded.

    Training and test time then behave the same, and unlike with group or instance normalisation the absolute
    brightness is preserved.
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
            # Channels with almost no variance (blank photos) are not amplified.
            self.running_var.copy_(var.where(var > 1e-4 * (1 + mean.square()), 1.0))
        if x.device.type != "cpu":
            # One kernel for each pass; slower on CPUs.
            return functional.batch_norm(
                x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        scale = self.weight * (self.running_var + self.eps).rsqrt()
        shift = self.bias - self.running_mean * scale
        return torch.addcmul(shift.to(x.dtype)[:, None, None], x, scale.to(x.dtype)[:, None, None])


class Encoder(nn.Module):
    """Computes feature maps of photos.

    Attributes:
        widths: Channels of the feature maps.
        frozen: Whether the network is not trained, so that features of a photo can be cached (`FeatureCache`).
        pretrained: Whether the weights are pretrained on ImageNet.
    """

    widths: tuple[int, ...]
    frozen: bool = False
    pretrained: bool = True
    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Feature maps from fine to coarse; the last four are at 1/4, 1/8, 1/16 and 1/16 or less of the resolution.

        Args:
            images: RGB in [0, 1].
        """
        raise NotImplementedError

    def calibrate(self, images: Float[Tensor, "B 3 H W"]) -> None:
        """Sets the normalisation statistics from photos of the collection."""


class SqueezeNetEncoder(Encoder):
    """Frozen SqueezeNet 1.1: four levels of ImageNet features, standardised over the collection.

    The weights ship with the package; checkpoints contain the statistics only.
    """

    widths = SQUEEZENET_WIDTHS
    frozen = True

    def __init__(self) -> None:
        super().__init__()
        layers = squeezenet_layers()
        layers.load_state_dict(packaged_weights()[0])
        # In a tuple, so that it is not a submodule: its weights are neither trained nor stored in checkpoints.
        self._layers = (layers.requires_grad_(False),)
        for level, width in enumerate(self.widths):
            self.register_buffer(f"center{level}", torch.zeros(width))
            self.register_buffer(f"scale{level}", torch.ones(()))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> SqueezeNetEncoder:
        """Moves the weights together with the module."""
        self._layers[0]._apply(fn, recurse)
        return super()._apply(fn, recurse)

    @torch.no_grad()
    def raw(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Features before standardisation, in half precision, so that cached and fresh features are equal."""
        x, levels = (images - self.mean) / self.std, []
        for position, layer in enumerate(self._layers[0]):
            x = layer(x)
            if position in SQUEEZENET_LEVELS:
                levels.append(x.half())
        return levels

    def standardize(self, raw: list[Tensor]) -> list[Tensor]:
        """Standardises `raw` features: mean 0 per channel and variance 1 per level over the collection."""
        return [
            (x.float() - self.get_buffer(f"center{level}")[:, None, None]) * self.get_buffer(f"scale{level}")
            for level, x in enumerate(raw)
        ]

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Standardised features, without gradient."""
        return self.standardize(self.raw(images))

    @torch.no_grad()
    def calibrate(self, images: Float[Tensor, "B 3 H W"]) -> None:
        """Sets the mean of every channel and the variance of every level from photos of the collection.

        All channels of a level share one variance, because amplified channels of low variance would let the
        embedding overfit single photos.
        """
        for level, x in enumerate(self.raw(images)):
            variance, mean = torch.var_mean(x.float(), dim=(0, 2, 3), correction=0)
            self.get_buffer(f"center{level}").copy_(mean)
            self.get_buffer(f"scale{level}").copy_(variance.mean().clamp_min(LEAST_VARIANCE).rsqrt())


class ResNetEncoder(Encoder):
    """ResNet-18 without its classifier, fine-tuned; gives the feature maps of the stem and the four stages."""

    widths = RESNET_WIDTHS

    def __init__(self, resnet: ResNetModel, pretrained: bool) -> None:
        super().__init__()
        self.embedder = resnet.embedder
        self.stages = resnet.encoder.stages
        self.pretrained = pretrained
        _freeze_norms(self)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Feature maps from 1/4 (stem, first stage) to 1/32 of the resolution."""
        features = [self.embedder((images - self.mean) / self.std)]
        for stage in self.stages:
            features.append(stage(features[-1]))
        return features

    @torch.no_grad()
    def calibrate(self, images: Float[Tensor, "B 3 H W"]) -> None:
        """Sets the normalisation statistics of an untrained encoder; a pretrained one keeps its own."""
        if self.pretrained:
            return
        norms = [m for m in self.modules() if isinstance(m, FrozenBatchNorm)]
        for norm in norms:
            norm.calibrating = True
        self(images)
        for norm in norms:
            norm.calibrating = False


def encoder_of(state: Mapping[str, Tensor], prefix: str) -> Encoder:
    """Creates an encoder of the type in a checkpoint, before its tensors are loaded.

    Args:
        state: The checkpoint's tensors.
        prefix: Prefix of the names of the encoder's tensors.
    """
    return SqueezeNetEncoder() if f"{prefix}center0" in state else load_encoder(None)


def load_encoder(source: str | None = SQUEEZENET) -> Encoder:
    """Loads the frozen SqueezeNet, or a ResNet-18 from a folder, the Hugging Face cache or the hub.

    If the weights of the ResNet-18 are not available, warns and initialises them randomly.

    Args:
        source: `SQUEEZENET`; or, for a ResNet-18, a folder in the hub's layout, a name on the hub, or None for
            random weights without a warning.

    Raises:
        UserError: `source` is an existing folder without a ResNet-18.
    """
    if source == SQUEEZENET:
        return SqueezeNetEncoder()
    from transformers import ResNetConfig, ResNetModel

    if source is not None:
        resnet = _pretrained_resnet(source)
        if resnet is not None:
            return ResNetEncoder(resnet, pretrained=True)
        warnings.warn(
            f"no ImageNet weights for the encoder ({source} is neither cached nor reachable): masks and global "
            f"embeddings are learnt from scratch and will be worse; download them by `hf download {source}`",
            WildGSWarning,
            stacklevel=2,
        )
    config = ResNetConfig(
        embedding_size=64, hidden_sizes=list(RESNET_WIDTHS[1:]), depths=[2, 2, 2, 2], layer_type="basic"
    )
    return ResNetEncoder(ResNetModel(config), pretrained=False)


def _pretrained_resnet(source: str) -> ResNetModel | None:
    from transformers import ResNetModel

    if Path(source).is_dir():
        try:
            resnet = ResNetModel.from_pretrained(source, local_files_only=True, use_safetensors=True)
        except (OSError, ValueError, RuntimeError) as error:
            raise UserError(f"{source} does not contain a ResNet-18 in the hub's layout: {error}") from error
        if tuple(resnet.config.hidden_sizes or ()) != RESNET_WIDTHS[1:]:
            raise UserError(
                f"{source} contains another network than ResNet-18; give the folder of {RESNET18}"
            )
        return resnet
    for local in (True, False):
        if not local and not hub_reachable():
            return None
        try:
            return ResNetModel.from_pretrained(source, local_files_only=local, use_safetensors=True)
        except Exception:  # the hub's client raises many types of errors if the network is not available
            continue
    return None


def _freeze_norms(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, FrozenBatchNorm(child))
        else:
            _freeze_norms(child)
