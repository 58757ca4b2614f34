"""How many photos show each Gaussian: against rendering each Gaussian alone, and through all edits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wildgs.engine import photo_counts
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint, save_checkpoint
from wildgs.engine.config import DensityConfig, Strategy
from wildgs.engine.feed import PhotoFeed, ViewSampler
from wildgs.engine.photo_counts import count_interval, count_photos, is_due
from wildgs.engine.report import StepReport
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.model.config import DropoutConfig
from wildgs.model.gaussians import Gaussians
from wildgs.model.registry import MethodName, create_method, restore_method
from wildgs.model.vanilla import VanillaConfig, VanillaGS
from wildgs.model.wildgs import WildGSConfig
from wildgs.rasterize import blend
from wildgs.scene import Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")


def feed_of(scene: Scene, team: Team | None = None) -> PhotoFeed:
    views = scene.train_views
    sampler = ViewSampler(len(views), torch.Generator())
    return PhotoFeed(views, sampler, team or Team(), torch.device("cpu"))


def wall(scene: Scene) -> Gaussians:
    """The wall's points, one Gaussian in front of it, and one behind all cameras."""
    extra = torch.tensor([[0.0, 0.0, 0.8], [0.0, 0.0, -3.0]])
    means = torch.cat([scene.points[::20], extra])
    colors = torch.full((len(means), 3), 128, dtype=torch.uint8)
    return VanillaGS.from_points(VanillaConfig(), means, colors).gaussians


def test_the_number_agrees_with_rendering_every_gaussian_alone(wall_scene: Scene) -> None:
    gaussians, feed = wall(wall_scene), feed_of(wall_scene)
    weights = torch.zeros(len(feed.views), len(gaussians))
    with torch.no_grad():
        for row, view in enumerate(feed.views):
            camera = feed.camera(view)
            projection = gaussians.project(camera.resized(camera.width // 2, camera.height // 2))
            for index in range(len(gaussians)):
                alone = torch.zeros(len(gaussians), 3)
                alone[index] = 1
                weights[row, index] = blend(projection, alone).colors[..., 0].sum()
    expected = weights.sum(0).square() / weights.square().sum(0).clamp_min(1e-12)
    photos = count_photos(gaussians, feed)
    torch.testing.assert_close(photos, expected, atol=0.02, rtol=0.01)
    assert photos[-1] == 0
    assert 0 < photos.max() <= len(feed.views) + 1e-3
    assert all(row.grad is None for row in gaussians.rows.values())


@pytest.mark.parametrize("shown", [1, 3, 7])
def test_photos_from_one_place_count_one_by_one(wall_scene: Scene, shown: int) -> None:
    same = replace(wall_scene.train_views[0])
    scene = replace(wall_scene, views=tuple(replace(same, name=f"{n}.jpg") for n in range(shown)))
    photos = count_photos(wall(scene), feed_of(scene))
    seen = photos > 0
    torch.testing.assert_close(photos[seen], torch.full_like(photos[seen], shown))


def test_of_many_photos_a_part_is_rendered(wall_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    same = wall_scene.train_views[0]
    scene = replace(wall_scene, views=tuple(replace(same, name=f"{n}.jpg") for n in range(9)))
    monkeypatch.setattr(photo_counts, "MOST_VIEWS", 4)
    rendered = []
    whole = photo_counts.blending_weights
    monkeypatch.setattr(photo_counts, "blending_weights", lambda *given: rendered.append(1) or whole(*given))
    photos = count_photos(wall(scene), feed_of(scene))
    assert len(rendered) == 3
    torch.testing.assert_close(photos[photos > 0], torch.full_like(photos[photos > 0], 9.0))


def test_ranks_share_the_photos(wall_scene: Scene) -> None:
    gaussians = wall(wall_scene)
    parts = []

    class Rank(Team):
        size = 2

        def __init__(self, rank: int) -> None:
            super().__init__()
            self.rank = rank

        def pool(self, statistics):
            parts.append(statistics)
            if self.rank == 0:
                return statistics
            return replace(
                statistics,
                demand=parts[0].demand + statistics.demand,
                seen=parts[0].seen + statistics.seen,
            )

    count_photos(gaussians, feed_of(wall_scene, Rank(0)))
    both = count_photos(gaussians, feed_of(wall_scene, Rank(1)))
    torch.testing.assert_close(both, count_photos(gaussians, feed_of(wall_scene)))


def test_counts_are_rare_in_long_runs() -> None:
    assert [step for step in range(1500) if is_due(step, 1, 1500)] == [250, 500, 750, 1000, 1250]
    assert sum(is_due(step, 1, 30_000) for step in range(30_000)) == 11
    assert sum(is_due(step, 8, 30_000) for step in range(0, 30_000, 8)) == 11
    assert not is_due(0, 1, 10)
    assert count_interval(30_000) == 2500


def trainer_for(
    scene: Scene, model: WildGSConfig, strategy: Strategy = "relocation", method: MethodName = "wildgs"
) -> Trainer:
    torch.manual_seed(0)
    config = TrainConfig(
        steps=20,
        precision="float32",
        density=DensityConfig(strategy=strategy),
        dropout=DropoutConfig(rate=0.5),
    )
    return Trainer(create_method(method, model if method == "wildgs" else None, scene), scene, config)


def differences_after_resuming(
    whole: Trainer, checkpoints: Path, scene: Scene, model: WildGSConfig
) -> list[str]:
    """Entries of the final state that differ if training is resumed from a checkpoint."""
    checkpoint = load_checkpoint(list_checkpoints(checkpoints)[0])
    resumed = Trainer(restore_method("wildgs", model, checkpoint.method), scene, whole.config)
    resumed.restore(checkpoint.state)
    resumed.run()
    ours, theirs = whole.state(), resumed.state()
    return [name for name in ours if name != "progress.seconds" and not torch.equal(ours[name], theirs[name])]


@pytest.mark.parametrize("strategy", ["relocation", "classic", "mcmc"])
def test_counts_follow_the_gaussians_and_a_resumed_run_ends_in_the_same_bits(
    wall_scene: Scene,
    tiny_model: WildGSConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    strategy: Strategy,
) -> None:
    monkeypatch.setattr(photo_counts, "LEAST_INTERVAL", 10)
    whole = trainer_for(wall_scene, tiny_model, strategy)

    edited = 0

    def save(report: StepReport) -> None:
        nonlocal edited
        photos = whole.method.gaussians.photos
        assert (photos is None) == (report.step <= 10)
        assert photos is None or len(photos) == report.num_gaussians
        if report.density is not None:
            edited += report.density.cloned + report.density.split + report.density.pruned
        if report.step == 15:
            save_checkpoint(tmp_path, 15, whole.state(), {})

    whole.run([save])
    assert edited, "no round of densification"
    assert differences_after_resuming(whole, tmp_path, wall_scene, tiny_model) == []


def test_plain_3dgs_drops_nothing(
    wall_scene: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(photo_counts, "LEAST_INTERVAL", 10)
    trainer = trainer_for(wall_scene, tiny_model, method="3dgs")
    trainer.run()
    assert trainer.method.gaussians.photos is None
