"""A photo beside its render, mask and depth."""

from __future__ import annotations

import numpy as np

from tests.memory_views import make_view
from wildgs.engine.trainer import Trainer
from wildgs.exporters.depth_colors import HIDDEN_TINT, tint_hidden
from wildgs.viewer.photos import LONG_SIDE, compare
from wildgs.viewer.subject import Subject


def test_pictures_of_one_viewpoint(subject: Subject) -> None:
    view = subject.views[1]
    seen = compare(subject, view, subject.look(view.name))
    assert seen.name == seen.light == view.name
    assert seen.photo.shape == seen.render.shape == seen.depth.shape == (32, 32, 3)
    assert seen.mask is not None
    assert seen.mask.shape == (32, 32, 3)
    np.testing.assert_array_equal(seen.photo, view.read_photo().numpy())
    assert seen.psnr > 12, "the render resembles the photo"
    worse = compare(subject, view, subject.look(subject.views[0].name))
    assert worse.psnr < seen.psnr, "another light resembles it less"


def test_large_photos_are_shown_small(subject: Subject) -> None:
    view = subject.views[1]
    large = view.read_photo().repeat_interleave(40, 0).repeat_interleave(50, 1)
    camera = view.camera.resized(1600, 1280)
    seen = compare(subject, make_view(view.name, camera, photo=large), subject.look(view.name))
    assert seen.photo.shape == seen.render.shape == (384, LONG_SIDE, 3)


def test_baseline_has_no_mask(trainer_for, wall) -> None:
    trainer: Trainer = trainer_for(wall, 1, "3dgs")
    subject = Subject(trainer.method, wall)
    assert not subject.relightable
    assert compare(subject, wall.views[0], subject.look("any")).mask is None


def test_hidden_is_red_and_static_is_grey() -> None:
    photo = np.full((1, 2, 3), (90, 120, 150), dtype=np.uint8)
    tinted = tint_hidden(photo, np.array([[0.0, 1.0]]))
    assert tinted[0, 1].tolist() == [120, 120, 120]
    assert np.abs(tinted[0, 0] - HIDDEN_TINT).max() <= 24
