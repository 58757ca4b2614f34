// Moving about: orbit round the landmark, or fly; mouse, touch and keys.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const KEYS = {
  KeyW: [0, 0, -1], ArrowUp: [0, 0, -1],
  KeyS: [0, 0, 1], ArrowDown: [0, 0, 1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0],
  KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
  KeyE: [0, 1, 0], Space: [0, 1, 0],
  KeyQ: [0, -1, 0],
};
const UP = new THREE.Vector3(0, 0, 1);
const STEEPEST = 0.495 * Math.PI;
const TURN = 2.2; // radians over the picture's height

/** The camera's place and direction under the viewer's hands. */
export class Navigation {
  constructor(stage, element, start, changed) {
    this.camera = stage.camera;
    this.element = element;
    this.start = start;
    this.changed = changed;
    this.mode = "orbit";
    this.pressed = new Set();
    this.pointers = new Map();
    this.orbit = new OrbitControls(this.camera, element);
    this.orbit.enableDamping = true;
    this.orbit.dampingFactor = 0.12;
    this.orbit.zoomToCursor = false;
    this.orbit.minDistance = 0.05;
    this.orbit.maxDistance = 50;
    this.orbit.addEventListener("change", changed);
    this.listen();
    this.reset();
  }

  /** Back to where the page opened. */
  reset() {
    this.goTo(this.start.position, this.start.target);
  }

  /** Where the camera is, and what it looks at. */
  place() {
    const distance = this.camera.position.distanceTo(this.orbit.target);
    const target = this.forward().multiplyScalar(distance).add(this.camera.position);
    return { position: this.camera.position.toArray(), target: target.toArray() };
  }

  /** Puts the camera somewhere, and lets it look at a point. */
  goTo(position, target) {
    this.camera.position.fromArray(position);
    this.orbit.target.fromArray(target);
    this.camera.up.copy(UP);
    this.camera.lookAt(this.orbit.target);
    this.orbit.update();
    this.changed();
  }

  /** Chooses what dragging does: `orbit` or `fly`. */
  setMode(mode) {
    const distance = this.camera.position.distanceTo(this.orbit.target);
    this.mode = mode;
    this.orbit.enabled = mode === "orbit";
    if (mode === "orbit") this.aim(distance);
  }

  /** Puts the point that orbiting turns about before the camera. */
  aim(distance) {
    this.orbit.target.copy(this.forward()).multiplyScalar(distance).add(this.camera.position);
  }

  forward() {
    return new THREE.Vector3(0, 0, -1).applyQuaternion(this.camera.quaternion);
  }

  listen() {
    const { element } = this;
    window.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input, button")) return;
      if (event.code in KEYS) {
        this.pressed.add(event.code);
        event.preventDefault();
      }
    });
    window.addEventListener("keyup", (event) => this.pressed.delete(event.code));
    window.addEventListener("blur", () => this.pressed.clear());
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.moved(event));
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  down(event) {
    if (this.mode !== "fly") return;
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
  }

  moved(event) {
    const last = this.pointers.get(event.pointerId);
    if (this.mode !== "fly" || !last) return;
    const before = this.spread();
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    Object.assign(last, { x: event.clientX, y: event.clientY });
    const height = this.element.clientHeight;
    const reach = this.reach();
    if (this.pointers.size >= 2) {
      const pinch = (this.spread() - before) / height;
      this.shift([(-dx / height / 2) * reach, (dy / height / 2) * reach, -2 * pinch * reach]);
    } else if (last.button === 2) {
      this.shift([(-dx / height) * reach, (dy / height) * reach, 0]);
    } else {
      this.turn((-dx / height) * TURN, (-dy / height) * TURN);
    }
  }

  wheel(event) {
    if (this.mode !== "fly") return;
    event.preventDefault();
    this.shift([0, 0, Math.sign(event.deltaY) * 0.08 * this.reach()]);
  }

  /** Distance between the first two fingers, pixels. */
  spread() {
    const [one, two] = this.pointers.values();
    return two ? Math.hypot(one.x - two.x, one.y - two.y) : 0;
  }

  /** A length to measure steps by: how far away the landmark was at the start. */
  reach() {
    const { position, target } = this.start;
    return Math.hypot(...position.map((value, axis) => value - target[axis]));
  }

  /** Looks further left and up, radians; the horizon stays level. */
  turn(left, up) {
    const angles = new THREE.Euler().setFromQuaternion(this.camera.quaternion, "ZXY");
    const tilt = Math.min(Math.PI / 2 + STEEPEST, Math.max(Math.PI / 2 - STEEPEST, angles.x + up));
    this.camera.quaternion.setFromEuler(new THREE.Euler(tilt, 0, angles.z + left, "ZXY"));
    this.changed();
  }

  /** Moves along the camera's own axes (right, up, back), and what it orbits with it. */
  shift(steps) {
    const offset = new THREE.Vector3(...steps).applyQuaternion(this.camera.quaternion);
    this.camera.position.add(offset);
    this.orbit.target.add(offset);
    this.changed();
  }

  /** Takes the held keys and the orbit's inertia one frame further. */
  update(seconds, fast) {
    if (this.pressed.size) {
      const speed = 0.5 * this.reach() * seconds * (fast ? 4 : 1);
      const steps = [0, 0, 0];
      for (const code of this.pressed) KEYS[code].forEach((value, axis) => (steps[axis] += value * speed));
      this.shift(steps);
    }
    if (this.mode === "orbit") this.coast();
  }

  /** The orbit's inertia. Its arithmetic moves a resting camera by a last bit, which would mean a new picture. */
  coast() {
    const [position, quaternion] = [this.camera.position.clone(), this.camera.quaternion.clone()];
    if (this.orbit.update()) return;
    this.camera.position.copy(position);
    this.camera.quaternion.copy(quaternion);
  }
}
