"""`wildgs.export`: files for other programs, and the web page that carries the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from wildgs.errors import UserError
from wildgs.evaluation.pictures import picture_paths
from wildgs.exporters.config import CleanupConfig
from wildgs.exporters.formats import SplatFormat, write_splats
from wildgs.exporters.splats import Splats, agreement, clean
from wildgs.library.config import ExportFormat, MixOptions
from wildgs.library.loaded import LoadedScene, find_looks, loaded
from wildgs.library.logs import logger
from wildgs.library.pages import ExportedFile, baked, page_looks, viewpoints_of, write_webpage
from wildgs.light.look import NEUTRAL, Look
from wildgs.progress import Progress

COMPARED_VIEWS = 4
PAGE_FILE = "page.html"


@dataclass(frozen=True)
class _Request:
    """What every file of one export has in common."""

    scene: LoadedScene
    output: Path
    title: str
    aligned: bool
    cleanup: CleanupConfig


def export(
    run: str | Path | LoadedScene,
    formats: ExportFormat | Sequence[ExportFormat] = "html",
    *,
    appearance: Sequence[str | Path | Look] = (),
    output: str | Path | None = None,
    title: str | None = None,
    aligned: bool = False,
    cleanup: CleanupConfig | None = None,
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> list[ExportedFile]:
    """Writes a run as files for other programs, one for each appearance, or as one web page with all of them.

    Args:
        run: A run folder, or a loaded scene.
        formats: One or several of `ExportFormat`.
        appearance: What `LoadedScene.appearance` takes. By default the page takes four photos as different as the
            scene has them, and other files are neutral.
        output: Folder for the files, by default RUN/export; with one file to write, it may be the file itself.
        title: The page's headline; by default the run folder's name.
        aligned: Keep the frame of training (+z up, the photos' median depth is 1) instead of the input's.
        cleanup: What to leave out.
        mixing: How appearances are found and mixed.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be had, nothing is left to write, or a file cannot be written.
    """
    formats = [formats] if isinstance(formats, str) else list(formats)
    kinds: list[SplatFormat] = [kind for kind in formats if kind != "html"]
    if not formats:
        raise UserError("--format needs at least one of html, ply, compressed.ply, splat, spz, sog")
    scene = loaded(run)
    folder = scene.run.folder
    request = _Request(
        scene,
        folder / "export" if output is None else Path(output),
        title or folder.resolve().name,
        aligned,
        cleanup or CleanupConfig(),
    )
    chosen = bool(appearance) or (mixing or MixOptions()) != MixOptions()
    looks = find_looks(scene, appearance or (NEUTRAL,), mixing, progress=progress) if kinds or chosen else []
    files = _files(request, looks, kinds, alone="html" not in formats)
    written = []
    if "html" in formats:
        written.append(
            _write_page(request, looks if chosen else page_looks(scene, progress), alone=not files)
        )
    for look in looks if kinds else ():
        written += _write_look(request, look, {kind: files[look, kind] for kind in kinds})
    return written


def _files(
    request: _Request, looks: list[Look], kinds: list[SplatFormat], *, alone: bool
) -> dict[tuple[Look, SplatFormat], Path]:
    """Where each look goes in each format; no two files share a name."""
    folder = request.output
    if len(looks) * len(kinds) == 1 and alone and folder.name.endswith(f".{kinds[0]}"):
        return {(looks[0], kinds[0]): folder}
    named = picture_paths([f"{number}/{look.name}" for number, look in enumerate(looks)])
    stems = [path.relative_to(path.parts[0]).with_suffix("") for path in named.values()]
    taken = {stem for number, stem in enumerate(stems) if stem in stems[:number]}
    return {
        (look, kind): folder / stem.with_name(f"{stem.name}{f'_{number}' if stem in taken else ''}.{kind}")
        for number, (look, stem) in enumerate(zip(looks, stems, strict=True))
        for kind in kinds
    }


def _write_page(request: _Request, looks: Sequence[Look], *, alone: bool) -> ExportedFile:
    file = request.output
    if not (alone and file.suffix == ".html"):
        file = file / PAGE_FILE
    if request.cleanup.active:
        _cleaned(request, looks[0])
    return write_webpage(request.scene, looks, file, title=request.title, cleanup=request.cleanup)


def _write_look(request: _Request, look: Look, files: dict[SplatFormat, Path]) -> list[ExportedFile]:
    """One look in every format, cleaned up once."""
    splats = _cleaned(request, look)
    placed = splats if request.aligned else splats.to_input_frame(request.scene.run.alignment)
    written = []
    for kind, file in files.items():
        write_splats(file, placed, kind)
        size = file.stat().st_size / 1e6
        written.append(ExportedFile(file, size, len(placed), placed.sh_degree, (look,)))
    return written


def _cleaned(request: _Request, look: Look) -> Splats:
    """What stays of a look's Gaussians; logs how many those are, and what that costs."""
    whole, scene = baked(request.scene, look), request.scene.scene
    splats = clean(request.cleanup, whole, scene.points, viewpoints_of(scene.views))
    if not len(splats):
        raise UserError(
            "these options leave no Gaussian; lower --min-opacity, or raise --crop or --max-distance"
        )
    if request.cleanup.active:
        views = (scene.test_views or scene.views)[:COMPARED_VIEWS]
        same = agreement(whole, splats, [view.camera for view in views])
        logger.info(
            f"{look.name}: {len(splats):,} of {len(whole):,} Gaussians stay, harmonics of degree "
            f"{splats.sh_degree}; {same:.1f} dB PSNR against all of them, over {len(views)} views"
        )
    return splats
