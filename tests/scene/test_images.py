import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wildgs.scene import images
from wildgs.scene.images import (
    ShapeMismatchError,
    UnreadableImageError,
    open_image,
    read_disparity,
    read_mask,
    read_photo,
    same_shape,
    upright_size,
)

W, H = 40, 24


def gradient() -> np.ndarray:
    y, x = np.mgrid[0:H, 0:W]
    return np.stack([x * 6, y * 10, 255 - x * 6], axis=-1).astype(np.uint8)


ORIENTED = {
    2: np.fliplr,
    3: lambda a: np.rot90(a, 2),
    4: np.flipud,
    5: lambda a: np.transpose(a, (1, 0, 2)),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(np.transpose(a, (1, 0, 2)), 2),
    8: lambda a: np.rot90(a, 1),
}


def exif_of(entries: list[tuple[int, int, int, bytes]]) -> bytes:
    """An EXIF block, byte by byte: tag, type, count and four bytes of value."""
    block = struct.pack("<2sHIH", b"II", 42, 8, len(entries))
    block += b"".join(struct.pack("<HHI4s", *entry) for entry in entries)
    return b"Exif\0\0" + block + struct.pack("<I", 0)


@pytest.mark.filterwarnings("ignore:.*EXIF")
@pytest.mark.parametrize(
    "entry",
    [
        (0x011A, 2, 4, b"72a\0"),  # XResolution as text
        (0x0100, 8, 1, struct.pack("<hH", -5, 0)),  # ImageWidth as a signed short
        (0x010F, 7, 4, b"\xff\xfe\0\x01"),  # Make as undefined bytes
        (0x8769, 4, 1, b"\x08\0\0\0"),  # an EXIF block that contains itself
    ],
)
def test_odd_exif_entries_do_not_matter(tmp_path: Path, entry: tuple[int, int, int, bytes]) -> None:
    """Orientation 6 and one entry that Pillow can read, but not write again."""
    path = tmp_path / "a.jpg"
    oriented = (0x0112, 3, 1, struct.pack("<HH", 6, 0))
    Image.fromarray(gradient()).save(path, exif=exif_of([entry, oriented]), quality=95)
    expected = np.rot90(gradient(), -1).astype(float)
    assert np.abs(read_photo(path).pixels - expected).mean() < 4


def test_tiffs_are_turned_once(tmp_path: Path) -> None:
    """Pillow turns them while it loads them."""
    path = tmp_path / "a.tif"
    Image.fromarray(gradient()).save(path, tiffinfo={0x0112: 6})
    np.testing.assert_array_equal(read_photo(path).pixels, np.rot90(gradient(), -1))
    with open_image(path) as image:
        assert upright_size(image) == (H, W)


def save_oriented(path: Path, orientation: int) -> Path:
    image = Image.fromarray(gradient())
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", sorted(ORIENTED))
def test_without_a_camera_photos_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    path = save_oriented(tmp_path / "a.png", orientation)
    assert np.array_equal(read_photo(path).pixels, ORIENTED[orientation](gradient()))


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_colmaps_stored_grid_is_kept(tmp_path: Path, orientation: int) -> None:
    path = save_oriented(tmp_path / "a.png", orientation)
    assert np.array_equal(read_photo(path, camera_size=(W, H)).pixels, gradient())


def test_a_camera_of_the_upright_shape_turns_the_photo(tmp_path: Path) -> None:
    path = save_oriented(tmp_path / "a.png", 6)
    assert np.array_equal(read_photo(path, camera_size=(H, W)).pixels, ORIENTED[6](gradient()))


def test_another_shape_than_the_camera_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(gradient()).save(path)
    with pytest.raises(ShapeMismatchError, match="40x24 pixels, but its camera is 40x40"):
        read_photo(path, camera_size=(40, 40))


def test_grey_is_spread_over_the_channels(tmp_path: Path) -> None:
    grey = gradient()[..., 0]
    Image.fromarray(grey).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    assert np.array_equal(photo.pixels, np.repeat(grey[..., None], 3, axis=-1))
    assert photo.mask is None


def test_sixteen_bits_become_eight(tmp_path: Path) -> None:
    grey = gradient()[..., 0]
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "a.png")
    assert np.array_equal(read_photo(tmp_path / "a.png").pixels[..., 1], grey)


def test_floating_point_grey_is_taken_as_zero_to_one(tmp_path: Path) -> None:
    values = np.linspace(-0.5, 1.5, W * H, dtype=np.float32).reshape(H, W)
    Image.fromarray(values).save(tmp_path / "a.tif")
    expected = np.clip(np.round(values.astype(np.float64) * 255), 0, 255)
    assert np.array_equal(read_photo(tmp_path / "a.tif").pixels[..., 2], expected)


def test_cmyk_jpeg(tmp_path: Path) -> None:
    Image.fromarray(gradient()).convert("CMYK").save(tmp_path / "a.jpg", quality=98)
    difference = read_photo(tmp_path / "a.jpg").pixels.astype(int) - gradient()
    assert np.abs(difference).max() < 24
    assert np.abs(difference).mean() < 3


def test_heic_of_iphones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    heif.from_pillow(Image.fromarray(gradient())).save(tmp_path / "IMG_0.HEIC", quality=95)
    difference = read_photo(tmp_path / "IMG_0.HEIC").pixels.astype(int) - gradient().astype(int)
    assert np.abs(difference).mean() < 4
    monkeypatch.setattr(images, "_register_heif", lambda: False)
    monkeypatch.setattr(images, "FORMATS", ("JPEG",))
    with pytest.raises(UnreadableImageError, match="pip install pillow-heif"):
        open_image(tmp_path / "IMG_0.HEIC")


def test_palette(tmp_path: Path) -> None:
    image = Image.fromarray(gradient()).quantize(16)
    image.save(tmp_path / "a.png")
    assert np.array_equal(read_photo(tmp_path / "a.png").pixels, np.asarray(image.convert("RGB")))


def test_transparent_pixels_are_black_and_ignored(tmp_path: Path) -> None:
    alpha = np.full((H, W), 255, dtype=np.uint8)
    alpha[:, :10] = 0
    alpha[:, 10:20] = 1
    Image.fromarray(np.dstack([gradient(), alpha])).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    assert photo.mask is not None
    assert (photo.mask[:, :10] == 0).all()
    assert (photo.mask[:, 10:] == 255).all()  # only what shows nothing at all is ignored
    assert (photo.pixels[:, :10] == 0).all()
    assert np.array_equal(photo.pixels[:, 20:], gradient()[:, 20:])


def test_a_transparent_palette_colour_is_alpha(tmp_path: Path) -> None:
    indices = np.zeros((H, W), dtype=np.uint8)
    indices[:, 20:] = 1
    image = Image.fromarray(indices).convert("P")
    image.putpalette([200, 10, 10, 10, 200, 10])
    image.save(tmp_path / "a.png", transparency=0)
    photo = read_photo(tmp_path / "a.png")
    assert photo.mask is not None
    assert (photo.mask[:, :20] == 0).all()
    assert tuple(photo.pixels[0, -1]) == (10, 200, 10)


def test_shrinking_averages_instead_of_skipping(tmp_path: Path) -> None:
    stripes = np.zeros((H, W, 3), dtype=np.uint8)
    stripes[:, ::2] = 200
    Image.fromarray(stripes).save(tmp_path / "a.png")
    small = read_photo(tmp_path / "a.png", size=(W // 4, H // 4)).pixels
    assert small.shape == (H // 4, W // 4, 3)
    assert np.abs(small[:, 2:-2].astype(int) - 100).max() <= 12


@pytest.mark.parametrize("keep", [20, 400])
def test_broken_jpegs_say_so(tmp_path: Path, keep: int) -> None:
    Image.fromarray(gradient()).save(tmp_path / "whole.jpg")
    (tmp_path / "a.jpg").write_bytes((tmp_path / "whole.jpg").read_bytes()[:keep])
    with pytest.raises(UnreadableImageError):
        read_photo(tmp_path / "a.jpg")


def test_missing_files_and_giants_say_so(tmp_path: Path) -> None:
    with pytest.raises(UnreadableImageError, match="no such file"):
        read_photo(tmp_path / "a.jpg")
    Image.fromarray(gradient()).save(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match="40x24 pixels exceed the limit of 900"):
        read_photo(tmp_path / "a.png", max_pixels=900)


def test_the_pixel_limit_is_ours_and_pillows_stays_untouched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.new("1", (200, 100)).save(tmp_path / "big.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 5_000)
    with pytest.raises(Image.DecompressionBombError):
        Image.open(tmp_path / "big.png")
    assert read_mask(tmp_path / "big.png", (20, 10)).max() == 0
    assert Image.MAX_IMAGE_PIXELS == 5_000


def test_masks_are_binary_by_majority(tmp_path: Path) -> None:
    mask = np.zeros((H, W), dtype=np.uint8)
    mask[:, 16:] = 1  # anything but black counts
    mask[:, 13] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    full = read_mask(tmp_path / "m.png", (W, H))
    assert set(np.unique(full)) == {0, 255}
    small = read_mask(tmp_path / "m.png", (W // 4, H // 4))
    assert (small[:, :4] == 0).all()
    assert (small[:, 4:] == 255).all()


def test_disparity_keeps_sixteen_bits_and_its_holes(tmp_path: Path) -> None:
    values = np.full((H, W), 1000, dtype=np.uint16)
    values[:, 20:] = 60001
    values[:8] = 0
    values[12, 2] = 0
    Image.fromarray(values).save(tmp_path / "d.png")
    assert np.array_equal(read_disparity(tmp_path / "d.png", (W, H)), values)
    small = read_disparity(tmp_path / "d.png", (W // 4, H // 4))
    assert (small[:2] == 0).all()
    assert (small[2:, :5] == 1000).all()  # the hole does not pull the mean down
    assert (small[2:, 5:] == 60001).all()


def test_eight_bit_disparity_is_stretched(tmp_path: Path) -> None:
    Image.fromarray(np.full((H, W), 255, dtype=np.uint8)).save(tmp_path / "d.png")
    assert (read_disparity(tmp_path / "d.png", (W, H)) == 65535).all()


def test_shape_tolerates_rounding_only() -> None:
    assert same_shape((1023, 767), (4092, 3069))
    assert same_shape((333, 250), (1000, 750))
    assert not same_shape((640, 480), (640, 512))
    assert not same_shape((640, 480), (480, 640))


@pytest.mark.parametrize("read", [read_mask, read_disparity])
def test_a_colour_mode_that_cannot_become_grey_is_named(tmp_path: Path, read) -> None:
    """Pillow converts LAB to RGB at most."""
    Image.new("LAB", (W, H), (128, 128, 128)).save(tmp_path / "a.tif")
    with pytest.raises(UnreadableImageError, match="colour mode LAB is not supported"):
        read(tmp_path / "a.tif", (W, H))


def test_a_jpeg_mask_is_cut_at_half_brightness(tmp_path: Path) -> None:
    mask = np.zeros((H, W), dtype=np.uint8)
    mask[:, W // 2 :] = 255
    noisy = mask.astype(int) + np.random.default_rng(0).integers(-12, 12, (H, W))
    Image.fromarray(noisy.clip(0, 255).astype(np.uint8)).save(tmp_path / "a.jpg", quality=60)
    assert np.array_equal(read_mask(tmp_path / "a.jpg", (W, H)), mask)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(UnreadableImageError, match="not a regular file"):
        read_photo(tmp_path / "a.jpg")


def test_a_name_that_no_file_can_have_is_unreadable(tmp_path: Path) -> None:
    with pytest.raises(UnreadableImageError, match="name too long"):
        read_photo(tmp_path / ("x" * 300 + ".jpg"))
