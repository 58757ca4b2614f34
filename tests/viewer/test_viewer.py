"""The page's logic on a real server, without a browser."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.memory_views import make_view
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError
from wildgs.scene import Scene
from wildgs.viewer.cameras import Pose
from wildgs.viewer.display import colors_from
from wildgs.viewer.lighting import KEPT_UPLOADS, UPLOAD_SIDE, Light
from wildgs.viewer.serving import ServerConfig, open_server
from wildgs.viewer.subject import Subject, TrainingSubject
from wildgs.viewer.viewer import Viewer, ViewerConfig

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

import msgspec


def work_off(viewer: Viewer) -> None:
    while (job := viewer.jobs.take(wait=False)) is not None:
        job()


def open_on(subject: Subject, **options: Any) -> Viewer:
    server = open_server(ServerConfig(port=0), "wall")
    return Viewer(server, subject, ViewerConfig(**options), status="a wall")


@pytest.fixture
def viewer(subject: Subject) -> Iterator[Viewer]:
    viewer = open_on(subject)
    work_off(viewer)
    yield viewer
    viewer.close()


def standing_at(place: np.ndarray) -> Pose:
    return Pose(np.array([1.0, 0, 0, 0]), place.astype(float), 1.0, 1.5)


def colors(viewer: Viewer) -> np.ndarray:
    handle = viewer.display._handle
    assert handle is not None
    return handle.rgbs.astype(float) / 255


def test_splats_are_the_gaussians_as_the_eye_sees_them(viewer: Viewer, subject: Subject) -> None:
    handle = viewer.display._handle
    assert handle is not None
    assert len(handle.centers) == len(subject.method.gaussians)
    look = viewer.lighting.desk.look(subject)
    expected = colors_from(subject.method.gaussians.means, look.sh, viewer.display.eye, subject.sh_degree)
    np.testing.assert_allclose(colors(viewer), expected, atol=1 / 255)


def test_thumbnails_come_with_a_frustum_each(viewer: Viewer, wall: Scene) -> None:
    assert [name for name, _ in viewer.gallery.sources()] == [view.name for view in wall.views]
    assert len(viewer.photos._frustums) == len(wall.views)
    assert viewer.lighting._sheet.content.count("<img") == len(wall.views)


def test_masks_are_shown_over_photos_until_they_are_switched_off(
    viewer: Viewer, subject: Subject, wall: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def left_is_hidden(view) -> torch.Tensor:
        return (torch.arange(32) >= 16).float().expand(32, 32)

    monkeypatch.setattr(subject, "visibility", left_is_hidden)
    plain = dict(viewer.gallery.sources())
    names = [view.name for view in wall.views]
    viewer.lighting.masks.value = True
    viewer._masks_asked(True)
    work_off(viewer)
    assert all(source != plain[name] for name, source in viewer.gallery.sources())
    tinted = viewer.gallery.picture(names[0])
    assert tinted is not None
    assert tinted[16, 4, 0] > 150 > 80 > tinted[16, 4, 1]
    assert np.ptp(tinted[16, 28]) == 0, "grey where nothing is hidden"
    assert np.array_equal(viewer.photos._frustums[names[0]].image, tinted)
    assert len(viewer.photos._frustums) == len(names), "no frustum twice"
    assert dict(viewer.gallery.sources())[names[0]] in viewer.lighting._sheet.content
    viewer._masks_asked(False)
    assert dict(viewer.gallery.sources()) == plain
    assert plain[names[0]] in viewer.lighting._sheet.content


def test_masks_follow_a_training(viewer: Viewer, subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subject, "visibility", lambda view: torch.ones(32, 32))
    viewer._masks_asked(True)
    work_off(viewer)
    before = viewer.gallery.sources()
    monkeypatch.setattr(subject, "visibility", lambda view: torch.zeros(32, 32))
    viewer.ask_for_update()
    work_off(viewer)
    assert all(old != new for old, new in zip(before, viewer.gallery.sources(), strict=True))


def test_a_method_without_masks_says_so(
    viewer: Viewer, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    complaints: list[str] = []
    monkeypatch.setattr(subject, "visibility", lambda view: None)
    monkeypatch.setattr(viewer, "show_error", complaints.append)
    viewer.lighting.masks.value = True
    viewer._masks_asked(True)
    work_off(viewer)
    assert complaints == ["this method predicts no masks"]
    assert not viewer.lighting.masks.value
    assert not viewer.gallery.masks


def test_begins_between_two_lights_that_differ(viewer: Viewer) -> None:
    desk = viewer.lighting.desk
    assert "dark" in desk.first.label
    assert "dark" not in desk.second.label


def test_moving_the_slider_changes_colours(viewer: Viewer) -> None:
    seen = []
    for amount in (0.0, 0.5, 1.0):
        viewer.lighting.set_amount(amount)
        work_off(viewer)
        seen.append(colors(viewer).mean())
    assert seen[0] < seen[1] < seen[2]


def test_many_slider_moves_are_one_shading(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    monkeypatch.setattr(viewer.display, "show", shown.append)
    for amount in np.linspace(0.1, 0.9, 50):
        viewer.lighting.set_amount(float(amount))
    work_off(viewer)
    assert len(shown) == 1


def test_colours_follow_the_camera_s_place_but_not_its_turn(
    viewer: Viewer, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr("wildgs.viewer.viewer.REPAINT_SECONDS", 0.0)
    monkeypatch.setattr(viewer, "_repaint_soon", lambda: asked.append(True))
    place = viewer.display.eye.numpy()
    viewer._camera_moved(standing_at(place))
    assert asked == []
    before = colors(viewer)
    viewer._camera_moved(standing_at(place + [0.5, 0.2, 0.0]))
    assert viewer._timer is not None
    viewer._timer.join(20)
    assert asked == [True]
    viewer.display.repaint()
    look = viewer.lighting.desk.look(subject)
    eye = torch.from_numpy(place + [0.5, 0.2, 0.0]).float()
    expected = colors_from(subject.method.gaussians.means, look.sh, eye, subject.sh_degree)
    np.testing.assert_allclose(colors(viewer), expected, atol=1 / 255)
    assert np.abs(expected - before).max() > 1 / 255


def test_depth_is_bright_where_near(viewer: Viewer, subject: Subject) -> None:
    viewer._set_paint("depth")
    work_off(viewer)
    distances = (subject.method.gaussians.means - viewer.display.eye).norm(dim=1).detach().numpy()
    brightness = colors(viewer).sum(axis=1)
    order = np.argsort(distances)
    assert brightness[order[:20]].mean() > brightness[order[-20:]].mean() + 0.5


def test_visiting_a_photo_shows_it_beside_its_render(viewer: Viewer, wall: Scene) -> None:
    viewer.photos.visit(None, wall.views[5])
    work_off(viewer)
    page = viewer.photos._pictures.content
    assert page.count("<img") == 4
    assert "<img src=x" not in page
    assert "&lt;img src=x" in page
    assert viewer.photos._choice.value == wall.views[5].name


def test_a_picture_that_cannot_be_used_changes_nothing(viewer: Viewer) -> None:
    before, desk = colors(viewer), viewer.lighting.desk
    for content in (b"no picture", b""):
        with pytest.raises(UserError, match="not a readable image"):
            viewer.lighting.take_picture("mine.jpg", content)
    work_off(viewer)
    assert viewer.lighting.desk == desk, "the light before stays chosen"
    np.testing.assert_array_equal(colors(viewer), before)


def test_a_light_that_cannot_be_is_a_message_and_nothing_else(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(viewer, "show_error", said.append)
    before, desk = colors(viewer), viewer.lighting.desk
    viewer.lighting.choose(Light("gone.jpg", "gone.jpg"))
    work_off(viewer)
    assert viewer.lighting.desk == desk
    assert "gone.jpg" in said[0]
    np.testing.assert_array_equal(colors(viewer), before)


def test_numbers_from_browsers_are_bounded(viewer: Viewer) -> None:
    desk = viewer.lighting.desk
    viewer.lighting.set_amount(float("nan"))
    assert viewer.lighting.desk == desk
    viewer.lighting.set_amount(1e9)
    assert viewer.lighting.desk.amount == 1.0


def test_few_uploads_are_kept(viewer: Viewer) -> None:
    content = io.BytesIO()
    Image.new("RGB", (3000, 20), (200, 90, 30)).save(content, "PNG")
    for _ in range(KEPT_UPLOADS + 4):
        viewer.lighting.take_picture("evening.png", content.getvalue())
    folder = Path(viewer.lighting._uploads.name)
    assert len(list(folder.iterdir())) == KEPT_UPLOADS
    chosen = Path(viewer.lighting.desk.first.spec)
    with Image.open(chosen) as kept:
        assert max(kept.size) == UPLOAD_SIDE
    assert viewer.lighting.desk.first.label == "evening.png"


def test_a_picture_of_many_pixels_is_refused_unread(viewer: Viewer, huge_picture: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(UserError, match="exceed the limit") as caught:
        viewer.lighting.take_picture("huge.png", huge_picture)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    assert "--max-image-pixels" not in str(caught.value), "the viewer has no such option"


def test_a_fault_in_the_viewer_does_not_end_its_worker(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr(viewer.display, "show", fail)
    viewer.lighting.set_amount(0.5)
    work_off(viewer)
    assert "a fault" in capsys.readouterr().err


def test_few_photos_are_offered_of_many(subject: Subject) -> None:
    viewer = open_on(subject, photos=2)
    work_off(viewer)
    assert len(viewer.gallery.sources()) == 2
    viewer.close()


def test_training_is_shown_as_it_goes_on(trainer_for, wall: Scene) -> None:
    trainer: Trainer = trainer_for(wall, 30)
    viewer = open_on(TrainingSubject(trainer, wall))
    work_off(viewer)
    before = colors(viewer)
    trainer.run()
    viewer.photos.visit(None, wall.views[0])
    viewer.ask_for_update()
    work_off(viewer)
    assert trainer.method.training, "the method is left as training had it"
    after = colors(viewer)
    assert len(after) == len(trainer.method.gaussians), "also of those that densification made"
    assert np.abs(after.mean(axis=0) - before.mean(axis=0)).max() > 1 / 255
    assert viewer.photos._pictures.content.count("<img") == 4
    viewer.close()


def test_gaussians_that_came_meanwhile_are_shown(trainer_for, wall: Scene) -> None:
    """Looks and splats of an earlier step have another number of rows."""
    trainer: Trainer = trainer_for(wall, 30)
    viewer = open_on(TrainingSubject(trainer, wall))
    work_off(viewer)
    rows = trainer.method.gaussians.rows
    for name in list(rows):
        rows[name] = torch.nn.Parameter(torch.cat([rows[name], rows[name][:7]]).detach())
    trainer.step += 1
    viewer.display.repaint()
    viewer.lighting.set_amount(0.4)
    work_off(viewer)
    assert len(colors(viewer)) == len(trainer.method.gaussians) == len(wall.points) + 7
    viewer.close()


def test_a_name_that_is_not_utf8_breaks_nothing(learnt: Trainer, wall: Scene) -> None:
    """Names are bytes; the page is sent as UTF-8."""
    names = ["caf\udce9.jpg", "line\nbreak.jpg", *(view.name for view in wall.views[2:])]
    views = tuple(
        make_view(name, view.camera, view.split, view.read_photo())
        for view, name in zip(wall.views, names, strict=True)
    )
    viewer = open_on(Subject(learnt.method, replace(wall, views=views)))
    work_off(viewer)
    viewer.photos.visit(None, views[0])
    viewer.show_error(f"{names[0]}: no")
    work_off(viewer)
    assert viewer.photos._choice.value == "caf\\xe9.jpg"
    buffer = viewer.server._websock_server.get_message_buffer()
    sent = [
        msgspec.msgpack.encode(message.as_serializable_dict([]))
        for message in buffer.message_from_id.values()
    ]
    assert any(b"caf\\xe9.jpg" in message for message in sent)
    viewer.lighting.choose(Light(names[0], names[0]))
    work_off(viewer)
    assert viewer._lit_by is not None
    assert viewer._lit_by.first.spec == names[0], "the name itself is still what finds the photo"
    viewer.close()
