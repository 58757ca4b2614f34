"""2D Parsing (paper, figure 2 left): visibility mask and global appearance embedding of a photo."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from wildgs.model.config import ParsingConfig
from wildgs.model.encoder import Encoder, SqueezeNetEncoder, load_encoder
from wildgs.model.precision import MixedModule
from wildgs.model.unet import LEAST_SPREAD, UpBlock, standardize_output

Shapes = tuple[tuple[int, ...], ...]
Packed = tuple[Tensor, Shapes]


def pack(tensors: Sequence[Tensor]) -> Packed:
    """Flattens and concatenates tensors of one dtype; returns the result and their shapes."""
    return torch.cat([tensor.flatten() for tensor in tensors]), tuple(tuple(t.shape) for t in tensors)


def unpack(joined: Tensor, shapes: Shapes) -> list[Tensor]:
    """The inverse of `pack`, as views."""
    parts = joined.split([math.prod(shape) for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]


class FeatureCache:
    """Caches the features of the first photos that fit.

    A least-recently-used cache would evict most entries just before their next use, since photos are trained in
    shuffled epochs.

    Attributes:
        limit: Limit of the memory in bytes.
        num_bytes: Memory in use, bytes.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.num_bytes = 0
        self._kept: dict[Hashable, Packed] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable) -> Packed | None:
        """The cached features, or None."""
        return self._kept.get(key)

    def put(self, key: Hashable, features: Packed) -> None:
        """Caches features if they fit."""
        size = features[0].nbytes
        if key not in self._kept and self.num_bytes + size <= self.limit:
            self._kept[key] = features
            self.num_bytes += size


CALIBRATION_SIDE = 224
SIDE_STEP = 32
LEAST_SIDE = 64
"""Smallest side of the encoder's input. With 32 pixels its deepest map would be one pixel wide, for which oneDNN's
bfloat16 convolution (3 x 3, stride 2, hundreds of channels; torch 2.13) reads uninitialised memory."""

OPPONENTS = ((1 / 3, 1 / 3, 1 / 3), (0.5, -0.5, 0.0), (-0.25, -0.25, 0.5))
"""Opponent colours: brightness, red-green and blue-yellow, so that a colour cast is separate from brightness."""

STATISTICS = 2 * len(OPPONENTS)
STATIC_BIAS = 2.0
"""Initial logit of the mask (M = 0.88), so that nearly everything is static at first."""
LOGIT_BOUND = 6.0
"""Bound of the mask's logits, which keeps M within 0.0025 and 0.9975, where the sigmoid has a usable gradient."""


class _Bounded(torch.autograd.Function):
    """Clamps logits, but passes gradients that point back inside the bounds."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(logits)
        return logits.clamp(-LOGIT_BOUND, LOGIT_BOUND)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (logits,) = ctx.saved_tensors
        outwards = (logits.abs() > LOGIT_BOUND) & (gradient * logits < 0)
        return torch.where(outwards, 0.0, gradient)


class Parsing(MixedModule):
    """UNet on an encoder's features: Emb^g = M^G(AvgPooling(F)), M = sigmoid(decoder).

    Attributes:
        feature_cache: Cache for features of a frozen encoder in training; None computes them every time.
    """

    opponents: Tensor
    feature_cache: FeatureCache | None = None

    def __init__(self, config: ParsingConfig, encoder: Encoder | None = None) -> None:
        """Creates the network; `encoder` replaces the configured one."""
        super().__init__()
        self.config = config
        self.encoder = encoder or load_encoder(config.encoder)
        self.register_buffer("opponents", torch.tensor(OPPONENTS), persistent=False)
        deep = self.encoder.widths[-1]
        summary = deep + (STATISTICS if config.color_statistics else 0)
        self.global_mlp = nn.Sequential(
            nn.Linear(summary, 64), nn.LeakyReLU(0.1), nn.Linear(64, config.global_size)
        )
        widths = (deep, *config.decoder_widths)
        self.decoder = nn.ModuleList(
            UpBlock(widths[level], self.encoder.widths[-2 - level], widths[level + 1]) for level in range(3)
        )
        self.mask_head = nn.Conv2d(widths[-1], 1, 1)
        nn.init.zeros_(self.mask_head.weight)
        self.mask_head.bias.data.fill_(STATIC_BIAS)  # pyright: ignore[reportOptionalMemberAccess]

    def forward(
        self,
        photo: Float[Tensor, "H W 3"],
        *,
        learn_encoder: bool = True,
        learn_mask: bool = True,
        name: str | None = None,
    ) -> tuple[Float[Tensor, "H W"], Float[Tensor, " G"]]:
        """Parses one photo.

        Args:
            photo: RGB in [0, 1].
            learn_encoder: Whether the encoder gets gradients.
            learn_mask: Whether gradients pass through the mask.
            name: Key for caching features of a frozen encoder; None does not cache.

        Returns:
            The visibility mask M (1 = static, 0 = transient) and the global embedding Emb^g.
        """
        networks = (self.encoder, self.decoder, self.mask_head, self.global_mlp)
        function: Callable[..., tuple[Tensor, Tensor]]
        settings: tuple[Any, ...]
        if self.encoder.frozen:
            packed, shapes = self._frozen_features(photo, name)
            function, image, settings = self._after_frozen, packed, (shapes, learn_mask)
        else:
            function, image, settings = self._networks, self.shrink(photo), (learn_encoder, learn_mask)
        coarse, embedding = self.replays(function, networks, image, settings)
        logits = functional.interpolate(coarse, size=photo.shape[:2], mode="bilinear", align_corners=False)
        bounded = _Bounded.apply(logits[0, 0]) if self.config.bounded_logits else logits[0, 0]
        return bounded.sigmoid(), embedding

    @torch.no_grad()
    def place_features(
        self, photo: Float[Tensor, "H W 3"], name: str | None = None
    ) -> Float[Tensor, "C h w"]:
        """The two finest feature maps of a frozen encoder, at an eighth of the size at which photos are parsed.

        Args:
            photo: RGB in [0, 1].
            name: Key for caching, see `forward`.
        """
        assert isinstance(self.encoder, SqueezeNetEncoder)
        *raw, _ = unpack(*self._frozen_features(photo, name))
        fine, coarse = self.encoder.standardize(raw)[:2]
        fine = functional.interpolate(fine, size=coarse.shape[2:], mode="bilinear", align_corners=False)
        # Both maps count the same, whatever their number of channels.
        return torch.cat([x[0] / len(x[0]) ** 0.5 for x in (fine, coarse)])

    def _networks(
        self, image: Float[Tensor, "1 3 h w"], learn_encoder: bool, learn_mask: bool
    ) -> tuple[Float[Tensor, "1 1 u v"], Float[Tensor, " G"]]:
        """The mask's logits at a quarter of the resolution, and Emb^g, with a trainable encoder."""
        with self.mixed(image.device), torch.set_grad_enabled(torch.is_grad_enabled() and learn_encoder):
            features = self.encoder(image)
        return self._decode(features, self._summary(image, features[-1]), learn_mask)

    def _frozen_features(self, photo: Float[Tensor, "H W 3"], name: str | None) -> Packed:
        """A frozen encoder's features and the colour statistics of a photo, packed into one tensor."""
        assert isinstance(self.encoder, SqueezeNetEncoder)
        key = None if name is None else (name, *photo.shape[:2])
        found = None if key is None or self.feature_cache is None else self.feature_cache.get(key)
        if found is None:
            image = self.shrink(photo)
            found = pack([*self.encoder.raw(image), self._statistics(image).half()])
            if key is not None and self.feature_cache is not None:
                self.feature_cache.put(key, found)
        return found

    def _after_frozen(
        self, packed: Tensor, shapes: Shapes, learn_mask: bool
    ) -> tuple[Float[Tensor, "1 1 u v"], Float[Tensor, " G"]]:
        """Like `_networks`, from `_frozen_features`."""
        assert isinstance(self.encoder, SqueezeNetEncoder)
        *raw, statistics = unpack(packed, shapes)
        features = self.encoder.standardize(raw)
        summary = features[-1].mean(dim=(2, 3))
        if self.config.color_statistics:
            summary = torch.cat([summary, statistics.float()], dim=1)
        return self._decode(features, summary, learn_mask)

    def _decode(
        self, features: Sequence[Tensor], summary: Float[Tensor, "1 S"], learn_mask: bool
    ) -> tuple[Float[Tensor, "1 1 u v"], Float[Tensor, " G"]]:
        """The mask's logits at a quarter of the resolution, and Emb^g, from the encoder's features."""
        x = features[-1]
        with self.mixed(x.device), torch.set_grad_enabled(torch.is_grad_enabled() and learn_mask):
            for block, skip in zip(self.decoder, features[-2:-5:-1], strict=True):
                x = block(x, skip)
            coarse = self.mask_head(x)
        return coarse.float(), self.global_mlp(summary)[0]

    def _summary(self, images: Float[Tensor, "B 3 H W"], deepest: Tensor) -> Float[Tensor, "B S"]:
        """Input of M^G: the mean of the deepest features and, if configured, the colour statistics."""
        pooled = deepest.float().mean(dim=(2, 3))
        return (
            torch.cat([pooled, self._statistics(images)], dim=1) if self.config.color_statistics else pooled
        )

    def _statistics(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B T"]:
        """Mean and standard deviation of the photos' colours."""
        opponents = torch.einsum("oc, bchw -> bohw", self.opponents, images)
        spread, mean = torch.std_mean(opponents, dim=(2, 3), correction=0)
        return torch.cat([mean, spread], dim=1)

    @torch.no_grad()
    def calibrate(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Initialises normalisation from photos of the collection.

        Sets the encoder's normalisation statistics (a pretrained ResNet keeps its own). Scales the first layer of
        M^G so that its input, and the last so that Emb^g, has mean 0 and variance 1 over the photos. Pooled
        features of different photos are nearly the same vector, so that otherwise the embedding would stay
        uninformative for many steps.
        """
        side = max(LEAST_SIDE, min(self.config.max_side, CALIBRATION_SIDE))
        squares = torch.cat(
            [
                functional.interpolate(photo.permute(2, 0, 1)[None], size=(side, side), mode="bilinear")
                for photo in photos
            ]
        )
        self.encoder.calibrate(squares)
        if len(photos) > 1:
            first, last = self.global_mlp[0], self.global_mlp[-1]
            assert isinstance(first, nn.Linear)
            assert isinstance(last, nn.Linear)
            summary = self._summary(squares, self.encoder(squares)[-1])
            deep = self.encoder.widths[-1]
            _standardize_input(first, summary, slice(0, deep))
            for each in range(deep, summary.shape[1]):
                # Scaled so that these few statistics have the same total variance as the many features.
                first.weight[:, each].mul_((deep / STATISTICS) ** 0.5)
                _standardize_input(first, summary, slice(each, each + 1))
            standardize_output(last, self.global_mlp(summary))

    def shrink(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        """The photo as a batch of one, at most `max_side` long, with sides that are multiples of `SIDE_STEP`.

        This reduces the number of different sizes, because libraries prepare (on CPUs compile) a convolution for
        every new size. The aspect ratio changes slightly; the mask is resized to that of the photo.
        """
        image = photo.permute(2, 0, 1)[None]
        factor = min(1.0, self.config.max_side / max(photo.shape[:2]))
        most = max(LEAST_SIDE, self.config.max_side // SIDE_STEP * SIDE_STEP)
        height, width = (
            min(most, max(LEAST_SIDE, round(side * factor / SIDE_STEP) * SIDE_STEP))
            for side in photo.shape[:2]
        )
        if (height, width) == tuple(photo.shape[:2]):
            return image
        return functional.interpolate(image, size=(height, width), mode="bilinear", antialias=True)


def keep_features(module: nn.Module, cache: FeatureCache | None) -> None:
    """Sets the feature cache of 2D Parsing inside a module; None disables it."""
    for part in module.modules():
        if isinstance(part, Parsing):
            part.feature_cache = cache


def _standardize_input(layer: nn.Linear, samples: Float[Tensor, "B I"], part: slice) -> None:
    """Folds a standardisation of the inputs in `part` into a layer: mean 0, and variance 1 on average.

    All inputs share one factor, since features that vary little between photos are mostly noise, and amplifying
    them would let the layer overfit single photos. Nothing changes if the samples are all the same.
    """
    samples = samples[:, part]
    mean = samples.mean(dim=0)
    spread = (samples - mean).square().mean().sqrt()
    if spread < LEAST_SPREAD:
        return
    layer.weight[:, part].div_(spread.clamp_min(0.01 * float(samples.abs().mean())))
    layer.bias.sub_(layer.weight[:, part] @ mean)
