"""The light of photos whose camera is known, and of pictures that borrow one."""

from __future__ import annotations

import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance
from wildgs.model.method import Method
from wildgs.scene import View, find_view, match_view
from wildgs.scene.scene import to_unit

__all__ = ["cover", "encode_photo", "encode_picture", "encode_view", "find_view", "match_view"]


@torch.no_grad()
def encode_view(method: Method, view: View) -> Appearance:
    """The appearance of one of the scene's own photos."""
    device = method.gaussians.means.device
    photo, keep = view.load(device)
    return method.encode(photo, view.camera.to(device), keep, name=view.name)


@torch.no_grad()
def encode_photo(method: Method, photo: UInt8[Tensor, "H W 3"], camera: Camera) -> Appearance:
    """The appearance of a photo of the place, seen by a camera in the scene's aligned frame."""
    device = method.gaussians.means.device
    return method.encode(to_unit(photo, device), camera.to(device))


@torch.no_grad()
def encode_picture(method: Method, picture: UInt8[Tensor, "h w 3"], camera: Camera) -> Appearance:
    """The appearance of any picture, as if the camera had seen it: style transfer (paper, appendix).

    The picture is cut to the camera's shape about its middle. All of it is lifted: what a mask, learnt from photos
    of the place, takes for a passer-by in a painting means nothing.
    """
    device = method.gaussians.means.device
    fitted = cover(picture, camera.width, camera.height)
    return method.encode(to_unit(fitted, device), camera.to(device), trust_mask=False)


def cover(picture: UInt8[Tensor, "h w 3"], width: int, height: int) -> UInt8[Tensor, "H W 3"]:
    """The picture scaled and cut about its middle so that it fills a frame; nothing is stretched."""
    image = Image.fromarray(picture.numpy())
    scale = max(width / image.width, height / image.height)
    part = (width / scale, height / scale)
    left, top = (image.width - part[0]) / 2, (image.height - part[1]) / 2
    box = (max(left, 0), max(top, 0), min(left + part[0], image.width), min(top + part[1], image.height))
    fitted = image.resize((width, height), Image.Resampling.LANCZOS, box=box)
    return torch.frombuffer(bytearray(fitted.tobytes()), dtype=torch.uint8).reshape(height, width, 3)
