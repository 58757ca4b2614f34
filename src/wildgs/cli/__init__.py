"""The command line: one module a verb, imported only when the verb is called."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import logging
import os
import sys
import warnings
from types import ModuleType
from typing import Any

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
HELP, HELP_ALL = ("-h", "--help"), "--help-all"
USER_ERROR = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
"""As a shell reports `wildgs ... | head`, whose reader had enough."""

logger = logging.getLogger("wildgs")
logger.addHandler(logging.NullHandler())  # or Python prints what is logged a second time


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb and exits: 0 done, 2 a user's mistake (one line on stderr), 130 or 143 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    for stream in (sys.stdout, sys.stderr):  # names are bytes, and not all of them are text
        if isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError):  # a stream that cannot be set up still shows most names
                stream.reconfigure(errors="backslashreplace")
    try:
        _dispatch(arguments)
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
            _say(str(interrupt) or "interrupted")
        sys.exit(getattr(interrupt, "code", INTERRUPTED))
    finally:
        _drop_what_cannot_be_shown()


def _dispatch(arguments: list[str]) -> None:
    if not arguments or arguments[0] in (*HELP, HELP_ALL):
        print(_usage())
        return
    if arguments[0] == "--version":
        print(f"wildgs {__version__}")
        return
    verb, *rest = arguments
    if verb not in VERBS:
        raise UserError(f"there is no verb {verb!r}; `wildgs --help` lists them")
    if processes.world_size() > 1 and verb not in DISTRIBUTED:
        raise UserError(f"`wildgs {verb}` runs in one process; start it without torchrun")
    with processes.library_environment():
        _run(verb, rest)


def _run(verb: str, arguments: list[str]) -> None:
    import tyro

    module = importlib.import_module(f"wildgs.cli.{verb}")
    # A preset, or the run to resume, among the arguments sets the defaults of the other options.
    kind = module.command_for(arguments) if hasattr(module, "command_for") else module.Command
    description = inspect.cleandoc(module.Command.__doc__)
    if HELP_ALL in arguments:
        tyro.cli(kind, prog=f"wildgs {verb}", args=["--help"], description=description)
    if any(option in arguments for option in HELP):
        _help(verb, module, kind, description)
    command = tyro.cli(kind, prog=f"wildgs {verb}", args=arguments, description=description)
    from wildgs.cli.screen import Lines

    if verb != "doctor":  # which says what is missing
        # With pycolmap, whose handler of SIGTERM would take the place of ours and print a C++ stack.
        importlib.import_module("wildgs.scene")
    lines, level = Lines(), logger.level
    logger.addHandler(lines)
    logger.setLevel(min(logging.INFO, level or logging.INFO))
    showwarning = warnings.showwarning
    try:
        with warnings.catch_warnings(), processes.signals_as_interrupts():
            warnings.showwarning = _show_warning
            warnings.simplefilter("always", WildGSWarning)
            module.run(command)
    finally:
        warnings.showwarning = showwarning
        logger.removeHandler(lines)
        logger.setLevel(level)


def _help(verb: str, module: ModuleType, kind: type, description: str) -> None:
    """Prints the options that matter, and where the others are; ends the process."""
    import tyro

    from wildgs.cli.options import count_options, with_only

    shown = getattr(module, "SHOWN", None)
    brief = kind if shown is None else with_only(kind, shown)
    try:
        tyro.cli(brief, prog=f"wildgs {verb}", args=["--help"], description=description)
    finally:
        if shown is not None:
            print(
                f"`wildgs {verb} {HELP_ALL}` shows all {count_options(kind)} options; a run's config.yaml holds "
                "their values."
            )


def _reader_has_left() -> bool:
    """Whether nobody reads what is printed any more; then nothing is printed any more either."""
    try:
        print(flush=True)  # what failed before is no longer in the buffer
    except BrokenPipeError:
        _silence(sys.stdout)
        return True
    return False


def _drop_what_cannot_be_shown() -> None:
    """Python flushes once more on its way out, and would end a finished work with an error there."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            _silence(stream)


def _silence(stream: Any) -> None:
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """One line on stderr; other libraries' warnings are not the user's business."""
    if issubclass(category, WildGSWarning):
        line = " ".join(str(message).split())
        logger.warning(line)
        _say(f"{_speaker()}warning: {line}")


def _fail(message: str) -> None:
    _say(f"{_speaker()}error: {message}")
    sys.exit(USER_ERROR)


def _say(line: str) -> None:
    """Prints to stderr, which may be gone."""
    from wildgs.cli.screen import ERR

    print(line, file=ERR, flush=True)  # pyright: ignore[reportArgumentType]


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
