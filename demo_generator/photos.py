"""Writes the demo's scene folder: photos, poses, points, depth priors and the truth for scoring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from PIL import Image

from demo_generator.camera_response import CameraResponse, develop, draw_response, metered_gain
from demo_generator.cameras import Viewpoint, draw_viewpoint
from demo_generator.clocks import add_clock
from demo_generator.landmark import add_landmark
from demo_generator.lighting import Light, draw_light
from demo_generator.render import Rendered, is_free, render, visible_share
from demo_generator.solids import Solids, World
from demo_generator.sparse import Photo, find_points, write_model
from demo_generator.surroundings import add_surroundings, lamp_positions
from demo_generator.transients import draw_visitors

_LIGHTS = ("slant", "golden", "noon", "slant", "dusk", "noon", "slant", "golden", "overcast", "slant")
_GOLDEN_RATIO = 0.6180339887498949
_PLACE_SEED = 3
_DISPARITY_STEP = 16  # 12 of the 16 bits: the others hold noise, which does not compress


@dataclass(frozen=True)
class SyntheticConfig:
    """The demo's scene.

    Attributes:
        photos: Number of photos.
        test_every: One photo in so many is held out.
        long_side: Longer side of the photos, pixels.
        samples: Samples per pixel along each axis.
        points: Sparse points to look for.
        least_views: Photos that have to see a sparse point.
        seed: Photographers, hours, clocks, cameras and passers-by; the landmark stays the same.
    """

    photos: int = 40
    test_every: int = 7
    long_side: int = 240
    samples: int = 2
    points: int = 6000
    least_views: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.photos < 2 or self.test_every < 2 or self.long_side < 16 or self.samples < 1:
            raise ValueError(
                "the demo needs two photos or more of 16 pixels or more, some of them for training"
            )


@dataclass(frozen=True)
class Place:
    """The landmark, its surroundings, and both together."""

    landmark: World
    around: World
    whole: World
    lamps: Float[np.ndarray, "L 4"]


def make_landmark(
    output: Path, config: SyntheticConfig | None = None, progress: Callable[[int, int], None] | None = None
) -> None:
    """Renders the demo's landmark into a scene folder.

    It holds `images/` (with EXIF times and places, see `demo_generator.clocks`), `sparse/0/` (COLMAP, exact poses),
    `split.tsv`, `depth/` (disparity of unknown scale and shift, as a monocular network gives it, 16 bits, 0 = sky)
    and `truth/` (test photos without visitors; masks: 255 = the place, 0 = a visitor's body, not its shadow). Equal
    configs give equal files.

    Args:
        output: The scene folder; made where it is missing.
        config: What to make.
        progress: Called with the number of photos done and of all photos.
    """
    config = config or SyntheticConfig()
    for folder in ("images", "depth", "truth/clean", "truth/masks"):
        (output / folder).mkdir(parents=True, exist_ok=True)
    place = build_place()
    photos = []
    for index in range(config.photos):
        photos.append(_take_photo(index, place, config, output))
        if progress:
            progress(index + 1, config.photos)
    rng = np.random.default_rng([config.seed, config.photos])
    write_model(photos, find_points(photos, config.points, config.least_views, rng), output / "sparse" / "0")
    rows = [f"{p.name}\t{i}\t{_split(i, config)}\tlandmark\n" for i, p in enumerate(photos)]
    (output / "split.tsv").write_text("filename\tid\tsplit\tdataset\n" + "".join(rows), encoding="utf-8")


def find_lights(config: SyntheticConfig) -> dict[str, Light]:
    """The true light of each photo, by its name in the scene."""
    place = build_place()
    return {f"landmark_{i:02d}.jpg": _begin_photo(i, place, config)[1] for i in range(config.photos)}


def find_split(config: SyntheticConfig) -> dict[str, list[int]]:
    """Numbers of the 'train' and of the 'test' photos."""
    split: dict[str, list[int]] = {"train": [], "test": []}
    for index in range(config.photos):
        split[_split(index, config)].append(index)
    return split


def relit_photo(
    view: int, light: int, config: SyntheticConfig
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The photo of the place without visitors from one photo's viewpoint, in the light and exposure of another one.

    Args:
        view: Number of the photo whose viewpoint is taken.
        light: Number of the photo whose light, exposure and camera response are taken.
        config: The scene's configuration.

    Returns:
        The photo, and where it does not show the sky.
    """
    place = build_place()
    camera = _begin_photo(view, place, config)[0]
    source = _meet(light, place, config)
    gain = metered_gain(_shoot(place, source.visitors, source.light, source.view, config, light).radiance)
    shot = _shoot(place, Solids().build(), source.light, camera, config, view)
    return develop(shot.radiance, gain, source.response, seed=view), shot.depth > 0.0


@dataclass(frozen=True)
class _Encounter:
    """What a photo is taken of, and with.

    Attributes:
        view: The viewpoint.
        light: The light.
        visitors: The visitors.
        response: The camera's response.
        rng: Randomness that is left to the photo.
    """

    view: Viewpoint
    light: Light
    visitors: World
    response: CameraResponse
    rng: np.random.Generator


def _meet(index: int, place: Place, config: SyntheticConfig) -> _Encounter:
    view, light, rng = _begin_photo(index, place, config)
    visitors = draw_visitors(view, lambda x, y, radius: is_free(place.whole, x, y, radius), rng)
    return _Encounter(view, light, visitors, draw_response(rng, dark=light.lamps > 0.0), rng)


def _begin_photo(
    index: int, place: Place, config: SyntheticConfig
) -> tuple[Viewpoint, Light, np.random.Generator]:
    rng = np.random.default_rng([config.seed, 1, index])
    view = _choose_view(index, place, config, rng)
    return view, draw_light(_LIGHTS[(index + index // len(_LIGHTS)) % len(_LIGHTS)], rng), rng


def _split(index: int, config: SyntheticConfig) -> str:
    return "test" if index % config.test_every == config.test_every // 2 else "train"


def build_place() -> Place:
    """The demo's place, the same for every configuration."""
    landmark, around, whole = Solids(), Solids(), Solids()
    add_landmark(landmark)
    add_surroundings(around, np.random.default_rng(_PLACE_SEED))
    add_landmark(whole)
    add_surroundings(whole, np.random.default_rng(_PLACE_SEED))
    return Place(landmark.build(), around.build(), whole.build(), lamp_positions())


def _choose_view(index: int, place: Place, config: SyntheticConfig, rng: np.random.Generator) -> Viewpoint:
    """A random viewpoint along the arc from which the landmark is mostly visible."""
    share = (0.5 + index * _GOLDEN_RATIO) % 1.0
    best, best_share = None, -1.0
    for _ in range(12):
        view = draw_viewpoint(share, config.long_side, rng)
        visible = visible_share(place.landmark, place.around, view)
        if visible > best_share:
            best, best_share = view, visible
        if visible > 0.85:
            break
    assert best is not None
    return best


def _take_photo(index: int, place: Place, config: SyntheticConfig, output: Path) -> Photo:
    """Renders and writes one photo with its depth prior, mask and (for a test photo) clean truth."""
    met = _meet(index, place, config)
    view, light, response, rng = met.view, met.light, met.response, met.rng

    def shoot(people: World) -> Rendered:
        return _shoot(place, people, light, view, config, index)

    shot = shoot(met.visitors)
    gain = metered_gain(shot.radiance)
    pixels = develop(shot.radiance, gain, response, seed=index)
    name = f"landmark_{index:02d}"
    photo = output / "images" / f"{name}.jpg"
    Image.fromarray(pixels).save(photo, quality=92, subsampling=0, optimize=True)
    add_clock(photo, index, light, config.seed)
    _write_png(disparity_prior(shot.depth, rng), output / "depth" / f"{name}.png")
    mask = np.where(shot.visitor, 0, 255).astype(np.uint8)
    _write_png(mask, output / "truth" / "masks" / f"{name}.png")
    if _split(index, config) == "test":
        clean = develop(shoot(Solids().build()).radiance, gain, response, seed=index)
        _write_png(clean, output / "truth" / "clean" / f"{name}.png")
    return Photo(f"{name}.jpg", view, pixels, shot.depth.astype(np.float32), shot.visitor)


def _write_png(pixels: np.ndarray, file: Path) -> None:
    Image.fromarray(pixels).save(file, optimize=True)


def _shoot(
    place: Place, people: World, light: Light, view: Viewpoint, config: SyntheticConfig, index: int
) -> Rendered:
    return render(place.whole, people, place.lamps, light, view, per_pixel=config.samples, seed=index)


def disparity_prior(depth: Float[np.ndarray, "H W"], rng: np.random.Generator) -> UInt16[np.ndarray, "H W"]:
    """Disparity as a monocular network gives it: unknown scale and shift, a smooth error of some percent.

    Args:
        depth: Along the camera's axis; 0 = sky.
        rng: Randomness of this photo.
    """
    solid = depth > 0.0
    disparity = np.where(solid, 1.0 / np.where(solid, depth, 1.0), 0.0)
    coarse = Image.fromarray(rng.normal(0.0, 0.05, (5, 5)).astype(np.float32))
    error = np.asarray(coarse.resize((depth.shape[1], depth.shape[0]), Image.Resampling.BICUBIC), dtype=float)
    largest = np.percentile(disparity[solid], 99.5) if solid.any() else 1.0
    value = disparity / largest * (1.0 + error) * rng.uniform(0.6, 0.92) + rng.uniform(0.01, 0.06)
    stored = np.round(value * (65535.0 / _DISPARITY_STEP)) * _DISPARITY_STEP
    return np.where(solid, np.clip(stored, _DISPARITY_STEP, 65535), 0).astype(np.uint16)
