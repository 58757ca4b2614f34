// The page: reads the scene that it carries, draws it, and lets people move and change the light.

import { Matrix4 } from "three";
import { Lights } from "./lights.js";
import { Navigation } from "./navigation.js";
import { Stage } from "./renderer.js";
import { readScene } from "./scene.js";
import { RelightableSplats } from "./splats.js";

const element = (id) => document.getElementById(id);
const IDLE = 300; // milliseconds without movement after which the picture is drawn in full detail
const SLOW = 45; // milliseconds a frame above which detail is given up while moving
const FAST = 22;
const LEAST_DETAIL = 0.4;

class Page {
  constructor(header, scene) {
    this.header = header;
    this.canvas = element("view");
    this.stage = new Stage(this.canvas, new RelightableSplats(scene), header.near, header.filter);
    this.detail = 1; // share of the screen's pixels per axis that is drawn while moving
    this.lastMove = 0;
    this.fixed = null;
    this.navigation = new Navigation(this.stage, this.canvas, header.start, () => this.moved());
    const controls = { strip: element("strip"), slider: element("slider"), play: element("play") };
    this.lights = new Lights(controls, header.lights, header.day, (from, to, amount) => {
      this.stage.blend(from, to, amount);
      this.moved();
    });
    this.connect();
    this.resize();
    this.followLink();
    requestAnimationFrame((now) => this.frame(now, now));
  }

  connect() {
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    element("reset").addEventListener("click", () => {
      this.free();
      this.navigation.reset();
    });
    element("mode").addEventListener("click", () => this.setMode(this.navigation.mode === "orbit" ? "fly" : "orbit"));
    element("full").addEventListener("click", () => this.toggleFullScreen());
    element("full").hidden = !document.documentElement.requestFullscreen;
    element("info").addEventListener("click", () => element("about").showModal());
    element("link").addEventListener("click", () => this.copyLink());
    window.addEventListener("hashchange", () => this.followLink());
    window.addEventListener("keydown", (event) => (this.shift = event.shiftKey));
    window.addEventListener("keyup", (event) => (this.shift = event.shiftKey));
    this.canvas.addEventListener("pointerdown", () => this.free());
    this.canvas.addEventListener("webglcontextlost", () => fail("The WebGL context was lost; reload the page."));
  }

  setMode(mode) {
    this.navigation.setMode(mode);
    element("mode").textContent = mode === "orbit" ? "Orbit" : "Fly";
    element("mode").setAttribute("aria-pressed", String(mode === "fly"));
  }

  toggleFullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen();
  }

  moved() {
    this.lastMove = performance.now();
    this.stage?.invalidate();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    const ratio = this.fixed ? 1 : Math.min(2, window.devicePixelRatio) * this.detail;
    this.stage.resize(width, height, ratio);
    const { camera } = this.stage;
    camera.aspect = width / height;
    // All that the start's photo shows stays in the picture, whatever the window's shape.
    const tall = Math.tan(this.header.start.fov_y / 2) * Math.max(1, this.header.start.aspect / camera.aspect);
    camera.fov = (2 * Math.atan(tall) * 180) / Math.PI;
    if (this.fixed) this.stage.renderer.setSize(this.fixed.width, this.fixed.height, false);
    else camera.updateProjectionMatrix();
  }

  frame(before, now) {
    requestAnimationFrame((next) => this.frame(now, next));
    if (!this.fixed) {
      this.navigation.update(Math.min(0.1, (now - before) / 1000), this.shift);
      this.adaptDetail(now - before, now - this.lastMove < IDLE);
    }
    if (this.stage.draw()) this.frames = (this.frames ?? 0) + 1;
  }

  /** Fewer pixels while a slow machine moves, all of them when it rests. */
  adaptDetail(milliseconds, moving) {
    let detail = moving ? (this.movingDetail ?? 1) : 1;
    if (moving) {
      this.pace = 0.8 * (this.pace ?? milliseconds) + 0.2 * Math.min(milliseconds, 500);
      if (this.pace > SLOW) detail = Math.max(LEAST_DETAIL, detail * 0.85);
      else if (this.pace < FAST) detail = Math.min(1, detail * 1.05);
      this.movingDetail = detail;
    }
    if (Math.abs(detail - this.detail) > 0.12 || (detail === 1 && this.detail !== 1 && !moving)) {
      this.detail = detail;
      this.pace = undefined;
      this.resize();
    }
  }

  /** Looks through a given camera, at its size in pixels, until the viewer moves. */
  look({ viewmat, K, width, height }) {
    const { camera, renderer } = this.stage;
    this.fixed = { width, height };
    renderer.setPixelRatio(1);
    renderer.setSize(width, height, false);
    const [fx, fy, cx, cy] = [K[0][0], K[1][1], K[0][2], K[1][2]];
    const { near, far } = camera;
    camera.projectionMatrix.set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    const flip = new Matrix4().makeScale(1, -1, -1); // OpenCV's axes to WebGL's
    const view = flip.multiply(new Matrix4().set(...viewmat.flat()));
    view.invert().decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    this.stage.invalidate();
  }

  /** Camera and light as the address's fragment. */
  fragment() {
    const { position, target } = this.navigation.place();
    const numbers = [...position, ...target].map((value) => value.toFixed(4));
    return `#view=${numbers.join(",")}&light=${this.lights.value.toFixed(3)}`;
  }

  /** Puts the link to this view into the address, and into the clipboard where the browser lets it. */
  async copyLink() {
    history.replaceState(null, "", this.fragment());
    await navigator.clipboard?.writeText(location.href).catch(() => {});
    element("link").textContent = "Copied";
    setTimeout(() => (element("link").textContent = "Link"), 1500);
  }

  /** Takes camera and light from the address; what makes no sense there is left out. */
  followLink() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    const numbers = (wanted.get("view") ?? "").split(",").map(Number);
    if (numbers.length === 6 && numbers.every(Number.isFinite)) {
      this.free();
      this.setMode("orbit");
      this.navigation.goTo(numbers.slice(0, 3), numbers.slice(3));
    }
    const light = Number.parseFloat(wanted.get("light") ?? "");
    if (Number.isFinite(light)) this.lights.set(light);
  }

  free() {
    if (!this.fixed) return;
    this.fixed = null;
    this.resize();
  }

  /** Resolves when the picture is finished: sorted for this camera and light, in full detail. */
  async settle() {
    for (let quiet = 0; quiet < 3; ) {
      await new Promise(requestAnimationFrame);
      quiet = this.stage.settled && (this.fixed || this.detail === 1) ? quiet + 1 : 0;
    }
  }

  /** The finished picture as a PNG's data URL. */
  async snapshot() {
    await this.settle();
    this.stage.invalidate();
    this.stage.draw();
    return this.canvas.toDataURL("image/png");
  }
}

function fail(message) {
  element("loading").hidden = false;
  element("loading").textContent = message;
  document.documentElement.dataset.state = "failed";
}

async function open() {
  const header = JSON.parse(element("header").textContent);
  const scene = await readScene(header, element("scene").textContent);
  element("scene").remove();
  const page = new Page(header, scene);
  await page.settle();
  element("loading").hidden = true;
  document.documentElement.dataset.state = "ready";
  return page;
}

/** For scripts and tests: `await wildgs.ready`, then what `Page` offers. */
window.wildgs = {
  ready: open().catch((error) => {
    fail(`This browser cannot show the scene: ${error.message}`);
    throw error;
  }),
};
