// Spark, set up so that its pictures are those of the rasteriser that trained the scene (gsplat's classic mode).

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";

// Splats are blended as the display's numbers, which are those that were trained; nothing is made linear.
THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;

const MIN_ALPHA = 1 / 255;
const MAX_STD_DEV = Math.sqrt(2 * Math.log(255)); // where an opaque splat falls below MIN_ALPHA

/** Replaces a line of Spark's shader; another version of Spark may need another line. */
function replaced(shader, old, better) {
  if (!shader.includes(old)) throw new Error(`Spark's shader has no line "${old}"`);
  return shader.replace(old, better);
}

function adapted(vertexShader) {
  // Splats outside the picture keep the shape that they have 0.3 half pictures beyond its edge, as in gsplat:
  // unbounded, the projection's linearisation smears them over everything.
  const shader = replaced(
    vertexShader,
    "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
    `vec2 held = clamp(clipCenter.xy / clipCenter.w, -1.3, 1.3);
        held += vec2(projectionMatrix[2][0], projectionMatrix[2][1]);
        held *= -viewCenter.z / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
        vec2 J2 = -(J1 * held) * invZ;`,
  );
  // A faint splat ends where its own alpha falls below the least that is drawn: fewer pixels to fill.
  return replaced(
    shader,
    "adjustedStdDev = maxStdDev;",
    "adjustedStdDev = min(maxStdDev, sqrt(2.0 * max(0.0, log(min(rgba.a, 1.0) / minAlpha))));",
  );
}

/** Blends in half floats: skies are often brighter than white, and bytes would cut that off splat by splat. */
class FloatCanvas {
  constructor(renderer) {
    this.renderer = renderer;
    this.target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType, depthBuffer: false });
    this.quad = new FullScreenQuad(
      new THREE.RawShaderMaterial({
        glslVersion: THREE.GLSL3,
        uniforms: { picture: { value: this.target.texture } },
        vertexShader: "in vec3 position; void main() { gl_Position = vec4(position, 1.0); }",
        fragmentShader: `precision highp float;
          uniform sampler2D picture;
          out vec4 color;
          void main() { color = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`,
        depthTest: false,
        depthWrite: false,
      }),
    );
  }

  /** Whether this device blends into half floats. */
  static supported(renderer) {
    return renderer.extensions.has("EXT_color_buffer_float") || renderer.extensions.has("EXT_color_buffer_half_float");
  }

  draw(scene, camera) {
    const size = this.renderer.getDrawingBufferSize(new THREE.Vector2());
    this.target.setSize(size.x, size.y);
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(scene, camera);
    this.renderer.setRenderTarget(null);
    this.quad.render(this.renderer);
  }
}

/** A canvas that draws one scene. */
export class Stage {
  constructor(canvas, splats, near, filter) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: false });
    this.renderer.setClearColor(0x000000, 1);
    this.camera = new THREE.PerspectiveCamera(50, 1, near, 5000);
    this.camera.up.set(0, 0, 1);
    this.scene = new THREE.Scene();
    this.wanted = true;
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: () => this.invalidate(),
      accumExtSplats: true,
      sortRadial: false,
      // What training added to the footprints, in square pixels; Spark's blurAmount compensates for it in opacities.
      preBlurAmount: filter.antialiased ? 0 : filter.eps2d,
      blurAmount: filter.antialiased ? filter.eps2d : 0,
      minAlpha: MIN_ALPHA,
      maxStdDev: MAX_STD_DEV,
      maxPixelRadius: 1e5,
      clipXY: 1e4,
      enableLod: false,
      enableDriveLod: false,
    });
    const { material } = this.spark;
    material.vertexShader = adapted(material.vertexShader);
    this.floats = FloatCanvas.supported(this.renderer) ? new FloatCanvas(this.renderer) : null;
    this.splats = splats;
    this.mesh = new SplatMesh({ splats, editable: false, raycastable: false, enableLod: false });
    this.scene.add(this.spark, this.mesh);
  }

  /** Asks for a new picture in the next frame. */
  invalidate() {
    this.wanted = true;
  }

  /** Shows (1 - amount) of the light `from` and `amount` of the light `to`. */
  blend(from, to, amount) {
    this.splats.blend(from, to, amount);
    this.mesh.updateVersion();
    this.invalidate();
  }

  resize(width, height, pixelRatio) {
    this.renderer.setPixelRatio(pixelRatio);
    this.renderer.setSize(width, height, false);
    this.invalidate();
  }

  /** Draws if something has changed since the last picture. */
  draw() {
    if (!this.wanted) return false;
    this.wanted = false;
    this.spark.dirty = false;
    if (this.floats) this.floats.draw(this.scene, this.camera);
    else this.renderer.render(this.scene, this.camera);
    return true;
  }

  /** Whether the picture is that of the camera and light as they are: sorted, nothing pending. */
  get settled() {
    const { spark } = this;
    return !this.wanted && !spark.sorting && !spark.sortDirty && spark.activeSplats > 0;
  }
}
