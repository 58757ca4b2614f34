"""`wildgs.appearance`, and what every verb that takes light has in common: appearances found and mixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from wildgs.errors import UserError
from wildgs.library.config import MixOptions
from wildgs.library.loaded import LoadedScene, load
from wildgs.light.look import Look, mix, with_sky
from wildgs.light.saved import save_look
from wildgs.progress import Progress


@dataclass(frozen=True)
class SavedAppearance:
    """A written appearance.

    Attributes:
        file: Where it was written.
        look: What it holds.
    """

    file: Path
    look: Look


def appearance(
    run: str | Path | LoadedScene,
    photos: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> SavedAppearance:
    """Saves the light of a photo, or a mix of several, as a small file that holds no code (safetensors).

    Args:
        run: A run folder, or a loaded scene. The file belongs to the run at its present step.
        photos: What `LoadedScene.appearance` takes; several with weights.
        output: File to write, ending in .safetensors.
        mixing: How several photos become one appearance.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be had, there is more than one, or the file cannot be written.
    """
    scene = loaded(run)
    specs = [photos] if isinstance(photos, (str, Path)) else photos
    looks = find_looks(scene, specs, mixing, progress=progress)
    if len(looks) != 1:
        raise UserError(
            f"{len(looks)} appearances do not go into one file; give one, or mix them by --weights"
        )
    return SavedAppearance(save_look(looks[0], Path(output)), looks[0])


def loaded(run: str | Path | LoadedScene) -> LoadedScene:
    """The loaded scene that a user means by a run folder or by itself."""
    return run if isinstance(run, LoadedScene) else load(run)


def find_looks(
    scene: LoadedScene,
    specs: Sequence[str | Path | Look],
    mixing: MixOptions | None = None,
    *,
    progress: Progress | None = None,
) -> list[Look]:
    """The looks of some appearances: one for each, or a single mixed one.

    Args:
        scene: The loaded scene.
        specs: What `LoadedScene.appearance` takes.
        mixing: How they are found and mixed.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be had, or the options contradict each other.
    """
    mixing = mixing or MixOptions()

    def find(spec: str | Path | Look) -> Look:
        return scene.appearance(spec, like=mixing.like, progress=progress)

    parts = (mixing.global_, mixing.local)
    if None not in parts:
        specs = ()  # both parts come from elsewhere
    looks = [find(spec) for spec in specs]
    if mixing.weights:
        looks = [mix(looks, mixing.weights)]
    if parts != (None, None):
        if len(looks) > 1:
            raise UserError(
                "--global and --local change one appearance; give one, or --weights to mix several"
            )
        both = [looks[0] if spec is None else find(spec) for spec in parts]
        looks = [mix(both, [1, 0], local_weights=[0, 1])]
    if mixing.sky is None:
        return looks
    sky = find(mixing.sky)
    return [with_sky(look, sky) for look in looks]
