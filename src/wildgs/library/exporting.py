"""`wildgs.export`: writes files for other programs, or a relightable web page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import torch

from wildgs.errors import UserError
from wildgs.evaluation.pictures import picture_paths
from wildgs.exporters.config import CleanupConfig
from wildgs.exporters.formats import SPZ_VERSION, SplatFormat, SpzVersion, write_splats
from wildgs.exporters.glb import glb_bytes
from wildgs.exporters.lights import ExportLight, RelightableScene, SharedHarmonics, share_harmonics, upright
from wildgs.exporters.outputs import names_file
from wildgs.exporters.splats import Splats, agreement, clean
from wildgs.exporters.usd import write_usd
from wildgs.files import written_aside
from wildgs.library.config import ExportFormat, MixOptions
from wildgs.library.day import read_times, viewpoints_of
from wildgs.library.loaded import LoadedScene, Spec, find_looks, folder_of, loaded, without_repeats
from wildgs.library.logs import logger
from wildgs.library.pages import ExportedFile, baked, page_looks, thumbnail, write_webpage
from wildgs.light.look import NEUTRAL, Look
from wildgs.model.gaussians import NEAR
from wildgs.progress import Progress
from wildgs.scene import Alignment
from wildgs.scene.start import choose_start

COMPARED_VIEWS = 4


@dataclass(frozen=True)
class _Request:
    """Options that all files of one export share."""

    scene: LoadedScene
    output: Path
    single: bool  # whether the output is the only file, rather than a folder
    title: str
    aligned: bool
    cleanup: CleanupConfig
    spz_version: SpzVersion


def export(
    run: str | Path | LoadedScene,
    formats: str | Sequence[str] = "html",
    *,
    appearance: str | Path | Look | Sequence[str | Path | Look] = (),
    output: str | Path | None = None,
    title: str | None = None,
    aligned: bool = False,
    cleanup: CleanupConfig | None = None,
    spz_version: SpzVersion = SPZ_VERSION,
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> list[ExportedFile]:
    """Exports a run to files: html, glb and usd with all appearances in one file, other formats with one each.

    Args:
        run: A run folder, or a loaded scene.
        formats: One or more of `ExportFormat`.
        appearance: Anything that `LoadedScene.appearance` accepts. Default: several photos of very different light
            for html, glb and usd; neutral for the others.
        output: Folder for the files, or the file itself if only one is written. Default: RUN/export.
        title: Title of html, glb and usd. Default: the run folder's name.
        aligned: Use the frame of training (+z up, median depth of the photos = 1) instead of the COLMAP model's.
        cleanup: What to drop. Unless it sets a degree, .ply files have all 45 coefficients above degree 0, padded
            with zeros.
        spz_version: 4, or 3 for programs that do not support 4 yet.
        mixing: How appearances are obtained and mixed.
        progress: Called during long work.

    Raises:
        UserError: A format is unknown, an appearance cannot be obtained, no Gaussian is left, or a file cannot be
            written.
    """
    formats = _known_formats([formats] if isinstance(formats, str) else formats)
    kinds: list[SplatFormat] = [kind for kind in formats if kind not in ("html", "glb", "usd")]
    if title is not None and len(kinds) == len(formats):
        raise UserError("--title is only used for html, glb and usd; leave it out")
    if spz_version != SPZ_VERSION and "spz" not in kinds:
        raise UserError("--spz-version is only used for spz; leave it out, or add spz to --format")
    scene = loaded(run)
    output = folder_of(run) / "export" if output is None else Path(output)
    appearance = without_repeats(scene, appearance, mixing)
    count = _count_files(formats, appearance, mixing or MixOptions())
    request = _Request(
        scene,
        output,
        names_file(output, tuple(f".{kind}" for kind in formats), count),
        title or scene.run.folder.resolve().name,
        aligned,
        cleanup or CleanupConfig(),
        spz_version,
    )
    chosen = bool(appearance) or (mixing or MixOptions()) != MixOptions()
    looks = find_looks(scene, appearance or (NEUTRAL,), mixing, progress=progress) if kinds or chosen else []
    files = _files(request, looks, kinds)
    if scene.gaussians.antialiased and any(kind != "html" for kind in formats):
        logger.info(
            "the run is antialiased, which these formats cannot record: programs that render without antialiasing"
            " show small Gaussians too opaque from a distance (docs/export.md)"
        )
    several = [kind for kind in formats if kind in ("html", "glb", "usd")]
    shown = looks if chosen or not several else page_looks(scene, progress)
    written = []
    for kind in several:
        name = f"page.{kind}" if kind == "html" else f"scene.{kind}"
        file = request.output if request.single else request.output / name
        write = _write_page if kind == "html" else _write_relightable
        written.append(write(request, shown, file))
    for look in looks if kinds else ():
        written += _write_look(request, look, {kind: files[look, kind] for kind in kinds})
    return written


def _known_formats(formats: Sequence[str]) -> list[ExportFormat]:
    """The formats in their order, each once; raises `UserError` if one is unknown or there is none."""
    known: tuple[ExportFormat, ...] = get_args(ExportFormat)
    if not formats:
        raise UserError(f"--format needs at least one of {', '.join(known)}")
    for name in formats:
        if name not in known:
            raise UserError(f"unknown format {name!r}; choose {', '.join(known)}")
    return [kind for kind in dict.fromkeys(formats) if kind in known]


def _count_files(formats: Sequence[ExportFormat], specs: Sequence[Spec], mixing: MixOptions) -> int:
    """Number of files, before any appearance is computed."""
    several = sum(kind in ("html", "glb", "usd") for kind in formats)
    looks = 1 if mixing.weights else max(len(specs), 1)
    return several + (len(formats) - several) * looks


def _files(
    request: _Request, looks: list[Look], kinds: list[SplatFormat]
) -> dict[tuple[Look, SplatFormat], Path]:
    """The file of each look in each format; all names are unique."""
    folder = request.output
    if request.single and kinds:
        return {(looks[0], kinds[0]): folder}
    named = picture_paths([f"{number}/{look.name}" for number, look in enumerate(looks)])
    stems = [path.relative_to(path.parts[0]).with_suffix("") for path in named.values()]
    taken = {stem for number, stem in enumerate(stems) if stem in stems[:number]}
    return {
        (look, kind): folder / stem.with_name(f"{stem.name}{f'_{number}' if stem in taken else ''}.{kind}")
        for number, (look, stem) in enumerate(zip(looks, stems, strict=True))
        for kind in kinds
    }


def _write_page(request: _Request, looks: Sequence[Look], file: Path) -> ExportedFile:
    if request.cleanup.active:
        _cleaned(request, looks[0])
    return write_webpage(request.scene, looks, file, title=request.title, cleanup=request.cleanup)


@torch.no_grad()
def _write_relightable(request: _Request, looks: Sequence[Look], file: Path) -> ExportedFile:
    """Writes all lights to one .glb or .usd file."""
    loaded, collection = request.scene, request.scene.scene
    viewpoints = viewpoints_of(collection.views)
    motion = upright(loaded.run.alignment, aligned=request.aligned)
    splats = [_cleaned(request, look).moved(motion) for look in looks]
    start, _ = choose_start(collection)
    times = read_times(loaded)
    harmonics = share_harmonics(
        splats[0],
        [each.sh for each in splats],
        motion.apply_points(viewpoints),
        request.cleanup.own_harmonics if file.suffix.lower() == ".glb" else 1.0,
    )
    content = RelightableScene(
        title=request.title,
        splats=splats[0],
        lights=[
            ExportLight(look.name, each.sh, thumbnail(loaded, look, start), times.get(look.name))
            for look, each in zip(looks, splats, strict=True)
        ],
        start=motion.apply_camera(start.camera),
        near=NEAR * motion.scale,
        placement=_to_colmap(motion, loaded.run.alignment),
    )
    if file.suffix.lower() == ".usd":
        write_usd(file, content)
    else:
        with written_aside(file) as aside:
            aside.write_bytes(glb_bytes(content, harmonics))
        _report_shared(request, splats, harmonics, motion)
    size = file.stat().st_size / 1e6
    return ExportedFile(file, size, len(splats[0]), splats[0].sh_degree, tuple(looks))


def _to_colmap(motion: Alignment, alignment: Alignment) -> Alignment:
    """The transform from a file's frame to the COLMAP model's, through the aligned frame."""
    into, back = motion.inverse(), alignment.inverse()
    return Alignment(
        back.rotation @ into.rotation, back.apply_points(into.translation), back.scale * into.scale
    )


def _report_shared(
    request: _Request, splats: Sequence[Splats], harmonics: SharedHarmonics, motion: Alignment
) -> None:
    """Logs the loss in quality from sharing harmonics between the lights."""
    if harmonics.all_own:
        return
    collection = request.scene.scene
    cameras = [
        motion.apply_camera(view.camera)
        for view in (collection.test_views or collection.views)[:COMPARED_VIEWS]
    ]
    same = [
        agreement(each, each.with_sh(harmonics.whole(number)), cameras) for number, each in enumerate(splats)
    ]
    logger.info(
        f"{len(splats)} lights share harmonics above degree 0, except for {request.cleanup.own_harmonics:.0%} of "
        f"the Gaussians: {min(same):.1f} to {max(same):.1f} dB PSNR against separate harmonics, over "
        f"{len(cameras)} views (--own-harmonics 1 keeps all separate)"
    )


def _write_look(request: _Request, look: Look, files: dict[SplatFormat, Path]) -> list[ExportedFile]:
    """Writes one look in every format."""
    splats = _cleaned(request, look)
    placed = splats if request.aligned else splats.to_input_frame(request.scene.run.alignment)
    written = []
    for kind, file in files.items():
        write_splats(
            file, placed, kind, full_sh=request.cleanup.sh_degree is None, spz_version=request.spz_version
        )
        size = file.stat().st_size / 1e6
        written.append(ExportedFile(file, size, len(placed), placed.sh_degree, (look,)))
    return written


def _cleaned(request: _Request, look: Look) -> Splats:
    """The Gaussians of a look that remain after clean-up; logs their number and the loss in quality."""
    whole, scene = baked(request.scene, look), request.scene.scene
    splats = clean(request.cleanup, whole, scene.points, viewpoints_of(scene.views))
    if not len(splats):
        raise UserError(
            "these options drop all Gaussians; lower --min-opacity, or raise --crop or --max-distance"
        )
    if request.cleanup.active:
        views = (scene.test_views or scene.views)[:COMPARED_VIEWS]
        same = agreement(whole, splats, [view.camera for view in views])
        logger.info(
            f"{look.name}: kept {len(splats):,} of {len(whole):,} Gaussians, harmonics of degree "
            f"{splats.sh_degree}; {same:.1f} dB PSNR against all Gaussians, over {len(views)} views"
        )
    return splats
