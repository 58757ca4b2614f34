"""Reading images of any mode and orientation as arrays; errors give the reason.

Colours keep the photo's encoding, usually sRGB.
"""

from __future__ import annotations

import functools
import importlib
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped, UInt8, UInt16
from PIL import Image, UnidentifiedImageError

from wildgs.files import check_regular
from wildgs.scene.config import MAX_IMAGE_PIXELS

EXIF_ORIENTATION = 0x0112
TRANSPOSITIONS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Transposition for each EXIF orientation that makes an image upright."""
ASPECT_TOLERANCE = 0.01
"""Largest relative difference between aspect ratios of sizes with the same shape (besides rounding to pixels)."""
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""First bytes of HEIC and HEIF files after `ftyp`; AVIF has others."""
FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000", "AVIF", "HEIF")
"""Formats that are decoded, whatever the file's extension. Some others of Pillow start programs (EPS:
Ghostscript)."""

DECODING_PIXELS = 100_000_000
"""Upper bound on the number of pixels that all threads decode at the same time."""

_open_lock = threading.Lock()


LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in brightness (Rec. 601)."""


class UnreadableImageError(Exception):
    """An image cannot be used; the message gives the reason without the file's name."""


class ShapeMismatchError(UnreadableImageError):
    """A valid image whose aspect ratio differs from that of its camera."""


@dataclass(frozen=True)
class Photo:
    """A decoded photo, shared between readers: its arrays must not be modified.

    Attributes:
        pixels: Colours, 8 bits; black if fully transparent.
        mask: 0 = ignore (transparent, outside the undistorted image, or by the user's mask), 255 = use; None if no
            pixel is ignored.
        disparity: Disparity map, 16 bits, large = near, 0 = no estimate; None if there is none.
        depth: Metric depth along the camera's z axis in units of the scene, 0 = no estimate; None if there is none.
    """

    pixels: UInt8[np.ndarray, "H W 3"]
    mask: UInt8[np.ndarray, "H W"] | None = None
    disparity: UInt16[np.ndarray, "H W"] | None = None
    depth: Float32[np.ndarray, "H W"] | None = None

    @property
    def num_bytes(self) -> int:
        """Memory of the arrays, bytes."""
        arrays = (self.pixels, self.mask, self.disparity, self.depth)
        return sum(array.nbytes for array in arrays if array is not None)


class _DecodingBudget:
    """Divides `DECODING_PIXELS` among threads; a thread that holds a share may decode further images within it."""

    def __init__(self) -> None:
        self._taken = 0
        self._returned = threading.Condition()
        self._own = threading.local()

    @contextmanager
    def share(self, pixels: int) -> Iterator[None]:
        if getattr(self._own, "held", False):
            yield
            return
        pixels = min(pixels, DECODING_PIXELS)
        with self._returned:
            self._returned.wait_for(lambda: self._taken + pixels <= DECODING_PIXELS)
            self._taken += pixels
        self._own.held = True
        try:
            yield
        finally:
            self._own.held = False
            with self._returned:
                self._taken -= pixels
                self._returned.notify_all()


_budget = _DecodingBudget()


def decoding(image: Image.Image) -> AbstractContextManager[None]:
    """Waits until the image may be decoded, to limit the memory of all threads in such blocks.

    The functions of this module use it; callers that hold several copies of the pixels should use it, too.
    """
    return _budget.share(image.width * image.height)


def open_image(path: Path, max_pixels: int = MAX_IMAGE_PIXELS) -> Image.Image:
    """Opens an image and reads its header only.

    Raises:
        UnreadableImageError: The file is missing, not an image, or has more pixels than `max_pixels`.
    """
    try:
        check_regular(path)
        # Disables Pillow's global limit, which only warns, in favour of `max_pixels`.
        with _open_lock:
            previous, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(path, formats=_formats())
            finally:
                Image.MAX_IMAGE_PIXELS = previous
    except FileNotFoundError as error:
        raise UnreadableImageError("no such file") from error
    except UnidentifiedImageError as error:
        raise UnreadableImageError(_why_unknown(path)) from error
    except OSError as error:  # missing permission, a pipe or device, a name that is too long
        reason = error.strerror or str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UnreadableImageError(reason) from error
    except Exception as error:  # Pillow's plugins raise many types for invalid headers
        raise UnreadableImageError("not a readable image") from error
    width, height = image.size
    if width * height == 0:
        image.close()
        raise UnreadableImageError("it has no pixels")
    if width * height > max_pixels:
        image.close()
        raise UnreadableImageError(
            f"{width}x{height} pixels exceed the limit of {max_pixels} (--max-image-pixels)"
        )
    return image


@functools.cache
def _register_heif() -> bool:
    """Lets Pillow read HEIC and HEIF, the format of iPhones, if pillow-heif is installed."""
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return False
    return True


def _formats() -> list[str]:
    """The members of `FORMATS` that this version of Pillow can read."""
    Image.init()
    _register_heif()
    return [name for name in FORMATS if name in Image.OPEN]


def _why_unknown(path: Path) -> str:
    """Why no decoder recognises a file."""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(12)
        if head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS and not _register_heif():
            return "HEIC needs another decoder: `pip install pillow-heif`, or convert it to JPEG"
    return "not a readable image"


def _load(image: Image.Image) -> None:
    try:
        image.load()
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UnreadableImageError(reason) from error


def upright_size(image: Image.Image) -> tuple[int, int]:
    """Width and height after applying the EXIF orientation, from the header only."""
    width, height = image.size
    turned = (
        _orientation(image) in (5, 6, 7, 8) and image.format != "TIFF"
    )  # Pillow rotates TIFF files itself
    return (height, width) if turned else (width, height)


def _orientation(image: Image.Image) -> int:
    try:
        return int(image.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:  # invalid EXIF data is ignored
        return 1


def _upright(image: Image.Image) -> Image.Image:
    """The loaded image with its EXIF orientation applied.

    `ImageOps.exif_transpose` also rewrites the EXIF data, which fails for unusual entries.
    """
    method = TRANSPOSITIONS.get(_orientation(image))
    return image if method is None else image.transpose(method)


def same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) have the same aspect ratio."""
    scale_x, scale_y = a[0] / b[0], a[1] / b[1]
    tolerance = max(ASPECT_TOLERANCE, 1.0 / min(*a, *b))
    return abs(scale_x / scale_y - 1.0) <= tolerance


def read_photo(
    path: Path,
    *,
    camera_size: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
    max_pixels: int = MAX_IMAGE_PIXELS,
) -> Photo:
    """Decodes a photo to 8-bit RGB.

    COLMAP ignores the EXIF orientation, so with `camera_size` the photo is not rotated, unless only the rotated
    photo has the camera's aspect ratio. Without `camera_size` the photo is rotated upright.

    Args:
        path: The file: RGB, grey, CMYK, palette, alpha, 8 or 16 bits.
        camera_size: Width and height of the photo's camera.
        size: Width and height to resize to (Lanczos, antialiased); None keeps the size.
        max_pixels: Larger images are rejected.

    Raises:
        UnreadableImageError: The file cannot be decoded, or its aspect ratio differs from that of the camera.
    """
    with open_image(path, max_pixels) as image, decoding(image):
        turn = _orientation(image) != 1
        if camera_size is not None:
            if same_shape(image.size, camera_size):
                turn = False
            elif not (turn and same_shape(upright_size(image), camera_size)):
                raise ShapeMismatchError(
                    f"{_times(image.size)} pixels, but its camera is {_times(camera_size)}"
                )
        _load(image)
        colours, alpha = _to_rgb(_upright(image) if turn else image)
        return Photo(
            pixels=np.array(_resize(colours, size, Image.Resampling.LANCZOS)),
            mask=None if alpha is None else _resize_mask(alpha, size),
        )


def read_mask(
    path: Path, size: tuple[int, int], max_pixels: int = MAX_IMAGE_PIXELS
) -> UInt8[np.ndarray, "H W"]:
    """Decodes a mask: 0 where the file is black (ignored), 255 elsewhere; by majority if it is reduced.

    JPEG files, in which black is not exact, are thresholded at half brightness.

    Raises:
        UnreadableImageError: The file cannot be decoded, or has another aspect ratio than `size`.
    """
    with open_image(path, max_pixels) as image, decoding(image):
        _check_shape(image, size)
        _load(image)
        least = 128 if image.format in ("JPEG", "MPO") else 1
        return _resize_mask(np.asarray(_to_grey(image)) >= least, size)


def read_disparity(
    path: Path, size: tuple[int, int], max_pixels: int = MAX_IMAGE_PIXELS
) -> UInt16[np.ndarray, "H W"]:
    """Decodes a disparity map (large = near, 0 = no estimate) to 16 bits; 8-bit files are scaled.

    When the map is reduced, zeros are excluded from the means.

    Raises:
        UnreadableImageError: The file cannot be decoded, or has another aspect ratio than `size`.
    """
    with open_image(path, max_pixels) as image, decoding(image):
        _check_shape(image, size)
        _load(image)
        values = np.asarray(_to_grey(image)).astype(np.float32)
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
        if not _is_deep(image):
            values *= 257.0
    if (values.shape[1], values.shape[0]) != size:
        valid = (values > 0).astype(np.float32)
        share = np.asarray(Image.fromarray(valid).resize(size, Image.Resampling.BOX))
        total = np.asarray(Image.fromarray(values * valid).resize(size, Image.Resampling.BOX))
        values = np.where(share >= 0.5, np.maximum(total / np.maximum(share, 0.5), 1.0), 0.0)
    return np.clip(np.round(values), 0, 65535).astype(np.uint16)


def read_depth(
    path: Path, size: tuple[int, int], max_pixels: int = MAX_IMAGE_PIXELS
) -> Float32[np.ndarray, "H W"]:
    """Decodes a metric depth map (32-bit floats, 0 = no estimate).

    The map is resized by nearest neighbour, since means across depth edges are wrong.

    Raises:
        UnreadableImageError: The file cannot be decoded, is not float, or has another aspect ratio than `size`.
    """
    with open_image(path, max_pixels) as image, decoding(image):
        _check_shape(image, size)
        _load(image)
        if image.mode != "F":
            raise UnreadableImageError("metric depth must be one channel of 32-bit floats")
        values = np.asarray(image.resize(size, Image.Resampling.NEAREST), dtype=np.float32)
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(0))


def _check_shape(image: Image.Image, size: tuple[int, int]) -> None:
    if not same_shape(image.size, size):
        raise ShapeMismatchError(
            f"its size {_times(image.size)} has another aspect ratio than the photo, {_times(size)}"
        )


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _to_grey(image: Image.Image) -> Image.Image:
    """One channel: unchanged if it has more than 8 bits, else the luminance."""
    if _is_deep(image):
        return image
    try:
        return image.convert("L")
    except ValueError as error:  # Pillow converts some modes (LAB) to RGB only, or not at all
        raise UnreadableImageError(
            f"its colour mode {image.mode} is not supported; save it as greyscale"
        ) from error


def _is_deep(image: Image.Image) -> bool:
    return image.mode in ("I", "F") or image.mode.startswith("I;16")


def _to_rgb(image: Image.Image) -> tuple[Image.Image, UInt8[np.ndarray, "H W"] | None]:
    """Colours, black if fully transparent, and the alpha channel if there is one."""
    if _is_deep(image):
        return Image.fromarray(_to_8_bits(np.asarray(image))).convert("RGB"), None
    has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    if not has_alpha:
        return image if image.mode == "RGB" else image.convert("RGB"), None
    rgba = image.convert("RGBA")
    black = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
    return Image.alpha_composite(black, rgba).convert("RGB"), np.array(rgba.getchannel("A"))


def _to_8_bits(values: Shaped[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Converts 16-bit integers or floats in [0, 1] to 8 bits."""
    full = 1.0 if values.dtype.kind == "f" else 65535.0
    values = np.nan_to_num(values, nan=0.0)
    return np.clip(np.round(values.astype(np.float64) * (255.0 / full)), 0, 255).astype(np.uint8)


def _resize(image: Image.Image, size: tuple[int, int] | None, resampling: Image.Resampling) -> Image.Image:
    return image if size is None or image.size == size else image.resize(size, resampling)


def _resize_mask(mask: Shaped[np.ndarray, "h w"], size: tuple[int, int] | None) -> UInt8[np.ndarray, "H W"]:
    """Resizes a mask to values 0 and 255 by majority."""
    binary = Image.fromarray(np.where(mask != 0, 255, 0).astype(np.uint8))
    resized = np.asarray(_resize(binary, size, Image.Resampling.BOX))
    return np.where(resized >= 128, 255, 0).astype(np.uint8)
