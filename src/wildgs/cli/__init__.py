"""The command line. Each verb has its own module, which is imported only when the verb is called."""

from __future__ import annotations

import importlib
import inspect
import logging
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from wildgs import processes
from wildgs.cli import streams
from wildgs.cli.arguments import refuse_empty, refuse_repeated
from wildgs.errors import ReportedError, UserError, WildGSWarning
from wildgs.version import __version__

VERBS = {
    "demo": "train and score on the built-in landmark and write a web page",
    "run": "do everything for a folder of photos: sfm, train, eval, web page",
    "sfm": "estimate camera poses for a folder of photos with pycolmap",
    "train": "train on a scene with camera poses",
    "eval": "score a run on its held-out photos",
    "render": "render images and videos of a run in the light of any photo",
    "gallery": "render a grid of views and appearances as one image",
    "appearance": "save the light of a photo, or a mix of several, as a small file",
    "view": "open a run in the browser, under any light",
    "export": "write files for other programs, or one relightable web page",
    "depth": "estimate depth maps by Depth Anything V2 or multi-view stereo",
    "bench": "compare methods, ablations and seeds on scenes in one table",
    "doctor": "check what works on this machine and how to install the rest",
}
DISTRIBUTED = ("train", "bench")
"""Verbs that torchrun may start as several processes."""
HELP, HELP_ALL = ("-h", "--help"), "--help-all"
USER_ERROR = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
"""128 + SIGPIPE: the reader of a pipe, as in `wildgs ... | head`, was closed."""

logger = logging.getLogger("wildgs")
logger.addHandler(
    logging.NullHandler()
)  # without it Python's last-resort handler prints warnings a second time


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb. Exit codes: 0 success, 2 user error (one line on stderr), 130 or 143 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    streams.prepare_streams()
    try:
        _dispatch_and_flush(arguments)
    except ReportedError:
        sys.exit(USER_ERROR)
    except UserError as error:
        _fail(" ".join(str(error).split()))
    except BrokenPipeError:
        if not streams.stdout_is_closed():
            raise
        sys.exit(BROKEN_PIPE)
    except KeyboardInterrupt as interrupt:
        if not processes.rank():
            _print_error(str(interrupt) or "interrupted")
        sys.exit(getattr(interrupt, "code", INTERRUPTED))
    finally:
        streams.flush_streams()


def _dispatch_and_flush(arguments: list[str]) -> None:
    """Runs a verb and writes its buffered output, so that a closed pipe is noticed even if the output is short."""
    try:
        _dispatch(arguments)
    except SystemExit as end:
        if not end.code:
            streams.flush_stdout()
        raise
    streams.flush_stdout()


def _dispatch(arguments: list[str]) -> None:
    if not arguments or arguments[0] in (*HELP, HELP_ALL):
        print(_usage())
        return
    if arguments[0] == "--version":
        print(f"wildgs {__version__}")
        return
    verb, *rest = arguments
    refuse_empty(rest)
    if verb not in VERBS:
        raise UserError(f"unknown command {verb!r}; `wildgs --help` lists the commands")
    if processes.world_size() > 1 and verb not in DISTRIBUTED:
        raise UserError(f"`wildgs {verb}` runs in one process; start it without torchrun")
    _refuse_deleted_folder()
    with processes.library_environment():
        _run(verb, rest)


def _refuse_deleted_folder() -> None:
    """Raises `UserError` if the current folder has been deleted, where MKL would end the process."""
    try:
        Path.cwd()
    except FileNotFoundError as error:
        raise UserError("the current folder does not exist any more; change to another one") from error


def _run(verb: str, arguments: list[str]) -> None:
    module = importlib.import_module(f"wildgs.cli.{verb}")
    refuse_repeated(arguments, getattr(module, "REPEATABLE", ()))
    with streams.readable_width():
        command = _parse(verb, module, arguments)
    from wildgs.cli.screen import Lines

    # doctor reports packages that cannot be imported itself.
    with suppress(ImportError) if verb == "doctor" else nullcontext():
        importlib.import_module("wildgs.scene")  # before pycolmap, see there
        # Imports pycolmap now: it installs a SIGTERM handler, which would replace ours if it came later.
        importlib.import_module("pycolmap")
    lines, level = Lines(), logger.level
    logger.addHandler(lines)
    logger.setLevel(min(logging.INFO, level or logging.INFO))
    showwarning = warnings.showwarning
    try:
        with warnings.catch_warnings(), processes.signals_as_interrupts():
            warnings.showwarning = _warning_printer()
            warnings.simplefilter("always", WildGSWarning)
            module.run(command)
    finally:
        warnings.showwarning = showwarning
        logger.removeHandler(lines)
        logger.setLevel(level)


def _parse(verb: str, module: ModuleType, arguments: list[str]) -> Any:
    """Reads the options of a command; for help, prints it and exits."""
    import tyro

    # A preset or a run to resume among the arguments changes the defaults of the other options.
    kind = module.command_for(arguments) if hasattr(module, "command_for") else module.Command
    description = inspect.cleandoc(module.Command.__doc__)
    if HELP_ALL in arguments:
        tyro.cli(kind, prog=f"wildgs {verb}", args=["--help"], description=description)
    if any(option in arguments for option in HELP):
        _help(verb, module, kind, description)
    return tyro.cli(kind, prog=f"wildgs {verb}", args=arguments, description=description)


def _help(verb: str, module: ModuleType, kind: type, description: str) -> None:
    """Prints the main options and how to list all of them, then exits."""
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


def _warning_printer() -> Callable[..., None]:
    """A `warnings.showwarning` that prints each `WildGSWarning` once, as one line on stderr, and no other warnings.

    A verb may read the same folder several times.
    """
    printed: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        line = " ".join(str(message).split())
        if issubclass(category, WildGSWarning) and line not in printed:
            printed.add(line)
            logger.warning(line)
            _print_error(f"{_rank_prefix()}warning: {line}")

    return show


def _fail(message: str) -> None:
    _print_error(f"{_rank_prefix()}error: {message}")
    sys.exit(USER_ERROR)


def _print_error(line: str) -> None:
    """Prints to stderr; no error if stderr is closed."""
    from wildgs.cli.screen import ERR

    print(line, file=ERR, flush=True)  # pyright: ignore[reportArgumentType]


def _rank_prefix() -> str:
    """The rank, to be printed before a message of any process but the first."""
    return f"rank {processes.rank()}: " if processes.rank() else ""


def _usage() -> str:
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in VERBS.items())
    return (
        f"wildgs {__version__}: relightable 3D scenes from photo collections\n\n"
        f"usage: wildgs COMMAND ...\n\n{verbs}\n\n`wildgs COMMAND --help` shows a command's options and an example."
    )
