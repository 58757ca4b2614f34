"""A photo beside what the model makes of its viewpoint: render, mask and depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.evaluation.metrics import psnr
from wildgs.exporters.depth_colors import color_depth, tint_hidden
from wildgs.light.look import Look
from wildgs.scene import View
from wildgs.viewer.subject import Subject

LONG_SIDE = 480
"""Pictures are computed no larger: they are shown small."""

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Comparison:
    """Pictures of one viewpoint, all of one size.

    Attributes:
        name: The photo's.
        photo: As it was taken.
        render: The scene from there.
        mask: The photo with red where the model takes it for transient; None without a mask.
        depth: Near is bright.
        psnr: Of the render against the photo, passers-by and all, in dB.
        light: The name of the render's light.
    """

    name: str
    photo: Picture
    render: Picture
    mask: Picture | None
    depth: Picture
    psnr: float
    light: str


@torch.no_grad()
def compare(subject: Subject, view: View, look: Look) -> Comparison:
    """Renders a photo's viewpoint under a light."""
    shrink = min(1.0, LONG_SIDE / max(view.camera.width, view.camera.height))
    width, height = (max(1, round(side * shrink)) for side in (view.camera.width, view.camera.height))
    photo = _resized(view.read_photo(), width, height)
    render, rendering = subject.render(view.camera.resized(width, height), look)
    depth = torch.where(rendering.alpha > 0.5, rendering.depth, 0.0)
    visibility = subject.visibility(view)
    return Comparison(
        name=view.name,
        photo=photo.numpy(),
        render=render.numpy(),
        mask=None
        if visibility is None
        else tint_hidden(photo.numpy(), _resized_mask(visibility, width, height)),
        depth=color_depth(depth.double().cpu().numpy()),
        psnr=psnr(render, photo),
        light=look.name,
    )


def _resized(photo: UInt8[Tensor, "H W 3"], width: int, height: int) -> UInt8[Tensor, "h w 3"]:
    values = photo.permute(2, 0, 1)[None].float()
    small = torch.nn.functional.interpolate(values, (height, width), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8)


def _resized_mask(mask: Float[Tensor, "H W"], width: int, height: int) -> Float[np.ndarray, "h w"]:
    small = torch.nn.functional.interpolate(
        mask[None, None], (height, width), mode="bilinear", antialias=True
    )
    return small[0, 0].numpy()
