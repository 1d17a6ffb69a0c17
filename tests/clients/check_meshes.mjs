// node check_meshes.mjs glb FOLDER: the Khronos validator must find nothing in any .glb of the folder.
// node check_meshes.mjs terrain FOLDER: HERE's decoder must read each .terrain exactly as the .txt beside it says.
// Prints one line per fault; exit status 1 when there is any.
import fs from "node:fs";
import path from "node:path";
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const [kind, folder] = process.argv.slice(2);
const files = fs.readdirSync(folder).filter((f) => f.endsWith("." + kind)).sort();
let faults = 0;
const fault = (...words) => {
  faults += 1;
  console.log(...words);
};

async function checkGlb(file) {
  const report = await require("gltf-validator").validateBytes(new Uint8Array(fs.readFileSync(path.join(folder, file))));
  // Texture coordinates are there for the texture that the viewer brings along.
  const isForViewer = (m) => m.code === "UNUSED_OBJECT" && m.pointer.endsWith("/attributes/TEXCOORD_0");
  for (const m of report.issues.messages.filter((m) => !isForViewer(m))) fault(file, m.code, m.message, m.pointer ?? "");
  if (report.info.totalTriangleCount === 0) fault(file, "no triangles");
}

function checkTerrain(file, decode) {
  const bytes = fs.readFileSync(path.join(folder, file));
  const mesh = decode(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
  const lines = fs.readFileSync(path.join(folder, file.replace(".terrain", ".txt")), "utf8").trim().split("\n");
  const [vertices, triangles] = lines[0].split(" ").map(Number);
  const seen = [];
  const n = mesh.vertexData.length / 3;
  seen.push(`${n} ${mesh.triangleIndices.length / 3}`);
  for (let i = 0; i < n; i++) seen.push(`${mesh.vertexData[i]} ${mesh.vertexData[n + i]} ${mesh.vertexData[2 * n + i]}`);
  for (const i of mesh.triangleIndices) seen.push(`${i}`);
  for (const side of [mesh.westIndices, mesh.southIndices, mesh.eastIndices, mesh.northIndices]) seen.push([side.length, ...side].join(" "));
  if (seen.length !== lines.length) fault(file, `${seen.length} lines seen, ${lines.length} expected`);
  const wrong = seen.findIndex((line, k) => line !== lines[k]);
  if (wrong >= 0) fault(file, `line ${wrong}: "${seen[wrong]}" seen, "${lines[wrong]}" expected`);
  const k = Number(file.split(".")[0]);
  if (Boolean(k & 1) !== (mesh.extensions?.vertexNormals?.length === 2 * vertices)) fault(file, "normals");
  if (Boolean(k & 2) !== Boolean(mesh.extensions?.waterMask)) fault(file, "water mask");
  if (Boolean(k & 4) !== (mesh.extensions?.metadata?.geometricerror !== undefined)) fault(file, "metadata");
  if (triangles === 0) fault(file, "no triangles");
}

if (kind === "glb") {
  for (const file of files) await checkGlb(file);
} else {
  const module = await import("@here/quantized-mesh-decoder");
  const decode = module.default?.default ?? module.default;
  for (const file of files) checkTerrain(file, decode);
}
console.log(`${files.length} files, ${faults} faults`);
process.exit(faults === 0 && files.length > 0 ? 0 : 1);
