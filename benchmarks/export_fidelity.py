"""Does a file that another program's library reads still show the scene? And what do smaller pages cost?

    python benchmarks/export_fidelity.py runs/gate [--appearance PHOTO] [--views 6]

Every format is written under one appearance in the input's own frame, read back by an independent reader (gsply;
for .splat and .sog first PlayCanvas's splat-transform, where it is on the PATH), and rendered there. The table
gives, over held-out views, PSNR against the render of the run itself, and how far PSNR against the photos moves
(the photos hold passers-by, so only the difference means something). The second table is the web page's, under all
of its lights, against renders of the run: what its bytes cost, and what each degree of the harmonics costs before
they are rounded to bytes, fitted to the cameras' directions as in the page, and cut plainly.
"""

from __future__ import annotations

import argparse
import gzip
import shutil
import subprocess
import tempfile
from pathlib import Path

import gsply
import numpy as np
import torch

import wildgs as api
from wildgs.exporters.formats import SplatFormat, write_splats
from wildgs.exporters.page_scene import PackedScene, pack_scene
from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import fit_truncation, truncate_sh
from wildgs.library.pages import baked, page_looks, viewpoints_of
from wildgs.model.gaussians import NEAR
from wildgs.rasterize import rasterize
from wildgs.scene import View

KINDS: tuple[SplatFormat, ...] = ("ply", "compressed.ply", "spz", "splat", "sog")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument(
        "--appearance", default=None, help="photo whose light is baked; the first held-out one"
    )
    parser.add_argument("--views", type=int, default=6)
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    loaded = api.load(options.run, device="cpu")
    views = list(loaded.scene.test_views or loaded.views)[: options.views]
    look = loaded.appearance(options.appearance or views[0].name)
    whole = baked(loaded, look)
    back = loaded.run.alignment.inverse()
    original = [picture(whole, view.camera) for view in views]
    placed = whole.to_input_frame(loaded.run.alignment)
    print(f"{options.run}: {len(whole):,} Gaussians under {look.name}, {len(views)} views\n")
    print(f"{'format':16}{'MB':>8}{'dB to the run':>16}{'photo PSNR moves':>19}")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, f"scene.{kind}")
            write_splats(file, placed, kind)
            read = read_back(file, kind)
            if read is None:
                print(f"{kind:16}{megabytes(file):8.2f}   not read back: no splat-transform on the PATH")
                continue
            again = [picture(read, back.apply_camera(view.camera), back.scale) for view in views]
            same, moved = pooled(original, again), shift(views, original, again)
            print(f"{kind:16}{megabytes(file):8.2f}{same:16.2f}{moved:19.3f}")
    print_degrees(loaded, whole, views)


def print_degrees(loaded: api.LoadedScene, whole: Splats, views: list[View]) -> None:
    """The page's table."""
    viewpoints = viewpoints_of(loaded.views)
    lights = [item.sh.cpu() for item in page_looks(loaded)]
    original = pictures(whole, lights, views)
    head = f"{'page, degree':16}{'bytes a splat':>15}{'dB encoded':>12}{'worst light':>13}"
    print(f"\n{head}{'dB fitted':>12}{'dB cut':>10}   ({len(lights)} lights)")
    for degree in range(whole.sh_degree + 1):
        fit = None
        if degree < whole.sh_degree:
            fit = fit_truncation(whole.means, viewpoints, whole.sh_degree, degree)
        fitted, cut = ([truncate_sh(sh, degree, matrix) for sh in lights] for matrix in (fit, None))
        packed = pack_scene(whole, [sh.numpy() for sh in fitted])
        shown = pictures(*unpack_scene(packed), views)
        each = len(views)
        worst = min(pooled(original[i : i + each], shown[i : i + each]) for i in range(0, len(shown), each))
        costs = [pooled(original, pictures(whole, shs, views)) for shs in (fitted, cut)]
        size = len(packed.data) / len(whole)
        print(
            f"{degree:<16}{size:15.1f}{pooled(original, shown):12.2f}{worst:13.2f}{costs[0]:12.2f}{costs[1]:10.2f}"
        )


def pictures(splats: Splats, lights: list[torch.Tensor], views: list[View]) -> list[torch.Tensor]:
    """Of all views under each light."""
    return [picture(splats.with_sh(sh), view.camera) for sh in lights for view in views]


def unpack_scene(packed: PackedScene) -> tuple[Splats, list[torch.Tensor]]:
    """What the page makes of its bytes, as `web/src/scene.js` does."""
    header, count = packed.header, packed.header["count"]
    data, planes, start = np.frombuffer(gzip.decompress(packed.data), np.uint8), {}, 0
    for name, lines in header["planes"]:
        planes[name] = data[start : start + lines * count].reshape(lines, count)
        start += lines * count
    high, middle, low = planes["means"].reshape(3, 3, count).astype(np.uint32).transpose(1, 0, 2)
    least, most = (np.array(header["means"][key])[:, None] for key in ("least", "most"))
    means = np.sinh(least + (high << 16 | middle << 8 | low) / 0xFFFFFF * (most - least)).T
    scales = np.exp(header["scales"]["least"] + planes["scales"] * header["scales"]["step"]).T
    words = sum(planes["quats"][byte].astype(np.uint32) << 8 * byte for byte in range(4))
    small = np.stack([(words >> shift & 1023) / 1023 - 0.5 for shift in (0, 10, 20)], axis=1) * 2**0.5
    largest = words >> 30
    quats = np.empty((count, 4))
    quats[np.arange(4)[None] != largest[:, None]] = small.reshape(-1)
    quats[np.arange(count), largest] = np.sqrt((1 - np.square(small).sum(axis=1)).clip(0))
    colors, codes, lights = header["colors"], planes["light0"], []
    degrees = np.repeat(
        np.arange(header["sh_degree"] + 1), [3 * (2 * d + 1) for d in range(header["sh_degree"] + 1)]
    )
    least, step = (np.array(colors[key])[degrees, None] for key in ("least", "step"))
    for number in range(sum(name.startswith("light") for name, _ in header["planes"])):
        codes = planes["light0"] + (planes[f"light{number}"] if number else np.uint8(0))
        lights.append(torch.from_numpy((least + step * codes).T.astype(np.float32)).reshape(count, -1, 3))
    opacities = planes["opacities"][0] / 255
    arrays = (means, np.roll(quats, 1, axis=1), scales, opacities)
    return Splats(*(torch.from_numpy(a.astype(np.float32)) for a in arrays), lights[0]), lights


def picture(splats: Splats, camera: Camera, scale: float = 1.0) -> torch.Tensor:
    """As it is shown: 8 bits."""
    values = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh.contiguous())
    rendering = rasterize(*values, camera, sh_degree=splats.sh_degree, near=NEAR * scale, depth=False)
    return (rendering.colors.double().clamp(0, 1) * 255).round() / 255


def read_back(file: Path, kind: SplatFormat) -> Splats | None:
    """Through gsply, after splat-transform for what gsply does not read."""
    if kind in ("splat", "sog"):
        tool = shutil.which("splat-transform")
        if tool is None:
            return None
        plain = file.with_name("back.ply")
        subprocess.run([tool, "-w", str(file), str(plain)], check=True, capture_output=True)
        file = plain
    data = gsply.read_spz(file) if kind == "spz" else gsply.plyread(file)
    rest = data.shN if data.shN is not None else np.zeros((len(data.means), 0, 3), np.float32)
    arrays = (
        data.means,
        data.quats,
        data.scales,
        data.opacities,
        np.concatenate([data.sh0[:, None], rest], axis=1),
    )
    means, quats, scales, opacities, sh = (torch.from_numpy(np.array(a, dtype=np.float32)) for a in arrays)
    read = Splats(means, quats, scales.exp(), opacities.reshape(-1).sigmoid(), sh)
    return read.rotated(torch.diag(torch.tensor([1.0, -1.0, -1.0]))) if kind == "spz" else read


def pooled(first: list[torch.Tensor], second: list[torch.Tensor]) -> float:
    errors = [(a - b).square().mean() for a, b in zip(first, second, strict=True)]
    return float(-10 * torch.log10(torch.stack(errors).mean().clamp_min(1e-10)))


def shift(views: list[View], first: list[torch.Tensor], second: list[torch.Tensor]) -> float:
    """Mean change of PSNR against the photos, dB."""
    changes = []
    for view, before, after in zip(views, first, second, strict=True):
        photo = view.read_photo().double() / 255
        changes.append(pooled([photo], [after]) - pooled([photo], [before]))
    return float(np.mean(changes))


def megabytes(file: Path) -> float:
    return file.stat().st_size / 1e6


if __name__ == "__main__":
    main()
