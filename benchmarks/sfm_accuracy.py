"""Poses by `wildgs sfm` against known ones: photos registered, and errors and AUC of relative poses.

    python benchmarks/sfm_accuracy.py ../shared/data/gate --every 2
    python benchmarks/sfm_accuracy.py demo --mix ../shared/data/liberty --mixed 30

The error of a pair of photos is the larger one of the angles of rotation and of the direction of translation; pairs
with a photo that has no pose count as wrong. AUC is the area under the share of pairs below an error, as in Jin et
al., "Image matching across wide baselines", IJCV 2021.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from itertools import combinations
from pathlib import Path

import numpy as np

import wildgs
from wildgs.scene.colmap import read_model
from wildgs.scene.demo import write_demo_scene
from wildgs.sfm.config import PairingConfig, SfmConfig


def poses_of(scene: Path) -> dict[str, np.ndarray]:
    """World-to-camera matrices by stem of the photo."""
    return {Path(image.name).stem: image.viewmat.double().numpy() for image in read_model(scene).images}


def angle(cosine: float) -> float:
    """Degrees."""
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def pose_error(first: np.ndarray, second: np.ndarray) -> float:
    """Degrees between two relative poses whose scale is not known."""
    rotation = angle((np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2)
    a, b = first[:3, 3], second[:3, 3]
    return max(rotation, angle(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)))


def auc(errors: np.ndarray, limit: float) -> float:
    """Area under the share of pairs whose error is below x, for x from 0 to the limit, between 0 and 1."""
    return float(np.clip(1 - errors / limit, 0, None).mean())


def main() -> None:
    """Prints one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="COLMAP scene with known poses, or `demo`")
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")
    parser.add_argument("--mix", type=Path, help="scene of another place whose photos are mixed in")
    parser.add_argument("--mixed", type=int, default=30)
    usual = PairingConfig()
    parser.add_argument("--exhaustive-features", type=int, default=usual.exhaustive_features)
    parser.add_argument("--neighbours", type=int, default=usual.neighbours)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        scene = write_demo_scene(root / "demo") if arguments.scene == "demo" else Path(arguments.scene)
        truth = poses_of(scene)
        files = sorted(path for path in (scene / "images").rglob("*") if path.stem in truth)[
            :: arguments.every
        ]
        (root / "photos").mkdir()
        for file in files:
            shutil.copy(file, root / "photos")
        if arguments.mix:
            for file in sorted((arguments.mix / "images").iterdir())[: arguments.mixed]:
                shutil.copy(file, root / "photos" / f"mixed_{file.name}")
        started, used = time.perf_counter(), time.process_time()
        pairing = PairingConfig(arguments.exhaustive_features, arguments.neighbours)
        report = wildgs.reconstruct(root / "photos", root / "out", SfmConfig(pairing=pairing))
        found = poses_of(root / "out")
        strangers = sum(name.startswith("mixed_") for name in found)
        errors = []
        for a, b in combinations([file.stem for file in files], 2):
            if a in found and b in found:
                relative = [poses[b] @ np.linalg.inv(poses[a]) for poses in (truth, found)]
                errors.append(pose_error(*relative))
            else:
                errors.append(np.inf)
        scores = np.array(errors)
        known = scores[np.isfinite(scores)]
        middle, large = np.quantile(known, [0.5, 0.9]) if len(known) else (np.nan, np.nan)
        print(
            f"{arguments.scene} every {arguments.every}: {len(found) - strangers} of {len(files)} registered,"
            f" {strangers} strangers, AUC@5 {auc(scores, 5):.3f}, AUC@10 {auc(scores, 10):.3f},"
            f" registered pairs {middle:.2f} degrees off (90%: {large:.1f}),"
            f" {report.points} points, {report.pairs} pairs,"
            f" other places {[len(group) for group in report.other_places]},"
            f" {time.perf_counter() - started:.0f} s"
            f" ({time.process_time() - used:.0f} s of CPU)"
        )


if __name__ == "__main__":
    main()
