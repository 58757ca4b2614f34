// Validates a .glb with Khronos's validator. It does not know KHR_gaussian_splatting, so that it rejects the names of
// its attributes; under names of application-specific attributes (_NAME) it checks them like any others.

import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const PREFIX = "KHR_gaussian_splatting:";

function renamed(bytes) {
  const length = bytes.readUInt32LE(12);
  const content = JSON.parse(bytes.subarray(20, 20 + length));
  for (const { primitives } of content.meshes) {
    for (const primitive of primitives) {
      const entries = Object.entries(primitive.attributes);
      primitive.attributes = Object.fromEntries(entries.map(([key, value]) => [key.replace(PREFIX, "_"), value]));
    }
  }
  const text = Buffer.from(JSON.stringify(content));
  const padded = Buffer.concat([text, Buffer.alloc(-text.length & 3, " ")]);
  const head = Buffer.from(bytes.subarray(0, 20));
  const rest = bytes.subarray(20 + length);
  head.writeUInt32LE(20 + padded.length + rest.length, 8);
  head.writeUInt32LE(padded.length, 12);
  return Buffer.concat([head, padded, rest]);
}

const bytes = await readFile(process.argv[2]);
for (const [name, content] of [["as it is", bytes], ["attributes as _NAME", renamed(bytes)]]) {
  const { issues } = await validator.validateBytes(new Uint8Array(content), { maxIssues: 0 });
  const codes = {};
  for (const { code } of issues.messages) codes[code] = (codes[code] ?? 0) + 1;
  console.log(`glTF validator, ${name}: ${issues.numErrors} errors, ${issues.numWarnings} warnings`, codes);
}
