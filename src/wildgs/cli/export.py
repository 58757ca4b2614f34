"""`wildgs export`: files for other programs, and the web page that carries the light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from wildgs import api
from wildgs.cli.lights import MixOptions, find_looks
from wildgs.cli.progress import console
from wildgs.cli.webpage import baked, page_looks, viewpoints_of, write_webpage
from wildgs.errors import UserError
from wildgs.evaluation.pictures import picture_paths
from wildgs.export.cleanup import CleanupConfig, agreement, clean
from wildgs.export.formats import SplatFormat, write_splats
from wildgs.export.splats import Splats
from wildgs.light.look import NEUTRAL, Look

ExportFormat = Literal["html", "ply", "compressed.ply", "splat", "spz", "sog"]
"""The page, and what `SplatFormat` lists."""

COMPARED_VIEWS = 4
PAGE_FILE = "page.html"


@dataclass(frozen=True)
class Command:
    """Writes a run as files for other programs, one for each appearance, or as one web page with all of them.

    The page opens from disk without server or network. Other files hold the scene under one light, in the frame
    and scale of the photos' reconstruction.

    Example: wildgs export runs/gate --format html --appearance evening.jpg noon.jpg night.jpg
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: tuple[ExportFormat, ...] = ("html",)
    """One or several of html, ply, compressed.ply, splat, spz, sog."""
    appearance: tuple[str, ...] = ()
    """Photos of the scene by name, files of new photos or any pictures, saved appearances, or neutral. Without
    any, the page takes four photos as different as the scene has them, and other files are neutral."""
    mix: Annotated[MixOptions, tyro.conf.arg(name="")] = field(default_factory=MixOptions)
    output: Path | None = None
    """Folder for the files; RUN/export unless given. With one file to write, it may be the file itself."""
    title: str | None = None
    """The page's headline; the run folder's name unless given."""
    aligned: bool = False
    """Keep the frame of training (+z up, the photos' usual depth is 1) instead of the input's."""
    cleanup: Annotated[CleanupConfig, tyro.conf.arg(name="")] = field(default_factory=CleanupConfig)


def run(command: Command) -> None:
    """Finds the looks and writes every file."""
    kinds: list[SplatFormat] = [kind for kind in command.format if kind != "html"]
    with_page = "html" in command.format
    if not command.format:
        raise UserError("--format needs at least one of html, ply, compressed.ply, splat, spz, sog")
    loaded = api.load(command.run)
    chosen = bool(command.appearance) or command.mix != MixOptions()
    looks = find_looks(loaded, command.mix, command.appearance or (NEUTRAL,)) if kinds or chosen else []
    files = _files(command, looks, kinds)
    if with_page:
        shown = looks if chosen else page_looks(loaded)
        _write_page(command, loaded, shown, alone=not files)
    for look in looks if kinds else ():
        _write_look(command, loaded, look, {kind: files[look, kind] for kind in kinds})


def _files(
    command: Command, looks: list[Look], kinds: list[SplatFormat]
) -> dict[tuple[Look, SplatFormat], Path]:
    """Where each look goes in each format; no two files share a name."""
    folder = command.output or command.run / "export"
    if len(looks) * len(kinds) == 1 and "html" not in command.format and folder.name.endswith(f".{kinds[0]}"):
        return {(looks[0], kinds[0]): folder}
    named = picture_paths([f"{number}/{look.name}" for number, look in enumerate(looks)])
    stems = [path.relative_to(path.parts[0]).with_suffix("") for path in named.values()]
    taken = {stem for number, stem in enumerate(stems) if stem in stems[:number]}
    return {
        (look, kind): folder / stem.with_name(f"{stem.name}{f'_{number}' if stem in taken else ''}.{kind}")
        for number, (look, stem) in enumerate(zip(looks, stems, strict=True))
        for kind in kinds
    }


def _write_page(command: Command, loaded: api.LoadedScene, looks: list[Look], *, alone: bool) -> None:
    file = command.output or command.run / "export"
    if not (alone and file.suffix == ".html"):
        file = file / PAGE_FILE
    title = command.title or command.run.resolve().name
    if command.cleanup.active:
        _cleaned(command, loaded, looks[0])
    page = write_webpage(loaded, looks, file, title=title, cleanup=command.cleanup)
    console.print(
        f"{page.file}: {page.megabytes:.1f} MB, {page.num_gaussians:,} Gaussians, lights: {len(looks)}, "
        f"harmonics of degree {page.sh_degree}; open it in a browser"
    )


def _write_look(
    command: Command, loaded: api.LoadedScene, look: Look, files: dict[SplatFormat, Path]
) -> None:
    """One look in every format, cleaned up once."""
    splats = _cleaned(command, loaded, look)
    placed = splats if command.aligned else splats.to_input_frame(loaded.run.alignment)
    for kind, file in files.items():
        write_splats(file, placed, kind)
        console.print(
            f"{file}: {file.stat().st_size / 1e6:.1f} MB, {len(placed):,} Gaussians under {look.name}"
        )


def _cleaned(command: Command, loaded: api.LoadedScene, look: Look) -> Splats:
    """What stays of a look's Gaussians; prints how many those are, and the cost."""
    whole, scene = baked(loaded, look), loaded.scene
    splats = clean(command.cleanup, whole, scene.points, viewpoints_of(scene.views))
    if not len(splats):
        raise UserError(
            "these options leave no Gaussian; lower --min-opacity, or raise --crop or --max-distance"
        )
    if command.cleanup.active:
        views = (scene.test_views or scene.views)[:COMPARED_VIEWS]
        same = agreement(whole, splats, [view.camera for view in views])
        console.print(
            f"{look.name}: {len(splats):,} of {len(whole):,} Gaussians stay, harmonics of degree "
            f"{splats.sh_degree}; {same:.1f} dB PSNR against all of it, over {len(views)} views"
        )
    return splats
