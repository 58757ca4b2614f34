"""Do programs of others read the .glb and .usd of `wildgs export`, and show each light as Wild-GS does?

    npm install --prefix benchmarks/readers
    python -m benchmarks.file_readers runs/gate [--lights 8] [--output FOLDER]

Khronos's glTF validator and all validators of OpenUSD check the files. PlayCanvas and Babylon.js draw each light of
the .glb in a headless Chromium (software WebGL). Their pictures are compared with renders of the run itself under
its own light, and written side by side (run, PlayCanvas, Babylon.js) to the output folder.
"""

from __future__ import annotations

import base64
import functools
import io
import json
import math
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

import wildgs
from benchmarks.page_fps import FLAGS
from wildgs.geometry.camera import Camera
from wildgs.library.loaded import LoadedScene
from wildgs.scene.start import choose_start

HERE = Path(__file__).parent / "readers"
READERS = ("playcanvas", "babylon")
WIDTH, HEIGHT = 480, 360


@dataclass(frozen=True)
class Command:
    """Opens exported files with other programs."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    lights: int = 8
    """Number of lights."""
    output: Path = Path("readers")
    """Folder for the pictures."""


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, *_: object) -> None:
        """Nothing is logged."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on this machine."""
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def read_camera(file: Path) -> dict:
    """The start camera of a .glb."""
    content = file.read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    node = next(node for node in document["nodes"] if "camera" in node)
    return {
        **document["cameras"][0]["perspective"],
        **{key: node[key] for key in ("translation", "rotation")},
    }


def start_camera(loaded: LoadedScene, yfov: float) -> Camera:
    """The camera of the start view with a centred principal point."""
    focal = 0.5 * HEIGHT / math.tan(yfov / 2)
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    return Camera(choose_start(loaded.scene)[0].camera.viewmat, K, WIDTH, HEIGHT)


def check_usd(file: Path) -> None:
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    context, stage = UsdValidation.ValidationContext(validators), Usd.Stage.Open(str(file))
    lights = stage.GetDefaultPrim().GetVariantSet("light")
    issues = list(context.Validate(stage))
    for name in lights.GetVariantNames():
        lights.SetVariantSelection(name)
        issues += context.Validate(stage)
    print(f"usd, {len(lights.GetVariantNames())} lights, {len(validators)} validators: {len(issues)} issues")
    for issue in issues:
        print("  ", issue.GetName(), issue.GetMessage())


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((first / 255.0 - second / 255.0) ** 2)))


def compare(loaded: LoadedScene, names: list[str], folder: Path, output: Path) -> None:
    """Draws each light of `scene.glb` with all readers, and prints PSNR against renders of the run."""
    from playwright.sync_api import sync_playwright

    camera = read_camera(folder / "scene.glb")
    ours = start_camera(loaded, camera["yfov"])
    arguments = ["--bundle", "--format=iife", "--log-level=error", f"--outdir={folder}"]
    scripts = [str(HERE / f"{reader}.js") for reader in READERS]
    subprocess.run([str(HERE / "node_modules" / ".bin" / "esbuild"), *scripts, *arguments], check=True)
    with served(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_browser(), args=FLAGS)
        for number, name in enumerate(names):
            shown = [loaded.render(ours, loaded.appearance(name)).numpy()]
            for reader in READERS:
                (folder / "index.html").write_text(f"<!doctype html><body><script src={reader}.js></script>")
                page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
                page.goto(f"{address}/index.html")
                page.set_default_timeout(300_000)
                given = [f"{address}/scene.glb", number, camera, WIDTH, HEIGHT]
                url = page.evaluate("(given) => draw(...given)", given)
                picture = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
                shown.append(np.asarray(picture))
                page.close()
            values = [
                f"{reader} {psnr(shown[0], each):.1f} dB"
                for reader, each in zip(READERS, shown[1:], strict=True)
            ]
            print(f"{name}: {', '.join(values)}", flush=True)
            Image.fromarray(np.concatenate(shown, axis=1)).save(output / f"{number}.png")
        browser.close()


def _browser() -> str | None:
    return shutil.which("chromium") or shutil.which("google-chrome")


def main(command: Command) -> None:
    if not (HERE / "node_modules").is_dir():
        sys.exit("first run: npm install --prefix benchmarks/readers")
    if _browser() is None:
        sys.exit("install Chromium or Google Chrome, and put it on the PATH as chromium or google-chrome")
    loaded = wildgs.load(command.run, device="cpu")
    views = loaded.scene.train_views
    count = min(command.lights, len(views))
    names = [views[index * (len(views) - 1) // max(count - 1, 1)].name for index in range(count)]
    command.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        wildgs.export(loaded, ("glb", "usd"), appearance=names, output=folder)
        file = Path(folder, "scene.glb")
        subprocess.run(["node", str(HERE / "validate.mjs"), str(file)], check=True)
        check_usd(Path(folder, "scene.usd"))
        compare(loaded, names, Path(folder), command.output)


if __name__ == "__main__":
    main(tyro.cli(Command))
