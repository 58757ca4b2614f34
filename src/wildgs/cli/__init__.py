"""The command line: one module a verb, imported only when the verb is called."""

from __future__ import annotations

import importlib
import sys
import warnings

from wildgs import __version__
from wildgs.errors import UserError, WildGSWarning

VERBS = {
    "demo": "the built-in landmark: train, score, write a page to look at",
    "run": "photos in a folder -> sfm -> train -> eval -> a page to look at",
    "sfm": "camera poses of a folder of photos, with pycolmap",
    "train": "a scene with poses -> a trained run",
    "eval": "score a run on its held-out photos",
    "render": "pictures and videos of a run in the light of any photo",
    "gallery": "views x appearances of a run as one picture",
    "appearance": "the light of a photo, or a mix of several, as a small file",
    "export": "files for other programs, and one web page that carries the light",
    "depth": "fill a scene's depth/ with Depth Anything V2",
    "doctor": "what works on this machine, and how to get what does not",
}
USER_ERROR = 2
INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb and exits: 0 done, 2 a user's mistake (one line on stderr), 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return
    if arguments[0] == "--version":
        print(f"wildgs {__version__}")
        return
    verb, *rest = arguments
    if verb not in VERBS:
        _fail(f"there is no verb {verb!r}; `wildgs --help` lists them")
    try:
        _run(verb, rest)
    except UserError as error:
        _fail(" ".join(str(error).split()))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _run(verb: str, arguments: list[str]) -> None:
    import tyro

    warnings.showwarning = _show_warning
    warnings.simplefilter("always", WildGSWarning)
    module = importlib.import_module(f"wildgs.cli.{verb}")
    command = tyro.cli(module.Command, prog=f"wildgs {verb}", args=arguments)
    module.run(command)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """One line on stderr; other libraries' warnings are not the user's business."""
    if issubclass(category, WildGSWarning):
        print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(USER_ERROR)


def _usage() -> str:
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in VERBS.items())
    return (
        f"wildgs {__version__}: relightable 3D scenes from photo collections\n\n"
        f"usage: wildgs VERB ...\n\n{verbs}\n\n`wildgs VERB --help` shows a verb's options and an example."
    )
