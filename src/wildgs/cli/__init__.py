"""The command line: one module a verb, imported only when the verb is called."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import warnings

from wildgs import processes
from wildgs.errors import ReportedError, UserError, WildGSWarning
from wildgs.version import __version__

VERBS = {
    "demo": "the built-in landmark: train, score, write a page to look at",
    "run": "photos in a folder -> sfm -> train -> eval -> a page to look at",
    "sfm": "camera poses of a folder of photos, with pycolmap",
    "train": "a scene with poses -> a trained run",
    "eval": "score a run on its held-out photos",
    "render": "pictures and videos of a run in the light of any photo",
    "gallery": "views x appearances of a run as one picture",
    "appearance": "the light of a photo, or a mix of several, as a small file",
    "view": "fly through a run in the browser, under any light",
    "export": "files for other programs, and one web page that carries the light",
    "depth": "fill a scene's depth/ with Depth Anything V2",
    "bench": "methods x ablations x seeds on scenes -> one table",
    "doctor": "what works on this machine, and how to get what does not",
}
DISTRIBUTED = ("train", "bench")
"""Verbs that torchrun may start on several processes."""
USER_ERROR = 2
logging.getLogger("wildgs").addHandler(logging.NullHandler())  # or Python prints what is logged a second time
INTERRUPTED = 130
BROKEN_PIPE = 141
"""As a shell says it of `wildgs ... | head`, whose reader had enough."""


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb and exits: 0 done, 2 a user's mistake (one line on stderr), 130 or 143 interrupted."""
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
        if processes.world_size() > 1 and verb not in DISTRIBUTED:
            raise UserError(f"`wildgs {verb}` runs in one process; start it without torchrun")
        with processes.library_environment():
            _run(verb, rest)
    except ReportedError:
        sys.exit(USER_ERROR)
    except UserError as error:
        _fail(" ".join(str(error).split()))
    except BrokenPipeError:
        if not _reader_has_left():
            raise
        sys.exit(BROKEN_PIPE)
    except KeyboardInterrupt as interrupt:
        if not processes.rank():
            print(str(interrupt) or "interrupted", file=sys.stderr)
        sys.exit(getattr(interrupt, "code", INTERRUPTED))


def _reader_has_left() -> bool:
    """Whether nobody reads what is printed any more; then nothing is printed any more either."""
    try:
        print(flush=True)  # what failed before is no longer in the buffer
    except BrokenPipeError:
        # Python flushes once more on its way out, and would complain then.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _run(verb: str, arguments: list[str]) -> None:
    import tyro

    warnings.showwarning = _show_warning
    warnings.simplefilter("always", WildGSWarning)
    module = importlib.import_module(f"wildgs.cli.{verb}")
    # What a preset among the arguments sets is the default of the other options.
    kind = module.command_for(arguments) if hasattr(module, "command_for") else module.Command
    command = tyro.cli(kind, prog=f"wildgs {verb}", args=arguments, description=module.Command.__doc__)
    module.run(command)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """One line on stderr; other libraries' warnings are not the user's business."""
    if issubclass(category, WildGSWarning):
        line = " ".join(str(message).split())
        logging.getLogger("wildgs").warning(line)
        print(f"{_speaker()}warning: {line}", file=sys.stderr)


def _fail(message: str) -> None:
    print(f"{_speaker()}error: {message}", file=sys.stderr)
    sys.exit(USER_ERROR)


def _speaker() -> str:
    """Names the process before its message, where it is one of several and not the first."""
    return f"rank {processes.rank()}: " if processes.rank() else ""


def _usage() -> str:
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in VERBS.items())
    return (
        f"wildgs {__version__}: relightable 3D scenes from photo collections\n\n"
        f"usage: wildgs VERB ...\n\n{verbs}\n\n`wildgs VERB --help` shows a verb's options and an example."
    )
