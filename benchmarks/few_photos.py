"""Makes a scene of few training photos from a larger one, with the sparse points that these photos observe.

    python benchmarks/few_photos.py ../shared/data/gate gate10 --photos 10
    cp -r gate10 gate10-stereo && wildgs depth gate10-stereo --by stereo
    wildgs train gate10-stereo --output run --steps 1500 --downscale 2 --density.max-gaussians 40000

The study trains with `--parsing.max-side 192` as well. Training photos are those with the numbers
round((n - 1) i / (photos - 1)) of n; all test photos stay, and `depth/` is left out. Points that fewer than two of
the chosen photos observe are removed (`--all-points` keeps them), as are observations by other photos.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import tyro


@dataclass(frozen=True)
class Command:
    """Makes a scene of few training photos."""

    scene: tyro.conf.Positional[Path]
    """Scene with a split (*.tsv)."""
    output: tyro.conf.Positional[Path]
    """Folder to write; its photos are links."""
    photos: int = 10
    """Number of training photos."""
    all_points: bool = False
    """Keep points that other photos observe."""


def main(command: Command) -> None:
    """Writes the scene."""
    table = next(command.scene.glob("*.tsv"))
    with table.open(newline="") as file:
        header, *rows = csv.reader(file, delimiter="\t")
    name, split = header.index("filename"), header.index("split")
    training = [row for row in rows if row[split] == "train"]
    numbers = np.linspace(0, len(training) - 1, command.photos).round().astype(int)
    chosen = [training[number] for number in numbers]
    sparse = command.output / "sparse" / "0"
    sparse.mkdir(parents=True)
    for part in ("images", "truth", "masks"):
        if (command.scene / part).is_dir():
            (command.output / part).symlink_to((command.scene / part).resolve())
    with (command.output / "split.tsv").open("w", newline="") as file:
        kept = [row for row in rows if row[split] == "test"] + chosen
        csv.writer(file, delimiter="\t", lineterminator="\n").writerows([header, *kept])
    model = pycolmap.Reconstruction(command.scene / "sparse" / "0")
    if not command.all_points:
        _keep_own_points(model, {row[name] for row in chosen})
    model.write(sparse)
    print(f"{len(chosen)} training photos, {model.num_points3D():,} points")


def _keep_own_points(model: pycolmap.Reconstruction, names: set[str]) -> None:
    own = {image.image_id for image in model.images.values() if image.name in names}
    tracks = {
        number: [(element.image_id, element.point2D_idx) for element in point.track.elements]
        for number, point in model.points3D.items()
    }
    for number, track in tracks.items():
        if len({image for image, _ in track} & own) < 2:
            model.delete_point3D(number)
            continue
        for image, index in track:
            if image not in own:
                model.delete_observation(image, index)


if __name__ == "__main__":
    main(tyro.cli(Command))
