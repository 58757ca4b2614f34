"""Monocular disparity by Depth Anything V2 (Yang et al., NeurIPS 2024): the paper's depth prior.

The network predicts disparity up to an unknown scale and shift (large = near). It is stored as 16-bit images in the
scene's `depth/` folder, from which the depth loss reads it.
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
"""Training resolution of the network in pixels per side: 37 x 37 patches."""
STORED_SIZE = 1036
"""Maximum long side of the stored disparity; the network resolves no finer detail."""
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class DepthEstimator:
    """Depth Anything with its image preprocessing.

    Attributes:
        model: The transformers network, in evaluation mode.
        patch_size: Side of the network's patches in pixels; the input size is a multiple of it.
    """

    model: torch.nn.Module
    patch_size: int = 14

    def estimate(self, photo: UInt8[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        """Estimates the disparity of a photo, at the photo's resolution.

        Args:
            photo: RGB, upright.

        Returns:
            Non-negative disparity (large = near, about 0 in the sky) in the network's units, on the CPU.
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
        """Input height and width of the network for an image.

        Follows the published preprocessing: both axes are scaled by the factor closest to 1 that brings one side
        to 518 pixels, then each side is rounded to whole patches.
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
    """Loads Depth Anything V2 (small) from a folder, the Hugging Face cache or the hub.

    Args:
        source: A folder in the hub's layout, or a model name on the hub; None = the published small network.
        device: Device of the network; None = CUDA if available, else the CPU.
        required: Raise an error instead of warning if the network is not available.

    Returns:
        The network; None if it is not available (a warning tells the consequences and how to get it).

    Raises:
        UserError: `source` is a folder without such a network; or the network is `required` but not available.
    """
    source = source or DEPTH_ANYTHING
    model = _find_model(source)
    if model is None:
        message = f"Depth Anything ({source}) is neither a folder nor cached, and the hub is not reachable"
        download = f"Download it with `hf download {source}`"
        if required:
            raise UserError(f"{message}. {download}, give its folder, or use `wildgs depth --by stereo`")
        message += f"; only depth maps already in depth/ are used, such as those of stereo. {download}"
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
    except Exception:  # likewise: all mean 'not available'
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
    """Writes the depth prior of every photo of a scene's model (see `depth_files`).

    Args:
        root: The scene's folder.
        estimator: The network.
        overwrite: Replace existing files.
        progress: Called with (photos done, total).

    Returns:
        The number of files written, and the number that already existed.

    Raises:
        UserError: The folder contains no scene.
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
    """Scales the values so that the nearest pixel is 65535, and the size to at most `STORED_SIZE`."""
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
