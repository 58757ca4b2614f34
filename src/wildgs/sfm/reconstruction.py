"""`reconstruct`: creates a COLMAP scene from a folder of photos by structure from motion with pycolmap."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import pycolmap
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.processes import signals_as_interrupts
from wildgs.progress import Progress, silent
from wildgs.scene.capture import carry_capture
from wildgs.scene.colmap import LAYOUTS
from wildgs.scene.images import read_mask
from wildgs.scene.undistort import PixelGrid, sample_mask
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.edited_photos import describe_edited
from wildgs.sfm.lookalikes import find_doubtful, judge_pairs
from wildgs.sfm.mapping import find_registered, quiet
from wildgs.sfm.match_pictures import FOLDER as PICTURES
from wildgs.sfm.match_pictures import write_match_pictures
from wildgs.sfm.passes import find_poses
from wildgs.sfm.placement import failures, other_places, placements
from wildgs.sfm.report import REPORT_NAME, SfmReport, read_masks
from wildgs.sfm.upright import JPEG_QUALITY, WorkingCopy, copy_upright
from wildgs.sfm.workplace import Workplace, open_workplace

SCENE_PARTS = ("images", "sparse", "masks", PICTURES, REPORT_NAME)
ASIDE, MOVED, DONE = ".replaced", ".moved", ".done"
"""Folder of the old scene during its replacement, and marker files in it: the old scene has been moved completely,
and the new one is in place."""


def reconstruct(
    photos: Path,
    output: Path,
    config: SfmConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SfmReport:
    """Estimates the cameras of a folder of photos and writes a scene for `load_scene`.

    Every photo has its own camera, features are SIFT, mapping is incremental with two additional passes
    (`wildgs.sfm.passes`), and the largest model is kept, refined (`wildgs.sfm.refinement`) and undistorted. CUDA is
    used if pycolmap was built with it. SIGTERM and SIGHUP interrupt the work like Ctrl-C. Intermediate results are
    kept in a hidden folder beside the output, so that the same call continues after an interruption.

    Args:
        photos: Folder of photos, searched with its sub-folders and not modified.
        output: Scene folder to write: `images/`, `sparse/0/`, `masks/` if photos have transparent pixels, and
            `sfm_report.json`. It is created when everything is done.
        config: Options; None for the defaults.
        overwrite: Replace an existing scene in `output` once the new one is complete. Its depth maps, and masks
            that were added to it, do not fit the new photos and are renamed to `depth_replaced/` and
            `masks_replaced/`.
        progress: Called during all steps.

    Returns:
        Which photos were registered, and why the others were not.

    Raises:
        UserError: There are fewer than two readable photos, they do not match, or `output` is in use.
    """
    config, progress = config or SfmConfig(), progress or silent
    photos, output = Path(photos), Path(output)
    started = time.perf_counter()
    check_photos(photos, output)
    with _writing(output):
        return _reconstruct(photos, output, config, overwrite, progress, started)


def _reconstruct(
    photos: Path, output: Path, config: SfmConfig, overwrite: bool, progress: Progress, started: float
) -> SfmReport:
    _restore(output)
    _check_output(photos, output, overwrite)
    output.parent.mkdir(parents=True, exist_ok=True)
    with signals_as_interrupts(), open_workplace(photos, output, config) as work, quiet():
        copies, broken = _copy(work, photos, config, progress)
        if len(copies) < 2:
            raise UserError(
                f"{photos}: contains {len(copies)} readable photo(s); at least two of the same place are needed,"
                " better twenty"
            )
        pycolmap.set_random_seed(config.seed)
        poses = find_poses(work, copies, config, progress)
        if poses is None:
            raise UserError(
                f"{photos}: the {len(copies)} photos do not match each other; give photos of one place with much"
                " overlap"
            )
        model = poses.models[0]
        progress("undistorting", 0, 0)
        _write_scene(work, copies, model)
        without = failures(work, copies, poses.models, poses.findings)
        names = {copy.work_name: copy.scene_name for copy in copies}
        judged = judge_pairs(model, work.database)
        report = SfmReport(
            photos=len(copies) + len(broken),
            registered=tuple(sorted(c.scene_name for c in copies if find_registered(model, c) is not None)),
            left_out={**broken, **{name: failure.reason for name, failure in without.items()}},
            points=model.num_points3D(),
            reprojection_error=float(model.compute_mean_reprojection_error()),
            pairing=poses.pairing.name,
            pairs=len(poses.pairing.pairs),
            models=tuple(other.num_reg_images() for other in poses.models),
            other_places=other_places(without.values()),
            seconds=time.perf_counter() - started,
            renamed={c.name: c.scene_name for c in copies if _is_renamed(c)},
            masks=_files_in(work.scene / "masks"),
            placed=placements(model, copies, poses.passes),
            copies={copies[a].name: copies[b].name for a, b in poses.findings.crops.items()},
            pictures=write_match_pictures(work, copies, without),
            doubtful={names[n]: why for n, why in find_doubtful(judged, names).items()},
            edited={names[n]: how for n, how in describe_edited(model).items()},
        )
        report.write(work.scene)
        _check_output(photos, output, overwrite)  # again, as another process may have written to it
        _move_in(work.scene, output)
    return report


def _copy(
    work: Workplace, photos: Path, config: SfmConfig, progress: Progress
) -> tuple[list[WorkingCopy], dict[str, str]]:
    """Makes the working copies, or reuses those of an interrupted call if they are complete."""
    kept = work.load_copies()
    if kept is not None:
        return kept
    copies, broken = copy_upright(
        photos,
        work.images,
        work.masks,
        max_pixels=config.max_image_pixels,
        progress=lambda done, total: progress("reading photos", done, total),
    )
    work.save_copies(copies, broken)
    return copies, broken


def check_photos(photos: Path, output: Path) -> None:
    """Checks the folder of photos, and that the output is outside it (its images would be taken as photos).

    Args:
        photos: Folder of photos.
        output: The scene or run folder to write.

    Raises:
        UserError: The folder does not exist, or the output is in it.
    """
    if not photos.is_dir():
        raise UserError(f"{photos}: no such folder; give the folder of the photos")
    place, folder = output.resolve(), photos.resolve()
    if place.is_relative_to(folder):
        raise UserError(
            f"{output}: is inside the folder of the photos, {photos}, whose sub-folders are searched for photos; "
            "choose another --output"
        )


@contextmanager
def _writing(output: Path) -> Iterator[None]:
    """Converts errors of writing to `UserError`."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "disk is full" not in str(error):  # SQLite's message
            raise
        raise UserError(
            f"{output} cannot be written ({error}); free disk space, fix permissions or choose another --output"
        ) from error


def _check_output(photos: Path, output: Path, overwrite: bool) -> None:
    """Checks that no photos or models of the user or of other programs would be overwritten."""
    if output.exists() and not output.is_dir():
        raise UserError(f"{output}: is a file; give a folder for the scene")
    folders = ("images", "masks", *(sparse for sparse, _ in LAYOUTS))
    taken = [name for name in folders if (output / name).exists()]
    if not taken:
        return
    if photos.resolve().is_relative_to(output.resolve()):
        raise UserError(f"{output}: the photos are in this folder, which would be overwritten; give another")
    if not (output / REPORT_NAME).is_file():
        raise UserError(f"{output}: contains {taken[0]}/ not made by `wildgs sfm`; give another folder")
    if not overwrite:
        raise UserError(f"{output}: already contains a scene; give another folder, or --overwrite")


def _is_renamed(copy: WorkingCopy) -> bool:
    return str(PurePosixPath(copy.name).with_suffix("")) != str(
        PurePosixPath(copy.scene_name).with_suffix("")
    )


def _files_in(folder: Path) -> tuple[str, ...]:
    return tuple(sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()))


def _move_in(scene: Path, output: Path) -> None:
    """Moves the finished scene to `output`, keeping other files there.

    If that fails, the old scene is restored; if the process is killed, the next call restores it.
    """
    output.mkdir(exist_ok=True)
    aside = output / ASIDE
    aside.mkdir()
    try:
        for name in (*SCENE_PARTS, "depth"):
            if (output / name).exists():
                (output / name).rename(aside / name)
        (aside / MOVED).touch()
        # The report first, which marks the folder as a scene of `wildgs sfm` if the process is killed.
        for item in sorted(scene.iterdir(), key=lambda item: item.name != REPORT_NAME):
            item.rename(output / item.name)
    except BaseException:
        _restore(output)
        raise
    kept = [_keep(aside / name, output) for name in _not_made_here(aside)]
    (aside / DONE).touch()
    shutil.rmtree(aside)
    if kept:
        warnings.warn(
            f"{output}: {' and '.join(kept)} belonged to the replaced scene and may not fit the new one; delete"
            " them if they are no longer needed",
            WildGSWarning,
            stacklevel=3,
        )


def _restore(output: Path) -> None:
    """Restores the old scene after a failed or killed replacement."""
    aside = output / ASIDE
    if not aside.is_dir():
        return
    if not (aside / DONE).exists():
        if (aside / MOVED).exists():
            for new in (output / name for name in SCENE_PARTS):
                shutil.rmtree(new) if new.is_dir() else new.unlink(missing_ok=True)
            (aside / MOVED).unlink()  # first, since files restored from here on are those of the old scene
        for item in aside.iterdir():
            item.replace(output / item.name)
    shutil.rmtree(aside)


def _not_made_here(aside: Path) -> list[str]:
    """Parts of a replaced scene that `reconstruct` did not write: depth maps and added masks."""
    names = ["depth"] if (aside / "depth").is_dir() else []
    if set(_files_in(aside / "masks")) - set(read_masks(aside)):
        names.append("masks")
    return names


def _keep(folder: Path, output: Path) -> str:
    """Renames a folder of the replaced scene; returns its new name."""
    number, target = 1, output / f"{folder.name}_replaced"
    while target.exists():
        number += 1
        target = output / f"{folder.name}_replaced_{number}"
    folder.rename(target)
    return f"{target.name}/"


def _write_scene(work: Workplace, copies: Sequence[WorkingCopy], model: Any) -> None:
    """Undistorts the photos of the model and restores their names."""
    kept, dense = work.fresh("kept"), work.fresh("dense")
    work.fresh("scene")
    model.write(kept)
    pycolmap.undistort_images(dense, kept, work.images, jpeg_quality=JPEG_QUALITY)
    pinhole = pycolmap.Reconstruction(dense / "sparse")
    for copy in copies:
        image, original = find_registered(pinhole, copy), find_registered(model, copy)
        if image is None or original is None:
            continue
        image.name = copy.scene_name
        target = work.scene / "images" / copy.scene_name
        target.parent.mkdir(parents=True, exist_ok=True)
        carry_capture(work.images / copy.work_name, dense / "images" / copy.work_name)
        (dense / "images" / copy.work_name).rename(target)
        if copy.masked:
            _write_mask(work, copy, original.camera)
    (work.scene / "sparse" / "0").mkdir(parents=True)
    pinhole.write(work.scene / "sparse" / "0")


def _write_mask(work: Workplace, copy: WorkingCopy, camera: Any) -> None:
    grid = PixelGrid.from_colmap(camera, 1)
    mask = read_mask(work.masks / f"{copy.work_name}.png", grid.resized)
    source = grid.source()
    target = work.scene / "masks" / f"{copy.scene_name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask if source is None else sample_mask(mask, source)).save(target)
