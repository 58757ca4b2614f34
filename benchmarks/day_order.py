"""Are lights in the order of the day? Kendall's tau of the demo's photos against the true directions of the sun.

    python -m benchmarks.day_order wildgs-demo/wildgs                      with the demo's EXIF blocks, and without
    python -m benchmarks.day_order wildgs-demo/wildgs --clocks             with all true hours in EXIF blocks
    python -m benchmarks.day_order wildgs-demo/wildgs --clocks --wrong 5   five clocks 8 to 12 hours off

The run must be of the demo's scene, or of one that `demo_generator.photos.make_landmark` renders with another seed.
By elevation, morning and evening are the same; by phase, the sun rises to 90 and sets to 180 degrees. The order
that the run folder keeps (`day.json`) is used if there is one and it is current.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image
from PIL.ExifTags import IFD, Base
from scipy.stats import kendalltau

import wildgs
from demo_generator.clocks import draw_clock
from demo_generator.lighting import Light
from demo_generator.photos import SyntheticConfig, find_lights
from wildgs.library.day import find_day
from wildgs.library.loaded import LoadedScene
from wildgs.light.day import Day


@dataclass(frozen=True)
class Command:
    """Compares the order of a day with the truth."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    clocks: bool = False
    """Write the true hours into EXIF blocks of copies of the photos, instead of those that the photos have."""
    wrong: int = 0
    """Number of these clocks that are wrong."""
    seed: int = 0
    """Seed of the scene's generator."""


def phase_of(light: Light) -> float:
    """Height of the sun along its path, degrees; the landmark's front looks south, so that +x is the east."""
    return light.elevation if light.azimuth > 0 else 180 - light.elevation


def write_clocks(scene: LoadedScene, lights: dict[str, Light], folder: Path, wrong: int) -> list[str]:
    """Copies the training photos with EXIF times; returns those whose clocks are wrong."""
    random = np.random.default_rng(5)
    names = [view.name for view in scene.scene.train_views]
    chosen = list(random.choice(names, wrong, replace=False))
    for view in scene.scene.train_views:
        hour = (phase_of(lights[view.name]) + 90) / 15
        hour = (hour + random.choice([8, 10, 12, -9])) % 24 if view.name in chosen else hour
        exif = Image.Exif()
        exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = (
            f"2019:07:01 {int(hour):02d}:{int(hour % 1 * 60):02d}:00"
        )
        Image.fromarray(view.read_photo().numpy()).save(folder / view.name, exif=exif)
    return chosen


def wrong_clocks(scene: LoadedScene, lights: dict[str, Light], seed: int) -> dict[str, str]:
    """Training photos whose clock the generator set wrong, and how."""
    names = {view.name for view in scene.scene.train_views}
    clocks = {name: draw_clock(index, light, seed) for index, (name, light) in enumerate(lights.items())}
    return {name: clock.fault for name, clock in clocks.items() if clock and clock.fault and name in names}


def report(title: str, names: Iterable[str], day: Day, lights: dict[str, Light]) -> None:
    names = list(names)
    if not names:
        return
    found = np.array([day.phases[name] for name in names])
    true = np.array([phase_of(lights[name]) for name in names])
    height = [90 - np.abs(90 - phases) for phases in (found, true)]
    sides = float(((found < 90) == (true < 90)).mean())
    print(
        f"{title}: {len(found)} photos, tau of elevation {kendalltau(*height)[0]:.3f}, "
        f"of phase {kendalltau(found, true)[0]:.3f}, morning or evening right for {sides:.0%}"
    )


def report_day(title: str, day: Day, lights: dict[str, Light]) -> None:
    """Prints how well all photos, those placed by light and the key photos are in order."""
    report(f"{title}, {'by time' if day.by_time else 'by light alone'}", day.phases, day, lights)
    report("  of these, without a time", day.untimed, day, lights)
    report("  key photos", day.keys, day, lights)


def main(command: Command) -> None:
    lights = find_lights(SyntheticConfig(seed=command.seed))
    scene = wildgs.load(command.run)
    with tempfile.TemporaryDirectory() as folder:
        if command.clocks:
            wrong = dict.fromkeys(write_clocks(scene, lights, Path(folder), command.wrong), "set wrong")
            title, day = "with true hours", find_day(scene, Path(folder))
        else:  # first without, since the run folder keeps the last order
            report_day("without EXIF", find_day(scene, Path(folder)), lights)
            wrong = wrong_clocks(scene, lights, command.seed)
            title, day = "as the photos are", find_day(scene)
    report_day(title, day, lights)
    for name, fault in sorted(wrong.items()):
        print(f"{name}: {fault}; {'left out' if name in day.left_out else 'not found'}")
    print(f"left out though right: {', '.join(sorted(set(day.left_out) - set(wrong))) or 'none'}")


if __name__ == "__main__":
    main(tyro.cli(Command))
