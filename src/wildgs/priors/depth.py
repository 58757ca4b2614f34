"""Monocular disparity by Depth Anything V2 (Yang et al., NeurIPS 2024): the paper's depth prior.

The network gives disparity of unknown scale and shift (large = near). It is kept as 16-bit pictures in the
scene's `depth/` folder, where the depth loss finds it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import written_aside
from wildgs.hub import hub_reachable
from wildgs.priors.config import DEPTH_ANYTHING
from wildgs.scene.colmap import read_model
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.scene.photo_store import depth_files

NETWORK_SIZE = 518
"""Side at which the network was trained; its 37 x 37 patches."""
STORED_SIZE = 1036
"""Long side of the stored disparity at most: the network sees no finer detail."""
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class DepthEstimator:
    """Depth Anything with its preparation of the picture.

    Attributes:
        model: The transformers network, in evaluation mode.
        patch_size: Side of the network's patches, pixels; its input is a multiple.
    """

    model: torch.nn.Module
    patch_size: int = 14

    def estimate(self, photo: UInt8[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        """Disparity of a photo, at the photo's size.

        Args:
            photo: Colours, upright.

        Returns:
            Disparity (large = near) in the network's own units, at least 0; near 0 in the sky. On the CPU.
        """
        device = next(self.model.parameters()).device
        height, width = photo.shape[:2]
        picture = photo.to(device).permute(2, 0, 1)[None].float() / 255.0
        size = self.network_size(height, width)
        picture = interpolate(picture, size=size, mode="bicubic", antialias=True, align_corners=False)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (MEAN, STD))
        with torch.inference_mode():
            disparity = self.model(pixel_values=(picture - mean) / std).predicted_depth
        disparity = interpolate(disparity[:, None].float(), size=(height, width), mode="bilinear")
        return disparity[0, 0].clamp_min(0.0).cpu().clone()

    def network_size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width at which the network sees a picture.

        As its published preparation: one scale for both axes, that of the side which needs less scaling to
        reach 518 pixels, then each rounded to whole patches.
        """
        scale = min(NETWORK_SIZE / height, NETWORK_SIZE / width, key=lambda factor: abs(1.0 - factor))
        patch = self.patch_size
        return (
            max(patch, round(height * scale / patch) * patch),
            max(patch, round(width * scale / patch) * patch),
        )


def load_depth_anything(
    source: str | None = None, *, device: str | None = None, required: bool = False
) -> DepthEstimator | None:
    """Depth Anything V2 (small) from a folder, the hub's cache or the hub.

    Args:
        source: A folder in the hub's layout, or a name on the hub; None = the published small network.
        device: Where it runs; None = CUDA where there is one, else the CPU.
        required: Raise where it cannot be had, instead of warning.

    Returns:
        The network; None where it cannot be had (one warning says what is lost and how to get it).

    Raises:
        UserError: `source` is a folder without such a network; or it cannot be had and is `required`.
    """
    source = source or DEPTH_ANYTHING
    model = _find_model(source)
    if model is None:
        message = (
            f"Depth Anything ({source}) is neither a folder, nor cached, nor to be had from the hub: there is"
            f" no depth prior but what depth/ holds; get it with `hf download {source}`, give its folder,"
            " or use `wildgs depth --by stereo`"
        )
        if required:
            raise UserError(message)
        warnings.warn(message, WildGSWarning, stacklevel=2)
        return None
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    patch = int(getattr(model.config, "patch_size", 14))
    return DepthEstimator(model.to(device).eval(), patch)


def _find_model(source: str) -> Any | None:
    if Path(source).is_dir():
        try:
            return _load(source, local=True)
        except Exception as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(f"{source}: no Depth Anything in the hub's layout ({reason})") from error
    if source.startswith((".", "/", "~")) or source.count("/") > 1:
        raise UserError(
            f"{source}: no such folder; give the folder of Depth Anything, or its name on the hub"
        )
    try:
        return _load(source, local=True)
    except Exception:  # transformers raises OSError, ValueError, ... : all mean 'not cached'
        if not hub_reachable():
            return None
    try:
        return _load(source, local=False)
    except Exception:  # and here: 'not to be had'
        return None


def _load(source: str, *, local: bool) -> Any:
    from transformers import DepthAnythingForDepthEstimation
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    verbosity = logging.get_verbosity()
    logging.set_verbosity_error()
    if local:
        logging.disable_progress_bar()
    try:
        loaded: Any = DepthAnythingForDepthEstimation.from_pretrained(
            source, local_files_only=local, use_safetensors=True, output_loading_info=True
        )
    finally:
        logging.set_verbosity(verbosity)
        if shown:
            logging.enable_progress_bar()
    model, info = loaded
    if info["missing_keys"]:
        raise ValueError(f"{len(info['missing_keys'])} weights are missing")
    return model


def fill_depth_folder(
    root: Path,
    estimator: DepthEstimator,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[int, int]:
    """Write the depth prior of every photo of a scene's model (see `depth_files`).

    Args:
        root: The scene's folder.
        estimator: Gives disparity.
        overwrite: Estimate again what is already there.
        progress: Called with (photos done, photos in all).

    Returns:
        How many were written, and how many were there before.

    Raises:
        UserError: There is no scene.
    """
    model = read_model(root)
    targets = depth_files(root, [image.name for image in model.images])
    written = kept = 0
    for count, image in enumerate(model.images, start=1):
        target = targets[image.name]
        if target.is_file() and not overwrite:
            kept += 1
        else:
            camera_size = (image.camera.width, image.camera.height)
            try:
                photo = read_photo(
                    model.images_dir / image.name, camera_size=camera_size, max_pixels=MAX_IMAGE_PIXELS
                )
            except UnreadableImageError as error:
                path = model.images_dir / image.name
                warnings.warn(f"{path}: {error}; it gets no depth", WildGSWarning, stacklevel=2)
            else:
                disparity = estimator.estimate(torch.from_numpy(photo.pixels))
                _write_png(_to_16_bits(disparity), target)
                written += 1
        if progress is not None:
            progress(count, len(model.images))
    return written, kept


def _to_16_bits(disparity: Float[Tensor, "H W"]) -> UInt16[np.ndarray, "h w"]:
    """Stretched so that the nearest pixel is 65535, shrunk to what the network resolves."""
    height, width = disparity.shape
    shrink = STORED_SIZE / max(height, width)
    if shrink < 1.0:
        size = (max(1, round(height * shrink)), max(1, round(width * shrink)))
        disparity = interpolate(disparity[None, None], size=size, mode="area")[0, 0]
    largest = float(disparity.max())
    scaled = disparity * (65535.0 / largest) if largest > 0 else torch.zeros_like(disparity)
    return scaled.round().numpy().astype(np.uint16)


def _write_png(values: UInt16[np.ndarray, "H W"], target: Path) -> None:
    with written_aside(target) as aside:
        Image.fromarray(values).save(aside, "PNG")
