"""The page in a real browser: the splats are drawn, lights differ, clicks arrive."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.evaluation.metrics import psnr
from wildgs.viewer.cameras import Pose, camera_of, pose_of
from wildgs.viewer.jobs import start_worker
from wildgs.viewer.serving import ServerConfig, address, open_server
from wildgs.viewer.subject import Subject
from wildgs.viewer.viewer import Viewer, ViewerConfig

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
pytestmark = [pytest.mark.chromium, pytest.mark.timeout(600)]

HEIGHT = 256
LIBRARY_NOISE = "computeBoundingSphere"
"""viser's own splat mesh has positions of two numbers, at which three.js complains."""


@pytest.fixture
def viewer(subject: Subject) -> Iterator[Viewer]:
    server = open_server(ServerConfig(port=0), "wall")
    viewer = Viewer(server, subject, ViewerConfig())
    worker = start_worker(viewer.jobs)
    yield viewer
    viewer.close()
    worker.join(60)


def wait_for(condition: Callable[[], object], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the browser did not get there"
        time.sleep(0.1)


def first_pose(viewer: Viewer) -> Pose:
    """The first photo's camera in the shape of the window: viser draws splats for the window, whatever is asked."""
    client = next(iter(viewer.server.get_clients().values()))
    return replace(pose_of(viewer.subject.views[0].camera), aspect=client.camera.aspect)


def drawn(viewer: Viewer) -> np.ndarray:
    """What the browser draws from `first_pose`, without panels; cameras hidden."""
    client = next(iter(viewer.server.get_clients().values()))
    pose = first_pose(viewer)
    client.camera.fov = pose.fov
    width = camera_of(pose, HEIGHT).width
    picture = client.get_render(
        HEIGHT,
        width,
        wxyz=pose.wxyz,
        position=pose.position,
        fov=pose.fov,
        transport_format="png",
        timeout=120,
    )
    return picture[..., :3]


def settled(viewer: Viewer) -> np.ndarray:
    """What the browser draws once it draws something, and the same twice."""
    seen = [np.zeros(1)]

    def rests() -> bool:
        time.sleep(1)
        seen.append(drawn(viewer))
        return seen[-1].max() > 30 and np.array_equal(seen[-1], seen[-2])

    wait_for(rests)
    return seen[-1]


def send(page: Any, picture: Path) -> None:
    """Drops a file on the page."""
    wait_for(lambda: page.evaluate("document.querySelectorAll('input[type=file]').length") == 1)
    root = page.call("DOM.getDocument")["root"]["nodeId"]
    node = page.call("DOM.querySelector", nodeId=root, selector="input[type=file]")["nodeId"]
    page.call("DOM.setFileInputFiles", files=[str(picture)], nodeId=node)


def test_page_draws_what_the_rasteriser_draws(
    viewer: Viewer, subject: Subject, browse: Callable, tmp_path: Path
) -> None:
    page = browse(address(viewer.server, ServerConfig()))
    wait_for(viewer.server.get_clients)
    wait_for(lambda: len(viewer.gallery.sources()) == len(subject.views))
    viewer.display.eye = subject.views[0].camera.position
    pictures = {}
    for amount in (0.0, 1.0):
        viewer.lighting.set_amount(amount)
        wait_for(lambda: viewer._lit_by == viewer.lighting.desk)
        pictures[amount] = settled(viewer)
        expected, _ = subject.render(
            camera_of(first_pose(viewer), HEIGHT), viewer.lighting.desk.look(subject)
        )
        assert psnr(torch.from_numpy(pictures[amount].copy()), expected) > 25
    lit = (pictures[0.0].max(axis=2) > 8).mean()
    assert lit > 0.5, "most of the picture is not background"
    difference = np.abs(pictures[0.0].astype(float) - pictures[1.0]).mean()
    assert difference > 10, "two lights give two pictures"
    shot = Image.open(page.screenshot(tmp_path / "page.png")).convert("RGB")
    assert np.asarray(shot).reshape(-1, 3).std(axis=0).max() > 10
    assert [error for error in page.errors() if LIBRARY_NOISE not in error] == []
    assert page.evaluate("document.title") != "1", "a file's name became a script"


def test_a_click_on_a_thumbnail_gives_its_light(viewer: Viewer, subject: Subject, browse: Callable) -> None:
    page = browse(address(viewer.server, ServerConfig()))
    wait_for(lambda: len(viewer.gallery.sources()) == len(subject.views))
    wait_for(
        lambda: page.evaluate("document.querySelectorAll('label[title] img').length") == len(subject.views)
    )
    assert page.evaluate("document.querySelector('label[title] img').getBoundingClientRect().width") > 20
    page.evaluate("document.querySelectorAll('label[title]')[3].click()")
    wait_for(lambda: viewer.lighting.desk.first.spec == subject.views[3].name)
    hidden = "[...document.querySelectorAll('button')].filter(b => b.textContent.endsWith('.jpg'))"
    assert page.evaluate(f"{hidden}.every(b => b.getBoundingClientRect().height === 0)")


def test_a_dropped_picture_gives_its_light(
    viewer: Viewer, subject: Subject, browse: Callable, tmp_path: Path
) -> None:
    picture = tmp_path / "evening.png"
    Image.fromarray(np.full((30, 40, 3), (250, 120, 20), dtype=np.uint8)).save(picture)
    page = browse(address(viewer.server, ServerConfig()))
    wait_for(lambda: page.evaluate("document.querySelectorAll('input[type=file]').length") == 1)
    assert page.evaluate("document.querySelector('input[type=file]').getBoundingClientRect().height") > 30
    send(page, picture)
    wait_for(lambda: viewer.lighting.desk.first.label == "evening.png")


def test_a_picture_that_cannot_be_used_is_no_success(
    viewer: Viewer, subject: Subject, browse: Callable, tmp_path: Path
) -> None:
    before = viewer.lighting.desk
    picture = tmp_path / "broken.png"
    picture.write_bytes(b"no picture" * 100)
    page = browse(address(viewer.server, ServerConfig()))
    send(page, picture)
    text = "document.body.innerText"
    wait_for(lambda: "Upload failed" in page.evaluate(text))
    time.sleep(1)
    assert "not a readable image" in page.evaluate(text)
    assert "successfully" not in page.evaluate(text)
    assert "Uploading" not in page.evaluate(text)
    assert viewer.lighting.desk.first == before.first or "broken" not in viewer.lighting.desk.first.label
    good = tmp_path / "evening.png"
    Image.fromarray(np.full((30, 40, 3), (250, 120, 20), dtype=np.uint8)).save(good)
    send(page, good)
    wait_for(lambda: viewer.lighting.desk.first.label == "evening.png")
    wait_for(lambda: "uploaded successfully" in page.evaluate(text))


FOREIGN_PAGE = """
<title>waiting</title><pre id=log></pre><script>
const log = [], base = "127.0.0.1:PORT", tokens = ["", "TOKEN"];
const attempts = [];
for (const token of tokens) {
  for (const mode of ["cors", "no-cors"])
    attempts.push(fetch(`http://${base}/${token}`, {mode})
      .then(r => r.text().then(t => log.push(`fetch ${r.type} ${r.status} ${t.length}`)))
      .catch(() => log.push("fetch failed")));
  attempts.push(new Promise(done => {
    const socket = new WebSocket(`ws://${base}/${token}`, ["viser-vVERSION"]);
    socket.onopen = () => { log.push("OPEN"); done(); };
    socket.onmessage = () => log.push("MESSAGE");
    socket.onerror = () => { log.push("socket refused"); done(); };
  }));
}
Promise.all(attempts).then(() => setTimeout(() => {
  document.getElementById("log").textContent = log.join("\\n"); document.title = "done"; }, 1000));
</script>
"""


def attack(browse: Callable, foreign_site: Callable, port: int, token: str) -> None:
    """A page of another site finds nothing at the viewer's port, not even if it knows the token."""
    import viser

    html = FOREIGN_PAGE.replace("PORT", str(port)).replace("VERSION", viser.__version__)
    page = browse(foreign_site(html.replace("TOKEN", token)))
    wait_for(lambda: page.evaluate("document.title") == "done")
    log = page.evaluate("document.getElementById('log').textContent").splitlines()
    assert set(log) - {"fetch opaque 0 0"} == {"fetch failed", "socket refused"}
    assert log.count("socket refused") == 2


def test_a_page_of_another_site_gets_nothing(
    viewer: Viewer, browse: Callable, foreign_site: Callable
) -> None:
    attack(browse, foreign_site, viewer.server.get_port(), viewer.server.access.token)
    assert viewer.server.get_clients() == {}
    own = browse(address(viewer.server, ServerConfig()))
    wait_for(viewer.server.get_clients)
    assert own.evaluate("document.querySelectorAll('canvas').length") > 0


@pytest.fixture
def training(landmark: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """`wildgs train --view`, as a process of its own; killed where the test leaves it."""
    command = [sys.executable, "-m", "wildgs", "train", str(landmark), "--output", str(tmp_path / "run")]
    options = ["--method", "3dgs", "--steps", "1000000", "--view", "--server.port", "0"]
    with subprocess.Popen(command + options, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def test_a_training_is_shown_to_its_own_page_alone(
    training: subprocess.Popen[str], tmp_path: Path, browse: Callable, foreign_site: Callable
) -> None:
    assert training.stdout is not None
    url = next(line.split("viewer: ")[1].strip() for line in training.stdout if "viewer: " in line)
    threading.Thread(target=training.stdout.read, daemon=True).start()
    attack(browse, foreign_site, int(url.split("/")[2].split(":")[1]), url.split("/")[3])
    own = browse(url)
    steps = set()

    def goes_on() -> bool:
        found = re.search(r"step ([\d,]+) of 1,000,000", own.evaluate("document.body?.innerText ?? ''"))
        steps.add(found and found[1])
        return len(steps - {None}) > 1

    wait_for(goes_on)
    assert own.evaluate("document.querySelectorAll('canvas').length") > 0
    training.send_signal(signal.SIGTERM)
    assert training.wait(120) == 128 + signal.SIGTERM
    assert list((tmp_path / "run" / "checkpoints").iterdir())
