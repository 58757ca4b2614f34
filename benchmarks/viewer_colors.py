"""How far are the viewer's pictures from the rasteriser's? One colour a splat against spherical harmonics.

Example: python benchmarks/viewer_colors.py runs/gate

Every held-out view is rendered under its own light with its harmonics, and compared with splats of one colour each:
evaluated for the view's own camera, for a camera some way off (what is seen while colours have not caught up), for
the middle of all cameras, and without any dependence on direction. With --browser the same views are drawn by a
headless Chromium too, as `wildgs view` draws them.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from wildgs import LoadedScene, Look, load
from wildgs.evaluation.metrics import psnr, to_8bit
from wildgs.rasterize import blend
from wildgs.scene import View
from wildgs.viewer.cameras import camera_of, fov_that_holds, pose_of
from wildgs.viewer.display import SplatDisplay, colors_from
from wildgs.viewer.serving import ServerConfig, address, open_server
from wildgs.viewer.subject import Subject

ASIDE = 0.1


@dataclass(frozen=True)
class Command:
    """Measures how the viewer's pictures differ."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    views: int = 6
    """How many views."""
    browser: bool = False
    """Also draw in Chromium."""


def draw(scene: LoadedScene, view: View, look: Look, eye: Tensor, degree: int) -> Tensor:
    """The view with one 8-bit colour a splat."""
    means = scene.gaussians.means
    colors = torch.from_numpy(np.rint(colors_from(means, look.sh, eye, degree) * 255) / 255).to(means)
    projection = scene.gaussians.project(view.camera.to(means.device))
    return to_8bit(blend(projection, colors, depth=False).colors).cpu()


@contextmanager
def browser(url: str) -> Iterator[None]:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        raise SystemExit("there is no Chromium on the PATH")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--user-data-dir={profile}"]
        with subprocess.Popen(
            [*command, "--remote-debugging-port=0", url], stderr=subprocess.DEVNULL
        ) as process:
            yield
            process.terminate()


@contextmanager
def drawing(scene: LoadedScene) -> Iterator[Callable[[View, Look], Tensor]]:
    """Draws views in a browser, waiting until what it shows changes no more."""
    server = open_server(ServerConfig(port=0), "benchmark")
    subject = Subject(scene.run.method, scene.scene)
    display = SplatDisplay(server, subject, scene.views[0].camera.position)
    with browser(address(server, ServerConfig())):
        while not server.get_clients():
            time.sleep(0.2)
        client = next(iter(server.get_clients().values()))

        def shot(view: View) -> np.ndarray:
            pose = pose_of(view.camera)
            return client.get_render(
                view.camera.height,
                view.camera.width,
                wxyz=pose.wxyz,
                position=pose.position,
                fov=fov_that_holds(pose, pose.aspect),
                transport_format="png",
            )[..., :3]

        def settled(view: View, look: Look) -> Tensor:
            display.eye = view.camera.position
            display.show(look)
            before = shot(view)
            while True:
                time.sleep(1.0)
                after = shot(view)
                if after.max() > 0 and np.abs(after.astype(int) - before).mean() < 0.05:
                    return torch.from_numpy(after.copy())
                before = after

        yield settled
    server.stop()


def main(command: Command) -> None:
    scene = load(command.run)
    views = (scene.scene.test_views or scene.views)[: command.views]
    middle = torch.stack([view.camera.position for view in scene.views]).median(dim=0).values
    degree = scene.run.method.sh_degree
    found: dict[str, list[float]] = {}

    def note(name: str, picture: Tensor, truth: Tensor) -> None:
        found.setdefault(name, []).append(psnr(picture, truth))

    with torch.no_grad():
        for view in views:
            look, eye = scene.appearance(view.name), view.camera.position
            truth = scene.render(view.camera, look)
            aside = eye + ASIDE * view.camera.viewmat[0, :3]
            note("colours for the camera itself", draw(scene, view, look, eye, degree), truth)
            note(f"for a camera {ASIDE:g} aside", draw(scene, view, look, aside, degree), truth)
            note("for the middle of all cameras", draw(scene, view, look, middle, degree), truth)
            note("without direction (degree 0)", draw(scene, view, look, eye, 0), truth)
        if command.browser:
            with drawing(scene) as in_browser:
                for view in views:
                    look = scene.appearance(view.name)
                    # viser's cameras look through the middle of the picture
                    middle_camera = camera_of(pose_of(view.camera), view.camera.height)
                    note("drawn by the browser", in_browser(view, look), scene.render(middle_camera, look))
    print(
        f"{command.run}: {len(scene.gaussians):,} Gaussians, {len(views)} views, PSNR against the rasteriser"
    )
    for name, values in found.items():
        print(f"  {name:<32} mean {statistics.mean(values):6.2f} dB, worst {min(values):6.2f} dB")


if __name__ == "__main__":
    main(tyro.cli(Command))
