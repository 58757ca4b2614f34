"""A Python that has torch imported already and forks for every command; the fixture of this name starts it.

    python forking_python.py FOLDER         serves FOLDER/python, which takes Python's command line

Each process of its own would import torch, Numba and the package first, which takes longer than a tiny training.
Signals reach the client only, not the fork.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import traceback
from pathlib import Path

CLIENT = """#!/usr/bin/env bash
folder=${0%/*} id=$$
mkfifo "$folder/$id"
{ printf '%s\\0' "$PWD" "$#" "$@"; env -0; } >"$folder/$id.request"
echo "$id" >"$folder/requests"
read -r code <"$folder/$id"
exit "$code"
"""


def execute(arguments: list[str]) -> None:
    """Does what Python does with a command line."""
    if arguments[0] == "-u":
        arguments = arguments[1:]
    kind, *rest = arguments
    if kind == "-m":
        # Pytest warns where it cannot rewrite the assertions of what is imported already.
        sys.argv = [*rest[:1], *(["--assert=plain"] if rest[0] == "pytest" else []), *rest[1:]]
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif kind in ("-c", "-"):
        code, rest = (rest[0], rest[1:]) if kind == "-c" else (sys.stdin.read(), rest)
        sys.argv = [kind, *rest]
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv = arguments
        sys.path.insert(0, str(Path(kind).parent))
        runpy.run_path(kind, run_name="__main__")


def child(folder: Path, process: str) -> int:
    """Takes over what a client was given, runs it, and returns its exit code."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    where, count, *rest = (folder / f"{process}.request").read_bytes().decode().rstrip("\0").split("\0")
    arguments, environment = rest[: int(count)], rest[int(count) :]
    for number in range(3):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_APPEND
        os.dup2(os.open(f"/proc/{process}/fd/{number}", flags), number)
    os.chdir(where)
    os.environ.clear()
    os.environ.update(entry.split("=", 1) for entry in environment if "=" in entry)
    sys.path[:0] = [*os.environ.get("PYTHONPATH", "").split(os.pathsep), ""]
    try:
        execute(arguments)
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def serve(folder: Path) -> None:
    """Forks for every client until the process is ended."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    os.mkfifo(folder / "requests")
    client = folder / "python"
    client.with_suffix(".part").write_text(CLIENT)
    client.with_suffix(".part").chmod(0o755)
    client.with_suffix(".part").rename(client)
    # Open for writing, too, so that it never ends: what a client wrote between the end and closing would be lost.
    with os.fdopen(os.open(folder / "requests", os.O_RDWR)) as requests:
        for line in requests:
            process = line.strip()
            if os.fork() == 0:
                code = child(folder, process)
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                (folder / process).write_text(f"{code}\n")
                os._exit(0)


if __name__ == "__main__":
    # What the stages import; nothing of it is computed with, so that no thread is lost by forking.
    import torch  # noqa: F401

    import wildgs.cli.eval
    import wildgs.cli.train
    import wildgs.library.evaluation
    import wildgs.library.training
    import wildgs.rasterize.cpu  # noqa: F401

    serve(Path(sys.argv[1]))
