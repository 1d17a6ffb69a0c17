// Reads an EXR file with three.js' EXRLoader and writes its red channel as raw float32, rows as the loader gives them.
// node read_exr.mjs FILE.exr OUT.f32
import { readFileSync, writeFileSync } from 'node:fs';
import { FloatType } from 'three';
import { EXRLoader } from 'three/examples/jsm/loaders/EXRLoader.js';

const bytes = readFileSync(process.argv[2]);
const loader = new EXRLoader();
loader.setDataType(FloatType);
const image = loader.parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
const channels = image.data.length / (image.width * image.height);
const heights = new Float32Array(image.width * image.height);
for (let n = 0; n < heights.length; n++) heights[n] = image.data[n * channels];
writeFileSync(process.argv[3], Buffer.from(heights.buffer));
console.log(JSON.stringify({ width: image.width, height: image.height, channels }));
