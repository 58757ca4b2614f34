"""A path is made of views that people add."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from wildgs.errors import UserError
from wildgs.geometry.camera_file import read_camera_path
from wildgs.scene import Scene
from wildgs.viewer.cameras import pose_of
from wildgs.viewer.lighting import Light, LightDesk
from wildgs.viewer.recording import MAX_VIEWS, RecordingPanel, free_name, make_film
from wildgs.viewer.serving import ServerConfig, open_server
from wildgs.viewer.subject import Subject

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

# imageio-ffmpeg leaves its pipes to the garbage collector, which is heard of in whatever test it comes to.
pytestmark = pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[RecordingPanel]:
    server = open_server(ServerConfig(port=0), "wall")
    yield RecordingPanel(server, tmp_path, lambda _: None)
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
    """viser's camera is one object that continues moving."""
    pose = pose_of(wall.views[0].camera)
    panel.add(pose)
    pose.position[:] = np.nan
    panel.add(pose_of(wall.views[1].camera))
    assert panel.order().keyframes[0].viewmat.isfinite().all()


def test_a_path_of_one_view_is_refused_in_one_line(panel: RecordingPanel, wall: Scene) -> None:
    panel.add(pose_of(wall.views[0].camera))
    with pytest.raises(UserError, match="at least two views"):
        panel.order()


@pytest.mark.parametrize(
    ("seconds", "height"), [(1e7, "480"), (float("nan"), "480"), (0.0, "480"), (6.0, "30000")]
)
def test_videos_are_bounded(panel: RecordingPanel, wall: Scene, seconds: float, height: str) -> None:
    """Whatever a browser set the controls to."""
    for view in wall.views[:2]:
        panel.add(pose_of(view.camera))
    panel._seconds._impl.value, panel._height._impl.value = seconds, height
    with pytest.raises(UserError, match="limited to 60 seconds"):
        panel.order()


def test_paths_are_bounded(panel: RecordingPanel, wall: Scene) -> None:
    for _ in range(MAX_VIEWS + 3):
        panel.add(pose_of(wall.views[0].camera))
    assert len(panel._markers) == len(panel.order().keyframes) == MAX_VIEWS


def test_video_goes_along_the_path_under_changing_light(
    panel: RecordingPanel, subject: Subject, wall: Scene, tmp_path: Path
) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    for view in (wall.views[0], wall.views[3]):
        panel.add(pose_of(view.camera))
    panel._height.value = "360"
    panel._seconds.value = 1.0
    panel._relight.value = True
    desk = LightDesk(Light("0 dark.jpg", "dark"), Light("1 bright.jpg", "bright"))
    told: list[tuple[int, int]] = []
    file = make_film(subject, desk, panel.order(), free_name(tmp_path), lambda *at: told.append(at) or True)
    assert told[-1] == (30, 30)
    reader = imageio_ffmpeg.read_frames(str(file))
    assert next(reader)["size"] == (640, 360)
    frames = [np.frombuffer(frame, dtype=np.uint8) for frame in reader]
    assert len(frames) == 30
    assert frames[-1].mean() > 1.3 * frames[0].mean()
    path = read_camera_path(file.with_suffix(".json"))
    assert len(path.cameras) == 30
    torch.testing.assert_close(
        path.cameras[0].viewmat.float(), wall.views[0].camera.viewmat, atol=1e-4, rtol=0
    )
    assert free_name(tmp_path).name == "path_002.mp4"


def test_closing_the_viewer_leaves_no_half_video(
    panel: RecordingPanel, subject: Subject, wall: Scene, tmp_path: Path
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    for view in (wall.views[0], wall.views[3]):
        panel.add(pose_of(view.camera))
    panel._height.value = "360"
    desk = LightDesk(Light("0 dark.jpg", "dark"), Light("1 bright.jpg", "bright"))
    with pytest.raises(UserError, match="incomplete"):
        make_film(subject, desk, panel.order(), tmp_path / "a.mp4", lambda done, _: done < 3)
    assert list(tmp_path.iterdir()) == []
