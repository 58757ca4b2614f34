"""What happens for every input and every fault: the tests' expectation and the table in docs/robustness.md, in one.

Kinds: `error` ends with one line that names the file, before or without any loss; `left out` warns, names what is
left out and continues; `used` continues as if nothing were wrong, for the reason given; None does not exist.
"""

from __future__ import annotations

FAULTS = (
    "missing",
    "empty",
    "truncated",
    "wrong type",
    "wrong size",
    "NaN",
    "huge",
    "duplicate",
    "names",
    "read-only",
    "full disk",
    "link loop",
)

Cell = tuple[str, str, str] | None
"""Kind, what the message says (a pattern), and the words of the table."""

_UNWRITTEN: Cell = ("used", "", "used")
_MODEL: dict[str, Cell] = {
    "missing": ("error", "no COLMAP model", "error: no model"),
    "empty": ("error", "the COLMAP model cannot be read", "error"),
    "truncated": ("error", "the COLMAP model cannot be read", "error"),
    "wrong type": ("error", "the COLMAP model cannot be read", "error"),
    "wrong size": ("error", "camera 1 is 0x16 pixels", "error: a camera without area, or over 10^6 wide"),
    "NaN": ("left out", r"p02\.png.*its pose is non-finite", "photo left out; such points are dropped"),
    "huge": ("error", "the COLMAP model cannot be read", "error, before anything is allocated"),
    "duplicate": ("error", "in the COLMAP model twice", "error"),
    "names": ("used", "", "used"),
    "read-only": _UNWRITTEN,
    "full disk": _UNWRITTEN,
    "link loop": ("error", "no COLMAP model", "error: no model"),
}
_BAD_MASK = ("error", r"masks.p02\.png.*repair the mask or remove it", "error: repair or remove it")
_BAD_DEPTH = ("left out", r"depth.p02\.png.*trains without depth", "photo trains without depth")
_NOT_WRITTEN: dict[str, Cell] = {
    "read-only": ("error", "cannot be written", "error"),
    "full disk": ("error", "cannot be written .*free disk space", "error"),
}
_NO_APPEARANCE = ("error", "not an appearance file", "error")
_DAMAGED = ("left out", r"step_00000002\.safetensors is damaged", "the one before is used")

TABLE: dict[str, dict[str, Cell]] = {
    "photo": {
        "missing": ("left out", r"p02\.png \(no such file\)", "left out"),
        "empty": ("left out", r"p02\.png \(not a readable image\)", "left out"),
        "truncated": ("left out", r"p02\.png \(", "left out"),
        "wrong type": ("left out", r"p02\.png \(not a readable image\)", "left out"),
        "wrong size": ("error", "its camera is 24x16", "error: not the model's photos"),
        "NaN": ("used", "", "used: NaN is black"),
        "huge": ("left out", r"exceed the limit", "left out unread; `--max-image-pixels` raises the limit"),
        "duplicate": ("used", "", "used: equal photos are two photos"),
        "names": ("used", "", "used"),
        "read-only": _UNWRITTEN,
        "full disk": _UNWRITTEN,
        "link loop": ("left out", r"p02\.png \(Too many levels of symbolic links\)", "left out"),
    },
    "COLMAP binary": _MODEL,
    "COLMAP text": _MODEL
    | {
        "empty": ("error", "has no photos with a pose", "error"),
        "truncated": ("error", "the COLMAP model cannot be read", "error; between two lines: a warning"),
    },
    "split .tsv": {
        "missing": ("used", "", "every 8th photo is held out"),
        "empty": ("error", "tab-separated columns", "error"),
        "truncated": ("error", r"p03\.png has the split", "error: names the row"),
        "wrong type": ("error", "the split file cannot be read", "error"),
        "wrong size": ("used", "", "used: further columns are ignored"),
        "NaN": ("used", "", "used: any id that is not empty"),
        "huge": ("error", r"split\.tsv", "error"),
        "duplicate": ("error", r"p01\.png is listed as train and as test", "error if they disagree"),
        "names": ("used", "", "used; not UTF-8: error"),
        "read-only": _UNWRITTEN,
        "full disk": _UNWRITTEN,
        "link loop": ("error", "the split file cannot be read", "error"),
    },
    "mask": {
        "missing": ("used", "", "used: nothing is ignored"),
        "empty": _BAD_MASK,
        "truncated": _BAD_MASK,
        "wrong type": _BAD_MASK,
        "wrong size": _BAD_MASK,
        "NaN": ("used", "", "used: not 0"),
        "huge": _BAD_MASK,
        "duplicate": ("used", "", "`<name>.png` before `<stem>.png`"),
        "names": ("used", "", "used"),
        "read-only": _UNWRITTEN,
        "full disk": _UNWRITTEN,
        "link loop": _BAD_MASK,
    },
    "depth": {
        "missing": ("used", "", "used: trains without depth"),
        "empty": _BAD_DEPTH,
        "truncated": _BAD_DEPTH,
        "wrong type": _BAD_DEPTH,
        "wrong size": _BAD_DEPTH,
        "NaN": ("used", "", "used: NaN is no estimate"),
        "huge": _BAD_DEPTH,
        "duplicate": None,
        "names": ("used", "", "used"),
        "read-only": _UNWRITTEN,
        "full disk": _UNWRITTEN,
        "link loop": _BAD_DEPTH,
    },
    "checkpoint": {
        "missing": ("error", "no checkpoint yet", "error; --resume starts at step 0"),
        "empty": _DAMAGED,
        "truncated": _DAMAGED,
        "wrong type": _DAMAGED,
        "wrong size": ("error", "does not fit method", "error: of another method or model"),
        "NaN": ("used", "", "used; training says so and stops"),
        "huge": _DAMAGED,
        "duplicate": None,
        "names": ("used", "", "used"),
        "read-only": ("error", "cannot be written", "error; those before are kept"),
        "full disk": (
            "error",
            "cannot be written .*free disk space",
            "warning, tried again; those before are kept",
        ),
        "link loop": _DAMAGED,
    },
    "config.yaml": {
        "missing": ("error", "is not a run folder", "error"),
        "empty": ("error", "expected a mapping", "error"),
        "truncated": ("error", r"config\.yaml", "error: names the entry"),
        "wrong type": ("error", r"config\.yaml", "error"),
        "wrong size": ("error", "unknown entry 'more'", "error: names the entry"),
        "NaN": ("error", r"train\.steps: nan is not a int", "error: names the entry"),
        "huge": ("error", r"config\.yaml", "error, without unfolding it"),
        "duplicate": ("used", "", "the last counts"),
        "names": ("used", "", "used"),
        **_NOT_WRITTEN,
        "link loop": ("error", "is not a run folder", "error"),
    },
    "appearance": {
        "missing": ("error", "no such file", "error"),
        "empty": _NO_APPEARANCE,
        "truncated": _NO_APPEARANCE,
        "wrong type": _NO_APPEARANCE,
        "wrong size": _NO_APPEARANCE,
        "NaN": _NO_APPEARANCE,
        "huge": _NO_APPEARANCE,
        "duplicate": None,
        "names": ("used", "", "used"),
        **_NOT_WRITTEN,
        "link loop": ("error", "no such file", "error"),
    },
    "camera file": {
        "missing": ("error", "no such file", "error"),
        "empty": ("error", "cannot be read as JSON", "error"),
        "truncated": ("error", "cannot be read as JSON", "error"),
        "wrong type": ("error", "cannot be read as JSON", "error"),
        "wrong size": ("error", r"cameras\[1\]: expected 4 x 4 finite numbers", "error: names the camera"),
        "NaN": ("error", r"cameras\[1\]: expected 4 x 4 finite numbers", "error: names the camera"),
        "huge": ("error", r"cameras\[1\]: width and height", "error: pictures over 32,768 a side"),
        "duplicate": ("used", "", "used: the camera stands still"),
        "names": ("used", "", "used"),
        **_NOT_WRITTEN,
        "link loop": ("error", "cannot be read as JSON", "error"),
    },
}


def markdown() -> str:
    """The table of docs/robustness.md: a row for every fault, a column for every input."""
    lines = ["| | " + " | ".join(TABLE) + " |", "|---" * (len(TABLE) + 1) + "|"]
    for fault in FAULTS:
        words = [cell[2] if (cell := cells[fault]) is not None else "–" for cells in TABLE.values()]
        lines.append(f"| **{fault}** | " + " | ".join(words) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(markdown())
