"""Consensus of training photos within a run: when it is found, when it counts, and that it is resumed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.engine.test_trainer import trainer_for
from wildgs.engine.consensus import RISE, USUAL_FEW, USUAL_MANY, Consensus, usual_share
from wildgs.engine.trainer import Trainer
from wildgs.losses.config import ObjectiveConfig
from wildgs.losses.photometric import masked_photometric
from wildgs.model.config import SQUEEZENET
from wildgs.model.wildgs import WildGSConfig
from wildgs.scene import Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")


@pytest.fixture
def frozen_model(tiny_model: WildGSConfig) -> WildGSConfig:
    return replace(tiny_model, parsing=replace(tiny_model.parsing, encoder=SQUEEZENET))


def with_doubt(largest: float) -> Consensus:
    consensus = Consensus(torch.device("cpu"), 10, 1000)
    consensus.doubts = {"a": torch.tensor([[0.0, 0.25, 1.0]])}
    consensus.largest = largest
    return consensus


def hide_everything(trainer: Trainer, share: float = 1.0) -> None:
    trainer.consensus.hidden = torch.tensor([share, share])


def test_photos_are_compared_once_masks_hide_too_much(wall_scene: Scene, frozen_model: WildGSConfig) -> None:
    trainer, seen = trainer_for(wall_scene, frozen_model, 3), []
    trainer.on_compared_photo = lambda done, total: seen.append((done, total))
    trainer.begin()
    trainer.advance()
    assert not trainer.consensus.compared  # masks have hidden nothing yet
    hide_everything(trainer)
    trainer.step = 0  # in which the share is read
    trainer.advance()
    trainer.advance()
    trainer.end()
    photos = len(wall_scene.train_views)
    assert seen == [(done + 1, photos) for done in range(photos)]
    assert set(trainer.consensus.doubts) == {view.name for view in wall_scene.train_views}
    for doubt in trainer.consensus.doubts.values():
        assert ((doubt >= 0) & (doubt <= 1)).all()


@pytest.mark.parametrize(
    "objective", [ObjectiveConfig(consensus=False), ObjectiveConfig(mask_gradient="loss")]
)
def test_photos_are_not_compared_where_nothing_reads_it(
    wall_scene: Scene, frozen_model: WildGSConfig, objective: ObjectiveConfig
) -> None:
    trainer = trainer_for(wall_scene, frozen_model, 1, objective=objective)
    hide_everything(trainer)
    trainer.run()
    assert not trainer.consensus.doubts
    assert trainer.consensus.doubt(wall_scene.train_views[0].name) is None


def test_methods_without_a_frozen_encoder_have_no_features_to_compare(
    wall_scene: Scene, tiny_model: WildGSConfig
) -> None:
    trainer = trainer_for(wall_scene, tiny_model, 1, "3dgs")
    hide_everything(trainer)
    trainer.run()
    assert not trainer.consensus.doubts


def test_consensus_counts_once_masks_have_hidden_too_much() -> None:
    full, none = with_doubt(USUAL_FEW + RISE).doubt("a"), with_doubt(USUAL_FEW).doubt("a")
    half = with_doubt(USUAL_FEW + RISE / 2).doubt("a")
    assert full is not None
    assert none is not None
    assert half is not None
    torch.testing.assert_close(full, torch.tensor([[0.0, 0.25, 1.0]]))
    torch.testing.assert_close(none, torch.ones(1, 3))
    torch.testing.assert_close(half, torch.tensor([[0.5, 0.625, 1.0]]))
    assert with_doubt(1.0).doubt("b") is None


def test_masks_of_many_photos_are_trusted_less() -> None:
    assert usual_share(1) == usual_share(20) == USUAL_FEW
    assert usual_share(60) == usual_share(3000) == pytest.approx(USUAL_MANY)
    shares = [usual_share(photos) for photos in range(20, 61)]
    assert shares == sorted(shares, reverse=True)
    consensus = Consensus(torch.device("cpu"), 90, 1000)
    consensus.hidden = torch.tensor([0.0, USUAL_FEW])
    assert consensus.is_missing(0, 1)


def test_the_share_of_hidden_pixels_is_remembered_at_its_maximum() -> None:
    consensus = Consensus(torch.device("cpu"), 10, 1000)
    for _ in range(200):
        consensus.observe(torch.tensor([[0.2, 0.9], [0.9, 0.9]]), 0)
    assert consensus.hidden.tolist() == pytest.approx([0.25, 0.25], abs=0.01)
    for _ in range(200):
        consensus.observe(torch.ones(2, 2), 0)
    assert consensus.hidden.tolist() == pytest.approx([0.0, 0.25], abs=0.01)
    consensus.observe(torch.zeros(2, 2), 1000)
    assert float(consensus.hidden[0]) < 0.01, "observed a mask that is not trained any more"


def test_doubt_is_a_factor_on_the_evidence() -> None:
    generator = torch.Generator().manual_seed(0)
    photo, render = torch.rand(24, 32, 3, generator=generator), torch.zeros(24, 32, 3)
    gradients = []
    for doubt in (None, torch.ones(3, 4), torch.full((3, 4), 0.5), torch.zeros(3, 4)):
        visibility = torch.full((24, 32), 0.8, requires_grad=True)
        loss = masked_photometric(photo, render, visibility, doubt=doubt)
        gradients.append((loss.item(), *torch.autograd.grad(loss, visibility)))
    (value, plain), (_, all_), (_, half), (last, none) = gradients
    assert plain.abs().max() > 0
    torch.testing.assert_close(all_, plain)
    torch.testing.assert_close(half, plain / 2)
    assert not none.any()
    assert value == last


def test_a_resumed_run_compares_where_the_first_one_did(
    wall_scene: Scene, frozen_model: WildGSConfig
) -> None:
    first = trainer_for(wall_scene, frozen_model, 4)
    hide_everything(first, USUAL_FEW + RISE / 2)
    first.begin()
    first.advance()
    second = trainer_for(wall_scene, frozen_model, 4)
    second.method.load_state_dict(first.method.state_dict())
    second.restore(first.state())
    first.advance()
    first.end()  # before the other begins: settings of the process are undone in the reverse order
    second.begin()
    second.advance()
    second.end()
    name = wall_scene.train_views[0].name
    expected, found = first.consensus.doubt(name), second.consensus.doubt(name)
    assert expected is not None
    assert found is not None
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    torch.testing.assert_close(second.consensus.hidden, first.consensus.hidden)


def test_checkpoints_of_earlier_versions_have_hidden_nothing(
    wall_scene: Scene, frozen_model: WildGSConfig
) -> None:
    trainer = trainer_for(wall_scene, frozen_model, 5)
    earlier = trainer.state()
    del earlier["progress.hidden"]
    hide_everything(trainer)
    trainer.restore(earlier)
    assert trainer.consensus.hidden.tolist() == [0, 0]
    assert not trainer.consensus.is_missing(0, 1)
