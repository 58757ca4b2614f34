// Bundles the page's viewer into the Python package: `npm ci && npm run build` in this folder.

import { mkdir, readFile, readdir, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "src", "wildgs", "exporters", "web");
const BUNDLED = ["@sparkjsdev/spark", "three", "fflate"];

async function licenseOf(name) {
  const folder = join(here, "node_modules", name);
  const { version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  const file = (await readdir(folder)).find((entry) => /^licen[cs]e/i.test(entry));
  const text = (await readFile(join(folder, file), "utf8")).trim();
  return `${name} ${version} (${license})\n\n${text}\n`;
}

const result = await build({
  entryPoints: [join(here, "src", "main.js")],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  legalComments: "none", // the licences stand whole in LICENSES.txt, which every page carries
  write: false,
  metafile: true,
  logLevel: "info",
});

// What is in the bundle must be what LICENSES.txt names.
const found = new Set();
for (const [input, { bytesInOutput }] of Object.entries(Object.values(result.metafile.outputs)[0].inputs)) {
  const match = /node_modules\/((?:@[^/]+\/)?[^/]+)/.exec(input);
  if (match && bytesInOutput > 0) found.add(match[1]);
}
for (const name of found) {
  if (!BUNDLED.includes(name)) throw new Error(`${name} is bundled, but its licence is not listed`);
}

await mkdir(target, { recursive: true });
const licenses = await Promise.all(BUNDLED.map(licenseOf));
await writeFile(join(target, "LICENSES.txt"), licenses.join(`\n${"-".repeat(72)}\n\n`));
// The gzip header's time and system would make every build differ.
const packed = gzipSync(result.outputFiles[0].contents, { level: 9 });
packed.fill(0, 4, 8);
packed[9] = 255;
await writeFile(join(target, "viewer.js.gz"), packed);
console.log(`viewer.js.gz: ${(packed.length / 1e6).toFixed(2)} MB, of ${[...found].join(", ")}`);
