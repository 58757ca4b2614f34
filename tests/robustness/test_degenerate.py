"""Scenes at the edge of sense train a few steps without a crash, and stay finite."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.memory_views import make_view
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.geometry.camera import Camera
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import MethodName, create_method
from wildgs.model.wildgs import WildGSConfig
from wildgs.model.wrapping import WrappingConfig
from wildgs.scene import Alignment, Scene, View, scene_extent
from wildgs.scene.alignment import align_world

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")

MODEL = WildGSConfig(
    parsing=ParsingConfig(max_side=32, encoder="nobody/none"),
    wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)),
)
SCHEDULE = ScheduleConfig(first_stage=5000, densify_from=1, densify_every=10_000, reset_every=15_000)


def view(
    name: str,
    *,
    photo: torch.Tensor | None = None,
    size: tuple[int, int] = (24, 16),
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    focal: float = 20.0,
    mask: torch.Tensor | None = None,
    disparity: torch.Tensor | None = None,
) -> View:
    width, height = size
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor(position)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pixels = torch.full((height, width, 3), 120, dtype=torch.uint8) if photo is None else photo
    return make_view(name, Camera(viewmat, K, width, height), "train", pixels, mask=mask, disparity=disparity)


def scene(views: list[View], points: torch.Tensor | None = None) -> Scene:
    if points is None:
        points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
            [-0.5, -0.5, 1.0]
        )
    colors = torch.full((len(points), 3), 99, dtype=torch.uint8)
    return Scene(Path("edge"), tuple(views), points, colors, Alignment.identity())


BLACK = torch.zeros(16, 24, 3, dtype=torch.uint8)
NOTHING = torch.zeros(16, 24, dtype=torch.uint8)
CENTRES = torch.cat([torch.zeros(20, 3), torch.rand(20, 3, generator=torch.Generator().manual_seed(1)) + 0.5])

SCENES: dict[str, Callable[[], Scene]] = {
    "one photo": lambda: scene([view("a")]),
    "all black": lambda: scene([view("a", photo=BLACK), view("b", photo=BLACK, position=(0.1, 0, 0))]),
    "no static pixel": lambda: scene([view("a", mask=NOTHING), view("b", mask=NOTHING)]),
    "10000 x 1": lambda: scene([view("a", size=(10_000, 1)), view("b", position=(0.1, 0, 0))]),
    "1 x 10000": lambda: scene([view("a", size=(1, 10_000)), view("b", position=(0.1, 0, 0))]),
    "one pixel": lambda: scene([view("a", size=(1, 1)), view("b", position=(0.1, 0, 0))]),
    "points at the camera's centre": lambda: scene([view("a"), view("b", position=(0.1, 0, 0))], CENTRES),
    "one point": lambda: scene([view("a"), view("b", position=(0.1, 0, 0))], torch.tensor([[0.0, 0, 2]])),
    "one place for all points": lambda: scene([view("a")], torch.ones(30, 3)),
    "points behind": lambda: scene([view("a")], torch.rand(30, 3) - 3),
    "points far away": lambda: scene([view("a")], torch.rand(30, 3) * 1e6),
    "very wide": lambda: scene([view("a", focal=1e-3)]),
    "very long": lambda: scene([view("a", focal=1e7)]),
    "constant depth": lambda: scene([view("a", disparity=torch.ones(16, 24))]),
    "no depth": lambda: scene([view("a", disparity=torch.zeros(16, 24))]),
}


@pytest.mark.parametrize("method", ["3dgs", "wildgs"])
@pytest.mark.parametrize("name", list(SCENES))
def test_edges_train(name: str, method: MethodName) -> None:
    torch.manual_seed(0)
    edge = SCENES[name]()
    made = create_method(method, MODEL if method == "wildgs" else None, edge)
    trainer = Trainer(made, edge, TrainConfig(steps=6, precision="float32", schedule=SCHEDULE))
    trainer.run()
    assert trainer.step == 6
    assert trainer.guard.skipped == 0
    assert len(made.gaussians) > 0
    for label, value in made.state_dict().items():
        assert bool(torch.isfinite(value).all()), label
    with torch.no_grad():
        first = edge.views[0]
        photo = first.read_photo().float() / 255
        rendering = made.render(first.camera, made.shade(made.encode(photo, first.camera)))
    assert bool(torch.isfinite(rendering.colors).all())


def test_parameters_that_are_no_numbers_do_not_crash_the_rasteriser() -> None:
    edge = SCENES["one photo"]()
    made = create_method("3dgs", None, edge)
    camera = edge.views[0].camera
    for row, value in (
        ("means", float("nan")),
        ("means", float("inf")),
        ("log_scales", 200.0),
        ("quats", 0.0),
    ):
        with torch.no_grad():
            before = made.gaussians.rows[row].clone()
            made.gaussians.rows[row][:7] = value
            made.gaussians.rows[row][7:9, 0] = float("nan")
            sh = made.shade(made.encode(edge.views[0].read_photo().float(), camera))
            rendering = made.render(camera, sh)
            made.gaussians.rows[row].copy_(before)
        assert rendering.colors.shape == (camera.height, camera.width, 3)
        assert bool(torch.isfinite(rendering.alpha).all()), row


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_few_cameras_and_points_have_axes(count: int, spread: float) -> None:
    cameras = [view(str(i), position=(spread * i, 0, 0)).camera for i in range(count)]
    points = torch.tensor([[0.0, 0, 2], [spread, 0, 2]])
    alignment = align_world(cameras, points, [])
    assert bool(torch.isfinite(alignment.rotation).all())
    assert torch.allclose(
        alignment.rotation @ alignment.rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-6
    )
    assert alignment.scale > 0
    assert scene_extent(scene([view(str(i), position=(spread * i, 0, 0)) for i in range(count)], points)) > 0
