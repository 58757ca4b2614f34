"""Does a file that another program's library reads still show the scene? And what do smaller pages cost?

    python benchmarks/export_fidelity.py runs/gate [--appearance PHOTO] [--views 6]

Every format is written under one appearance in the input's own frame, read back by an independent reader (gsply;
for .splat and .sog first PlayCanvas's splat-transform, where it is on the PATH), and rendered there. The table
gives, over held-out views, PSNR against the render of the run itself, and how far PSNR against the photos moves
(the photos hold passers-by, so only the difference means something). The second table is the web page's: what each
degree of the harmonics costs in bytes and in PSNR, cut plainly and fitted to the cameras' directions.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import gsply
import numpy as np
import torch

import wildgs as api
from wildgs.exporters.formats import SplatFormat, write_splats
from wildgs.exporters.page_scene import pack_scene
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
    print_degrees(loaded, whole, views, original)


def print_degrees(
    loaded: api.LoadedScene, whole: Splats, views: list[View], original: list[torch.Tensor]
) -> None:
    """The page's table."""
    viewpoints = viewpoints_of(loaded.views)
    lights = [item.sh.cpu() for item in page_looks(loaded)]
    print(
        f"\n{'page, degree':16}{'bytes a splat':>15}{'dB fitted':>12}{'dB cut':>10}   ({len(lights)} lights)"
    )
    for degree in range(whole.sh_degree + 1):
        fit = (
            fit_truncation(whole.means, viewpoints, whole.sh_degree, degree)
            if degree < whole.sh_degree
            else None
        )
        packed = pack_scene(whole, [truncate_sh(sh, degree, fit).numpy() for sh in lights])
        costs = []
        for matrix in (fit, None):
            cut = whole.with_sh(truncate_sh(whole.sh, degree, matrix))
            costs.append(pooled(original, [picture(cut, view.camera) for view in views]))
        print(f"{degree:<16}{len(packed.data) / len(whole):15.1f}{costs[0]:12.2f}{costs[1]:10.2f}")


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
    return read.turned(torch.diag(torch.tensor([1.0, -1.0, -1.0]))) if kind == "spz" else read


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
