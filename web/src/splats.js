// The scene as a source of splats for Spark: geometry once, and colours blended between two lights on the GPU.

import { dyno } from "@sparkjsdev/spark";
import * as THREE from "three";

const WIDTH = 2048; // every WebGL 2 device takes textures this wide

function texture(words, perTexel) {
  const rows = Math.max(1, Math.ceil(words.length / perTexel / WIDTH));
  const padded = new Uint32Array(rows * WIDTH * perTexel);
  padded.set(words);
  const format = perTexel === 4 ? THREE.RGBAIntegerFormat : THREE.RedIntegerFormat;
  const result = new THREE.DataTexture(padded, WIDTH, rows, format, THREE.UnsignedIntType);
  result.internalFormat = perTexel === 4 ? "RGBA32UI" : "R32UI";
  result.needsUpdate = true;
  return result;
}

const SH = [
  // 3D Gaussian Splatting's order and signs, as wildgs/geometry/spherical_harmonics.py has them.
  "0.28209479177387814",
  "-0.4886025119029199 * d.y",
  "0.4886025119029199 * d.z",
  "-0.4886025119029199 * d.x",
  "1.0925484305920792 * d.x * d.y",
  "-1.0925484305920792 * d.y * d.z",
  "0.31539156525252005 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y)",
  "-1.0925484305920792 * d.x * d.z",
  "0.5462742152960396 * (d.x * d.x - d.y * d.y)",
  "-0.5900435899266435 * d.y * (3.0 * d.x * d.x - d.y * d.y)",
  "2.890611442640554 * d.x * d.y * d.z",
  "-0.4570457994644658 * d.y * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y)",
  "0.3731763325901154 * d.z * (2.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y)",
  "-0.4570457994644658 * d.x * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y)",
  "1.445305721320277 * d.z * (d.x * d.x - d.y * d.y)",
  "-0.5900435899266435 * d.x * (d.x * d.x - 3.0 * d.y * d.y)",
];

const number = (value) => (Number.isInteger(value) ? `${value}.0` : `${value}`);

/** GLSL that reads a splat's codes from a light's texture and evaluates them in a direction. */
function lightFunction({ degree, texels, range }) {
  const code = (channel) => {
    const word = Math.floor(channel / 4);
    const [texel, part] = [Math.floor(word / 4), "xyzw"[word % 4]];
    return `float((t${texel}.${part} >> ${8 * (channel % 4)}u) & 255u)`;
  };
  const fetches = Array.from(
    { length: texels },
    (_, t) => `uvec4 t${t} = texelFetch(light, wildgsTexel(${texels} * index + ${t}), 0);`,
  );
  const terms = [];
  for (let base = 0; base < (degree + 1) ** 2; base++) {
    const order = Math.floor(Math.sqrt(base));
    const [least, step] = [range.least[order], range.step[order]].map(number);
    const codes = [0, 1, 2].map((channel) => code(3 * base + channel)).join(", ");
    terms.push(`color += (${SH[base]}) * (${least} + ${step} * vec3(${codes}));`);
  }
  return `
    vec3 wildgsColor(usampler2D light, int index, vec3 d) {
      ${fetches.join("\n      ")}
      vec3 color = vec3(0.5);
      ${terms.join("\n      ")}
      return color;
    }`;
}

function globalsOf(scene) {
  const { scaleRange } = scene.geometry;
  return [
    `ivec2 wildgsTexel(int index) { return ivec2(index & ${WIDTH - 1}, index >> ${Math.log2(WIDTH)}); }`,
    lightFunction(scene),
    `vec3 wildgsScales(uint word) {
      vec3 codes = vec3(float(word & 255u), float((word >> 8u) & 255u), float((word >> 16u) & 255u));
      return exp(${number(scaleRange.least)} + ${number(scaleRange.step)} * codes);
    }`,
    // The three smallest of x, y, z, w in ten bits each; the two upper bits say which one is left out.
    `vec4 wildgsQuaternion(uint word) {
      vec3 small = vec3(float(word & 1023u), float((word >> 10u) & 1023u), float((word >> 20u) & 1023u));
      small = (small / 1023.0 - 0.5) * 1.4142135623730951;
      float large = sqrt(max(0.0, 1.0 - dot(small, small)));
      uint which = word >> 30u;
      if (which == 0u) return vec4(large, small);
      if (which == 1u) return vec4(small.x, large, small.yz);
      if (which == 2u) return vec4(small.xy, large, small.z);
      return vec4(small, large);
    }`,
  ];
}

/** Reads splat `index`, coloured as seen from `viewOrigin`. */
class ReadRelightable extends dyno.Dyno {
  constructor(scene, inputs) {
    super({
      inTypes: {
        index: "int",
        viewOrigin: "vec3",
        geometry: "usampler2D",
        rotations: "usampler2D",
        from: "usampler2D",
        to: "usampler2D",
        amount: "float",
      },
      outTypes: { gsplat: dyno.Gsplat },
      inputs,
      globals: () => [dyno.defineGsplat, ...globalsOf(scene)],
      statements: ({ inputs: { index, viewOrigin, geometry, rotations, from, to, amount }, outputs: { gsplat } }) =>
        dyno.unindentLines(`
          ${gsplat}.flags = 0u;
          ${gsplat}.index = ${index};
          if (${index} >= 0 && ${index} < ${scene.count}) {
            uvec4 words = texelFetch(${geometry}, wildgsTexel(${index}), 0);
            ${gsplat}.flags = GSPLAT_FLAG_ACTIVE;
            ${gsplat}.center = uintBitsToFloat(words.xyz);
            ${gsplat}.scales = wildgsScales(words.w);
            ${gsplat}.quaternion = wildgsQuaternion(texelFetch(${rotations}, wildgsTexel(${index}), 0).x);
            vec3 direction = normalize(${gsplat}.center - ${viewOrigin});
            vec3 color = wildgsColor(${from}, ${index}, direction);
            if (${amount} > 0.0) color = mix(color, wildgsColor(${to}, ${index}, direction), ${amount});
            ${gsplat}.rgba = vec4(max(color, vec3(0.0)), float(words.w >> 24u) / 255.0);
          }
        `),
    });
  }

  dynoOut() {
    return new dyno.DynoOutput(this, "gsplat");
  }
}

/** Spark's `SplatSource` over a relightable scene. */
export class RelightableSplats {
  constructor(scene) {
    this.scene = scene;
    this.lights = scene.lights.map((words) => texture(words, 4));
    this.geometry = dyno.dynoUsampler2D(texture(scene.geometry.words, 4), "geometry");
    this.rotations = dyno.dynoUsampler2D(texture(scene.geometry.rotations, 1), "rotations");
    this.from = dyno.dynoUsampler2D(this.lights[0], "lightFrom");
    this.to = dyno.dynoUsampler2D(this.lights[0], "lightTo");
    this.amount = dyno.dynoFloat(0, "lightAmount");
  }

  /** Shows (1 - amount) of the light `from` and `amount` of the light `to`. */
  blend(from, to, amount) {
    this.from.value = this.lights[from];
    this.to.value = this.lights[to];
    this.amount.value = amount;
  }

  prepareFetchSplat() {}

  dispose() {
    for (const one of [...this.lights, this.geometry.value, this.rotations.value]) one.dispose();
  }

  getNumSplats() {
    return this.scene.count;
  }

  hasRgbDir() {
    return this.scene.degree > 0;
  }

  getNumSh() {
    return this.scene.degree;
  }

  setMaxSh() {}

  fetchSplat({ index, viewOrigin }) {
    const { geometry, rotations, from, to, amount } = this;
    const inputs = { index, viewOrigin, geometry, rotations, from, to, amount };
    return new ReadRelightable(this.scene, inputs).dynoOut();
  }

  forEachSplat() {}
}
