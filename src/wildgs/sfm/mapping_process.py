"""A process of `wildgs.sfm.mapping_ahead`: `python -m wildgs.sfm.mapping_process WORKPLACE`.

Reads a run per line from standard input, as JSON, writes its models into the folder given there, and prints the
number of registered photos while it runs, then "done".
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wildgs.sfm.config import PairingConfig, SfmConfig
from wildgs.sfm.mapping import map_photos, quiet
from wildgs.sfm.workplace import Workplace


def main(root: str) -> None:
    """Computes runs until standard input ends, or until the process that started this one has ended."""
    parent = os.getppid()

    def report(step: str, done: int, total: int) -> None:
        if os.getppid() != parent:
            os._exit(1)
        print(done, flush=True)

    with quiet():
        for line in sys.stdin:
            order = json.loads(line)
            for number, model in enumerate(compute(Workplace(Path(root)), order, report)):
                place = Path(order["folder"]) / str(number)
                place.mkdir()
                model.write(place)
            print("done", flush=True)


def compute(work: Workplace, order: Mapping[str, Any], report: Any) -> list[Any]:
    """The models of a run, largest first."""
    run, options = order["run"], order["config"]
    config = SfmConfig(**{**options, "pairing": PairingConfig(**options["pairing"])})
    pair = None if run["pair"] is None else (run["pair"][0], run["pair"][1])
    return map_photos(work, order["count"], config, report, order["only"], wide=run["wide"], pair=pair)


if __name__ == "__main__":
    main(*sys.argv[1:])
