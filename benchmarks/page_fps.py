"""How fast does an exported page open and move under software WebGL?

    python benchmarks/page_fps.py runs/gate/export/page.html [--width 960] [--height 540] [--seconds 10]

Opens the page in a headless Chromium from the PATH with SwiftShader (no GPU), then turns the scene and afterwards
moves the light, and counts finished pictures. While moving, the page draws fewer pixels where the machine is slow;
`--full` keeps all of them. Needs playwright (`pip install playwright`; no browser download) and Chromium; says so
and ends where there is none.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from pathlib import Path

FLAGS = [
    "--no-sandbox", "--disable-background-networking", "--ignore-gpu-blocklist", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]  # fmt: skip
PATIENCE = 600_000  # milliseconds

MOVE = """async ([seconds, kind, full]) => {
  const page = await wildgs.ready;
  if (full) page.adaptDetail = () => {};
  const began = performance.now();
  const before = page.frames;
  let steps = 0;
  const drawn = () => new Promise((resolve) => {
    const frames = page.frames;
    const wait = () => (page.frames > frames ? resolve() : requestAnimationFrame(wait));
    wait();
  });
  while (performance.now() - began < 1000 * seconds) {
    steps += 1;
    if (kind === "turn") {
      const { camera } = page.stage;
      const { target } = page.navigation.orbit;
      const [x, y] = [camera.position.x - target.x, camera.position.y - target.y];
      const angle = 0.03 * Math.sign(Math.sin(steps / 10));
      camera.position.x = target.x + x * Math.cos(angle) - y * Math.sin(angle);
      camera.position.y = target.y + x * Math.sin(angle) + y * Math.cos(angle);
      camera.lookAt(target);
      page.moved();
    } else {
      page.lights.set((page.lights.count - 1) * (0.5 + 0.5 * Math.sin(steps / 15)));
    }
    await drawn();
  }
  const seconds_taken = (performance.now() - began) / 1000;
  return { fps: (page.frames - before) / seconds_taken, detail: page.detail };
}"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("page", type=Path)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=540)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--full", action="store_true", help="keep all pixels while moving")
    options = parser.parse_args()
    program = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        sys.exit("skipped: no playwright; `pip install playwright`")
    if program is None:
        sys.exit("skipped: no Chromium on the PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        tab = browser.new_page(viewport={"width": options.width, "height": options.height})
        began = time.monotonic()
        tab.goto(options.page.resolve().as_uri())
        tab.wait_for_function("document.documentElement.dataset.state", timeout=PATIENCE)
        opened = time.monotonic() - began
        count = tab.evaluate("JSON.parse(document.getElementById('header').textContent).count")
        print(
            f"{options.page.name}: {options.page.stat().st_size / 1e6:.1f} MB, {count:,} Gaussians, "
            f"{options.width} x {options.height}, {os.cpu_count()} cores; opened in {opened:.1f} s"
        )
        for kind, label in (("turn", "turning"), ("light", "moving the light")):
            result = tab.evaluate(MOVE, [options.seconds, kind, options.full])
            print(f"{label}: {result['fps']:.1f} pictures/s at {100 * result['detail']:.0f}% of the width")
        browser.close()


if __name__ == "__main__":
    main()
