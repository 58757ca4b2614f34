"""A path is made of views that people add."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from wildgs.data import Scene
from wildgs.errors import UserError
from wildgs.viewer.cameras import pose_of
from wildgs.viewer.recording import RecordingPanel
from wildgs.viewer.server import ServerConfig, open_server

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[RecordingPanel]:
    server = open_server(ServerConfig(port=0), "wall")
    yield RecordingPanel(server, tmp_path, lambda: None)
    server.stop()


def test_views_are_kept_in_order_and_taken_away_from_the_end(panel: RecordingPanel, wall: Scene) -> None:
    for view in wall.views[:3]:
        panel.add(pose_of(view.camera))
    panel.drop()
    keyframes = panel.order().keyframes
    assert len(keyframes) == len(panel._markers) == 2
    for keyframe, view in zip(keyframes, wall.views, strict=False):
        torch.testing.assert_close(keyframe.viewmat, view.camera.viewmat, atol=1e-5, rtol=0)
        assert (keyframe.width, keyframe.height) == (853, 480)


def test_a_view_is_the_camera_at_the_moment(panel: RecordingPanel, wall: Scene) -> None:
    """viser's camera is one object that goes on moving."""
    pose = pose_of(wall.views[0].camera)
    panel.add(pose)
    pose.position[:] = np.nan
    panel.add(pose_of(wall.views[1].camera))
    assert panel.order().keyframes[0].viewmat.isfinite().all()


def test_a_path_of_one_view_is_refused_in_one_line(panel: RecordingPanel, wall: Scene) -> None:
    panel.add(pose_of(wall.views[0].camera))
    with pytest.raises(UserError, match="two views"):
        panel.order()
