"""A wall photographed under two lights, a method that has learnt them, and a browser."""

from __future__ import annotations

import base64
import http.server
import itertools
import json
import shutil
import struct
import subprocess
import threading
import time
import urllib.request
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.memory_views import make_view
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import create_method
from wildgs.model.sky import SkyConfig
from wildgs.model.wildgs import WildGSConfig
from wildgs.model.wrapping import WrappingConfig
from wildgs.scene import Alignment, Scene, View
from wildgs.viewer.subject import Subject

SIDE = 32
EVIL = '<img src=x onerror="document.title=1">"\'&.jpg'
"""A file may be called so."""


def _view(name: str, camera: Camera, split, photo: torch.Tensor) -> View:
    return make_view(name, camera, split, photo)


@pytest.fixture(scope="session")
def huge_picture() -> bytes:
    """A PNG of 240 megapixels in 230 kB, written by hand: encoding it from pixels would take their memory."""
    width, height = 20_000, 12_000

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    compress, row = zlib.compressobj(9), bytes(1 + (width + 7) // 8)
    pixels = b"".join([*(compress.compress(row) for _ in range(height)), compress.flush()])
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.fixture(scope="session")
def wall() -> Scene:
    """Stripes at y = 1, seen from y = 0 (z is up); every second photo is dark, one has a nasty name."""
    x, z = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 24), indexing="ij")
    points = torch.stack([x, torch.ones_like(x), z], dim=-1).reshape(-1, 3)
    stripes = ((points[:, 0] * 4).floor() % 2 == 0)[:, None]
    colors = torch.where(stripes, torch.tensor([220, 60, 60]), torch.tensor([60, 60, 220])).to(torch.uint8)
    views = []
    for index in range(6):
        viewmat = torch.tensor([[1.0, 0, 0, 0.1 * (index - 2)], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        K = torch.tensor([[30.0, 0, SIDE / 2], [0, 30.0, SIDE / 2], [0, 0, 1]])
        camera = Camera(viewmat, K, SIDE, SIDE)
        seen = camera.unproject(torch.ones(SIDE, SIDE))[..., :1]
        pixels = torch.where(
            (seen * 4).floor() % 2 == 0, torch.tensor([220, 60, 60]), torch.tensor([60, 60, 220])
        )
        photo = (pixels * (1.0 if index % 2 else 0.3)).round().to(torch.uint8)
        name = EVIL if index == 5 else f"{index} {'bright' if index % 2 else 'dark'}.jpg"
        views.append(_view(name, camera, "test" if index == 4 else "train", photo))
    return Scene(Path("wall"), tuple(views), points, colors, Alignment.identity())


def make_trainer(scene: Scene, steps: int, method="wildgs") -> Trainer:
    model = WildGSConfig(
        sky=SkyConfig(points=0),
        parsing=ParsingConfig(max_side=32),
        wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)),
    )
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", WildGSWarning)  # of weights that tests do without
        made = create_method(method, model if method == "wildgs" else None, scene)
    with torch.no_grad():
        # Where Gaussians hide little, a bright wall takes colours brighter than white, which browsers have not.
        made.gaussians.rows["opacity_logits"].fill_(3.0)
    return Trainer(made, scene, TrainConfig(steps=steps, precision="float32"))


@pytest.fixture
def trainer_for() -> Callable[..., Trainer]:
    return make_trainer


@pytest.fixture(scope="session")
def learnt(wall: Scene) -> Trainer:
    """Has learnt both lights. Tests must not train it on."""
    trainer = make_trainer(wall, 120)
    trainer.run()
    trainer.method.eval()
    return trainer


@pytest.fixture
def subject(learnt: Trainer, wall: Scene) -> Subject:
    return Subject(learnt.method, wall)


class Browser:
    """One page in headless Chromium, over its debugging protocol."""

    def __init__(self, url: str, profile: Path, width: int = 1000, height: int = 700) -> None:
        self.events: list[dict[str, Any]] = []
        self._numbers = itertools.count(1)
        program = shutil.which("chromium") or shutil.which("google-chrome")
        assert program is not None
        self._process = subprocess.Popen(
            [
                program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
                "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0",
                "--remote-allow-origins=*", f"--user-data-dir={profile}", "about:blank",
            ],
            stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        assert self._process.stderr is not None
        port = next(
            line.split(":")[2].split("/")[0] for line in self._process.stderr if "DevTools listening" in line
        )
        threading.Thread(target=self._process.stderr.read, daemon=True).start()
        from websockets.sync.client import connect

        self._socket = connect(self._page_address(int(port)), max_size=None, ping_interval=None)
        for domain in ("Runtime", "Log", "Page", "DOM"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.call("Page.navigate", url=url)

    @staticmethod
    def _page_address(port: int) -> str:
        for _ in range(100):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60) as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
            time.sleep(0.1)
        raise TimeoutError("Chromium shows no page")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def evaluate(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def screenshot(self, file: Path) -> Path:
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return file

    def errors(self) -> list[str]:
        """What the console holds of errors and uncaught exceptions."""
        self.evaluate("1")  # events that came meanwhile
        found = []
        for event in self.events:
            parameters = event.get("params", {})
            if event["method"] == "Runtime.exceptionThrown":
                found.append(str(parameters["exceptionDetails"]))
            elif event["method"] == "Runtime.consoleAPICalled" and parameters["type"] == "error":
                found.append(" ".join(str(part.get("value")) for part in parameters["args"]))
            elif event["method"] == "Log.entryAdded" and parameters["entry"]["level"] == "error":
                found.append(parameters["entry"]["text"])
        return found

    def close(self) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=60)
        if self._process.stderr is not None:
            self._process.stderr.close()


@pytest.fixture
def browse(tmp_path: Path) -> Iterator[Callable[[str], Browser]]:
    """Opens pages; closes them afterwards."""
    opened: list[Browser] = []

    def browse(url: str) -> Browser:
        opened.append(Browser(url, tmp_path / f"profile-{len(opened)}"))
        return opened[-1]

    yield browse
    for browser in opened:
        browser.close()


@pytest.fixture
def foreign_site() -> Iterator[Callable[[str], str]]:
    """Serves a page from another origin; gives its address."""
    pages: dict[str, bytes] = {}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = pages.get(self.path, b"")
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()

    def serve(page: str) -> str:
        pages["/page.html"] = page.encode()
        return f"http://localhost:{server.server_port}/page.html"

    yield serve
    server.shutdown()
    server.server_close()
    thread.join(20)
