"""Wrong calls end in an error that says what is wrong."""

from __future__ import annotations

import pytest
import torch

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.rasterize import blend, pick_backend, project, rasterize
from wildgs.threads import thread_count

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def inputs(count: int = 3) -> list[torch.Tensor]:
    return [torch.rand(count, 3), torch.rand(count, 4), torch.rand(count, 3), torch.rand(count)]


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, torch.rand(3, 2), r"means has shape \[3, 2\], expected \[3, 3\]"),
        (1, torch.rand(4, 4), r"quats has shape \[4, 4\], expected \[3, 4\]"),
        (2, torch.rand(3), r"scales has shape \[3\]"),
        (3, torch.rand(3, 1), r"opacities has shape \[3, 1\]"),
        (2, torch.rand(3, 3).double(), "scales is torch.float64"),
    ],
)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_shapes_and_types(index: int, value: torch.Tensor, message: str, backend: str):
    wrong = inputs()
    wrong[index] = value
    with pytest.raises(ValueError, match=message):
        project.__wrapped__(*wrong, CAMERA, backend=backend)


def test_colours_of_other_gaussians():
    projection = project(*inputs(), CAMERA)
    with pytest.raises(ValueError, match=r"colors has shape \[4, 3\]"):
        blend(projection, torch.rand(4, 3))
    with pytest.raises(ValueError, match=r"background has shape \[2\], expected \[3\]"):
        blend.__wrapped__(projection, torch.rand(3, 3), background=torch.rand(2))


def test_float64_needs_the_reference():
    doubles = [t.double() for t in inputs()]
    with pytest.raises(ValueError, match="'reference' accepts float64"):
        project(*doubles, CAMERA)
    assert project(*doubles, CAMERA, backend="reference").means2d.dtype == torch.float64


def test_too_few_harmonics():
    with pytest.raises(ValueError, match="degree 2 needs 9"):
        rasterize(*inputs(), torch.rand(3, 4, 3), CAMERA, sh_degree=2)


def test_backend_by_device():
    assert pick_backend("cpu") == "cpu"
    assert pick_backend("cuda:1") == "cuda"


def test_threads_from_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("WILDGS_NUM_THREADS", raising=False)
    assert thread_count() == torch.get_num_threads()
    monkeypatch.setenv("WILDGS_NUM_THREADS", "5")
    assert thread_count() == 5
    monkeypatch.setenv("WILDGS_NUM_THREADS", "many")
    with pytest.raises(UserError, match="WILDGS_NUM_THREADS"):
        thread_count()
