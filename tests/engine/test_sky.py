"""The sky in training: what is in front of it disappears, and Gaussians do not grow there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.memory_views import make_view, with_photos
from wildgs.engine import feed
from wildgs.engine.config import DensityConfig
from wildgs.engine.density import SeenView
from wildgs.engine.density.control import ViewStatistics
from wildgs.engine.density.relocation import RelocationDensity
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.geometry.camera import Camera
from wildgs.losses.config import ObjectiveConfig
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import create_method
from wildgs.model.sky import SkyConfig
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.rasterize import blend
from wildgs.scene import Alignment, Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")

WIDTH, HEIGHT = 48, 36
DISTANCE = 1.5
"""Of the wall, and of the curtain above it, from the cameras."""


@pytest.fixture
def model() -> WildGSConfig:
    return WildGSConfig(sky=SkyConfig(points=300), parsing=ParsingConfig(max_side=32))


@pytest.fixture
def scene() -> Scene:
    """A wall below the horizon and a smooth sky above it, from four cameras that look along y; z points upwards."""
    generator = torch.Generator().manual_seed(0)
    x, z = torch.meshgrid(torch.linspace(-0.9, 0.9, 24), torch.linspace(-0.7, 0.0, 12), indexing="ij")
    wall = torch.stack([x, torch.full_like(x, DISTANCE), z], dim=-1).reshape(-1, 3)
    views = []
    for index in range(4):
        viewmat = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        viewmat[0, 3] = 0.1 * (index - 1.5)
        K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
        photo = torch.full((HEIGHT, WIDTH, 3), 0.8)
        photo[HEIGHT // 2 :] = torch.rand(HEIGHT // 2, WIDTH, 1, generator=generator)
        views.append(make_view(f"{index}.jpg", Camera(viewmat, K, WIDTH, HEIGHT), photo=(255 * photo).byte()))
    colors = torch.full((len(wall), 3), 128, dtype=torch.uint8)
    return Scene(Path("outdoors"), tuple(views), wall, colors, Alignment.identity())


def with_curtain(scene: Scene) -> Scene:
    """The scene with points in front of the sky, as training would create them there."""
    x, z = torch.meshgrid(torch.linspace(-0.9, 0.9, 18), torch.linspace(0.05, 0.7, 10), indexing="ij")
    curtain = torch.stack([x, torch.full_like(x, DISTANCE), z], dim=-1).reshape(-1, 3)
    colors = torch.full((len(curtain), 3), 204, dtype=torch.uint8)
    return replace(
        scene, points=torch.cat([scene.points, curtain]), point_colors=torch.cat([scene.point_colors, colors])
    )


def trainer_for(
    scene: Scene,
    model: WildGSConfig,
    steps: int,
    weight: float = 1.0,
    begins_with: Scene | None = None,
    opaque_weight: float = 0.0,
) -> Trainer:
    torch.manual_seed(0)
    method = create_method("wildgs", model, begins_with or scene)
    if begins_with is not None:
        with torch.no_grad():
            method.gaussians.rows["opacity_logits"].fill_(2.0)
    config = TrainConfig(
        steps=steps,
        precision="float32",
        objective=ObjectiveConfig(sky_weight=weight, opaque_weight=opaque_weight),
        density=DensityConfig(min_visibility=0.0),
    )
    return Trainer(method, scene, config)


def opacity_above(trainer: Trainer) -> float:
    """Accumulated alpha of the landmark's Gaussians in the upper third of a photo."""
    method = trainer.method
    assert isinstance(method, WildGS)
    sky = method.sky()
    assert sky is not None
    gaussians = method.gaussians
    with torch.no_grad():
        gaussians.rows["opacity_logits"][sky] = -20.0
        camera = trainer.views[0].camera
        rendering = method.render(camera, method.shade(method.encode(torch.zeros(HEIGHT, WIDTH, 3), camera)))
    return float(rendering.alpha[: HEIGHT // 3].mean())


def test_what_is_in_front_of_the_sky_disappears(scene: Scene, model: WildGSConfig) -> None:
    """The curtain has the colour of the sky, so that the photos do not tell them apart."""
    opacities = {}
    for weight in (0.0, 1.0):
        trainer = trainer_for(scene, model, 50, weight, begins_with=with_curtain(scene))
        trainer.run()
        opacities[weight] = opacity_above(trainer)
    assert opacities[0.0] > 0.5
    assert opacities[1.0] < 0.5 * opacities[0.0]


@pytest.mark.parametrize(("points", "changes"), [(300, True), (0, False)], ids=["sky", "no sky"])
def test_dark_walls_are_opaque(scene: Scene, model: WildGSConfig, points: int, changes: bool) -> None:
    """What is dark would else be transparent before the black background; without sky, nothing need be behind."""
    dark = []
    for view in scene.views:
        photo = torch.full((HEIGHT, WIDTH, 3), 204, dtype=torch.uint8)
        photo[HEIGHT // 2 :] = 5
        dark.append(make_view(view.name, view.camera, photo=photo))
    scene = replace(scene, views=tuple(dark), point_colors=torch.full_like(scene.point_colors, 20))
    model = replace(model, sky=replace(model.sky, points=points))
    clear = []
    for weight in (0.0, 0.3):
        trainer = trainer_for(scene, model, 40, opaque_weight=weight)
        with torch.no_grad():
            trainer.method.gaussians.rows["opacity_logits"].fill_(-3.0)
        trainer.run()
        with torch.no_grad():
            projection = trainer.method.gaussians.project(trainer.views[0].camera)
            clear.append(float((1 - blend(projection, None).alpha).mean()))
    if changes:
        assert clear[1] < 0.7 * clear[0]
    else:
        assert clear[1] == clear[0] > 0


@pytest.mark.parametrize(("points", "weight", "found"), [(300, 1.0, 4), (300, 0.0, 0), (0, 1.0, 0)], ids=str)
def test_the_sky_of_a_photo_is_found_once_and_only_where_it_is_used(
    scene: Scene,
    model: WildGSConfig,
    monkeypatch: pytest.MonkeyPatch,
    points: int,
    weight: float,
    found: int,
) -> None:
    calls = []

    def counting(*arguments: object) -> torch.Tensor:
        calls.append(arguments)
        return find(*arguments)  # pyright: ignore[reportArgumentType]

    find = feed.find_sky_pixels
    monkeypatch.setattr(feed, "find_sky_pixels", counting)
    model = replace(model, sky=replace(model.sky, points=points))
    trainer_for(scene, model, 9, weight).run()
    assert len(calls) == found


@pytest.mark.parametrize("with_prior", [False, True])
def test_sky_is_static_where_a_depth_prior_tells_it_from_walls(
    scene: Scene, model: WildGSConfig, monkeypatch: pytest.MonkeyPatch, with_prior: bool
) -> None:
    prior = torch.zeros(HEIGHT, WIDTH) if with_prior else None
    monkeypatch.setattr(feed, "aligned_depth", lambda *arguments: (None, prior))
    trainer = trainer_for(scene, model, 1)
    given, loss = [], trainer.loss

    def seen(*arguments, **options):
        given.append((options["sky"], options["static"]))
        return loss(*arguments, **options)

    trainer.begin()
    monkeypatch.setattr(trainer, "loss", seen)
    trainer.advance()
    monkeypatch.setattr(trainer, "loss", loss)
    trainer.end()
    sky, static = given[0]
    assert sky.any()
    assert static is (sky if with_prior else None)


def test_gaussians_do_not_grow_in_the_sky(
    scene: Scene, model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: list[torch.Tensor] = []
    measure = RelocationDensity.measure

    def recording(
        self: RelocationDensity, view: SeenView, sound: torch.Tensor | None = None
    ) -> ViewStatistics:
        counted.append(torch.ones(HEIGHT, WIDTH) if view.counts is None else view.counts.float())
        return measure(self, view, sound)

    monkeypatch.setattr(RelocationDensity, "measure", recording)
    depth = np.full((HEIGHT, WIDTH), DISTANCE, np.float32)
    ceiling = replace(scene, views=tuple(with_photos(view, depth=depth) for view in scene.views))
    for each in (scene, ceiling):
        trainer_for(each, model, 1).run()
    outdoors, indoors = counted
    assert float(outdoors[: HEIGHT // 3].mean()) == 0
    assert float(outdoors[HEIGHT // 2 + 2 :].mean()) == 1
    assert float(indoors.mean()) == 1, "a depth map tells that there is no sky"
