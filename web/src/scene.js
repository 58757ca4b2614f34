// Reads the scene that wildgs/export/page_scene.py packed; that file describes the layout.

/** Bytes of base64 text. */
export function fromBase64(text) {
  if (typeof Uint8Array.fromBase64 === "function") return Uint8Array.fromBase64(text);
  const characters = atob(text);
  const bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

/** Undoes gzip. */
export async function gunzip(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Splits the bytes into the planes that the header names. */
function planesOf(bytes, header) {
  const planes = {};
  let start = 0;
  for (const [name, channels] of header.planes) {
    const length = channels * header.count;
    planes[name] = bytes.subarray(start, start + length);
    start += length;
  }
  if (start !== bytes.length) throw new Error("the scene's data do not fit its header");
  return planes;
}

/** Geometry as two arrays of 32-bit words, four and one per splat, as `splats.js` reads them. */
function unpackGeometry(planes, header) {
  const { count, means, scales } = header;
  const words = new Uint32Array(4 * count);
  const floats = new Float32Array(words.buffer);
  const rotations = new Uint32Array(count);
  const plane = (name, channel) => planes[name].subarray(channel * count, (channel + 1) * count);
  for (let axis = 0; axis < 3; axis++) {
    const [high, middle, low] = [0, 1, 2].map((byte) => plane("means", 3 * axis + byte));
    const [least, most] = [means.least[axis], means.most[axis]];
    const step = (most - least) / 0xffffff;
    const size = plane("scales", axis);
    for (let i = 0; i < count; i++) {
      floats[4 * i + axis] = Math.sinh(least + step * ((high[i] << 16) | (middle[i] << 8) | low[i]));
      words[4 * i + 3] |= size[i] << (8 * axis);
    }
  }
  const opacities = plane("opacities", 0);
  for (let i = 0; i < count; i++) words[4 * i + 3] = (words[4 * i + 3] | (opacities[i] << 24)) >>> 0;
  for (let byte = 0; byte < 4; byte++) {
    const bytes = plane("quats", byte);
    for (let i = 0; i < count; i++) rotations[i] = (rotations[i] | (bytes[i] << (8 * byte))) >>> 0;
  }
  return { words, rotations, scaleRange: scales };
}

/** One appearance's codes, interleaved per splat and padded to whole texels of 16 bytes. */
function unpackLight(planes, header, index, texels) {
  const { count } = header;
  const bytes = new Uint8Array(16 * texels * count);
  const channels = 3 * (header.sh_degree + 1) ** 2;
  const codes = planes[`light${index}`];
  const first = planes.light0;
  for (let channel = 0; channel < channels; channel++) {
    const start = channel * count;
    for (let i = 0; i < count; i++) {
      const code = index === 0 ? codes[start + i] : codes[start + i] + first[start + i];
      bytes[16 * texels * i + channel] = code; // modulo 256 by the array's type
    }
  }
  return new Uint32Array(bytes.buffer);
}

/** The whole scene, ready to be put into textures. */
export async function readScene(header, base64) {
  const planes = planesOf(await gunzip(fromBase64(base64)), header);
  const texels = Math.ceil((3 * (header.sh_degree + 1) ** 2) / 16);
  return {
    count: header.count,
    degree: header.sh_degree,
    texels,
    geometry: unpackGeometry(planes, header),
    lights: header.lights.map((_, index) => unpackLight(planes, header, index, texels)),
    range: header.colors,
  };
}
