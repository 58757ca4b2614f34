"""The notebook's cells run in order, from photos to a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "photos_to_scene.ipynb"
SMALL = {"STEPS": 20, "LONG_SIDE": 48}


def code_cells() -> list[dict[str, Any]]:
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


@pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")  # pretrained weights are not at hand
def test_photos_become_a_page(
    corner: tuple[list[np.ndarray], list[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photos").mkdir()
    for number, pixels in enumerate(corner[0]):
        Image.fromarray(pixels).save(tmp_path / "photos" / f"{number}.jpg", quality=95)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for number, cell in enumerate(code_cells()):
        exec(compile("".join(cell["source"]), f"code cell {number}", "exec"), names)
        if "parameters" in cell["metadata"].get("tags", ()):
            names.update(SMALL)
    assert names["trained"].steps == SMALL["STEPS"]
    assert set(names["scores"]) == {"full", "half"}
    assert all(np.isfinite(metrics["mean"]["psnr"]) for metrics in names["scores"].values())
    assert "base64" in (tmp_path / "scene.html").read_text(encoding="utf-8")


def test_the_notebook_is_stored_without_outputs() -> None:
    for cell in code_cells():
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
