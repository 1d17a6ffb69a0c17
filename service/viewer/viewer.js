// The viewer: asks POST /view which tiles to draw, fetches their f32 heights and draws them with computed normals.
// Scene axes: x east, y up, z south, metres on the layer's plane, from the middle of the data.
import * as THREE from './vendor/three.module.min.js';

const $ = (id) => document.getElementById(id);
const query = new URLSearchParams(location.search);
const canvas = $('canvas');
const renderer = new THREE.WebGLRenderer({canvas, antialias: true, preserveDrawingBuffer: query.has('keep')});
const scene = new THREE.Scene();
const sky = new THREE.Color(0xa9c4d9);
scene.background = sky;
const camera = new THREE.PerspectiveCamera(60, 1, 1, 1e6);
camera.rotation.order = 'YXZ';
scene.add(new THREE.HemisphereLight(0xdfefff, 0x6b6455, 1.4));
const sun = new THREE.DirectionalLight(0xfff2dd, 2.4);
sun.position.set(-1, 1.1, -1);
scene.add(sun);
const material = new THREE.MeshLambertMaterial({vertexColors: true});

let layer = null;      // description of /layers/{layer}
let middle = [0, 0];   // base post under the scene's origin
let speed = 300;       // metres a second
let wanted = new Map();  // tiles of the last answer, by address
const meshes = new Map();
const loading = new Map();
let generation = 0;    // grows when layer, recipe, seed or mesh change
const stats = {culled: {}, view_ms: 0, bytes: 0, failed: 0};

const ramp = [[0, [96, 128, 80]], [0.3, [142, 158, 98]], [0.55, [176, 160, 118]], [0.8, [150, 132, 116]], [1, [240, 240, 240]]];
function colour(height, slope) {
  const t = Math.min(1, Math.max(0, (height - layer.height_min_m) / Math.max(1, layer.height_max_m - layer.height_min_m)));
  const n = Math.max(1, ramp.findIndex(([at]) => at >= t));
  const [a, b] = [ramp[n - 1], ramp[n]];
  const u = (t - a[0]) / (b[0] - a[0]);
  const rock = Math.min(1, Math.max(0, (slope - 0.5) * 1.6));
  return [0, 1, 2].map((c) => (((a[1][c] + u * (b[1][c] - a[1][c])) * (1 - rock) + [122, 112, 104][c] * rock) / 255) ** 2.2);
}

function tile_mesh(id, heights) {
  const posts = layer.posts_per_tile, step = Math.min(Number($('step').value), posts - 1);
  const scale = 2 ** (layer.base_level - id.z), dx = layer.cell_m[0] * scale, dy = layer.cell_m[1] * scale;
  // The part that holds data, in posts of the tile.
  const [i0, j0] = layer.first_post;
  const last = (first, count, at) => Math.max(1, Math.min(posts - 1, Math.ceil((first + count - 1) / scale) - at * (posts - 1)));
  const right = last(i0, layer.width_posts, id.x), bottom = last(j0, layer.height_posts, id.y);
  const line = (end) => { const out = []; for (let n = 0; n < end; n += step) out.push(n); out.push(end); return out; };
  const columns = line(right), rows = line(bottom);
  const position = [], normal = [], colours = [], index = [];
  const at = (c, r) => heights[Math.min(bottom, Math.max(0, r)) * posts + Math.min(right, Math.max(0, c))];
  const add = (c, r, drop) => {
    const gx = (at(c + 1, r) - at(c - 1, r)) / (2 * dx), gz = (at(c, r + 1) - at(c, r - 1)) / (2 * dy);
    const length = Math.hypot(gx, 1, gz);
    position.push(((id.x * (posts - 1) + c) * scale - middle[0]) * layer.cell_m[0], at(c, r) - drop, ((id.y * (posts - 1) + r) * scale - middle[1]) * layer.cell_m[1]);
    normal.push(-gx / length, 1 / length, -gz / length);
    colours.push(...colour(at(c, r), Math.hypot(gx, gz)));
    return position.length / 3 - 1;
  };
  for (const r of rows) for (const c of columns) add(c, r, 0);
  const w = columns.length, h = rows.length;
  for (let r = 0; r + 1 < h; ++r) for (let c = 0; c + 1 < w; ++c) {
    const a = r * w + c;
    index.push(a, a + w, a + 1, a + 1, a + w, a + w + 1);
  }
  // Skirts hide what tiles of different levels leave open between them.
  const skirt = 4 * step * Math.max(dx, dy);
  const border = [...columns.map((c) => [c, 0]), ...rows.slice(1).map((r) => [right, r]), ...columns.slice(0, -1).reverse().map((c) => [c, bottom]), ...rows.slice(0, -1).reverse().map((r) => [0, r])];
  const of = ([c, r]) => rows.indexOf(r) * w + columns.indexOf(c);
  let above = of(border[0]), below = add(...border[0], skirt);
  for (const place of border.slice(1)) {
    const next = of(place), under = add(...place, skirt);
    index.push(above, next, below, below, next, under);
    above = next;
    below = under;
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(position), 3));
  geometry.setAttribute('normal', new THREE.BufferAttribute(new Float32Array(normal), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(colours), 3));
  geometry.setIndex(index);
  return new THREE.Mesh(geometry, material);
}

function drop(name) {
  const mesh = meshes.get(name);
  scene.remove(mesh);
  mesh.geometry.dispose();
  meshes.delete(name);
}

function forget_all() {
  ++generation;
  for (const stop of loading.values()) stop.abort();
  loading.clear();
  for (const name of [...meshes.keys()]) drop(name);
}

// Old tiles stay until all of the new ones are there, so that no hole opens.
function sweep() {
  if (loading.size > 0) return;
  for (const name of [...meshes.keys()]) if (!wanted.has(name)) drop(name);
}

async function load(name, tile) {
  const mine = generation, stop = new AbortController();
  loading.set(name, stop);
  try {
    const reply = await fetch(`/tiles/${layer.name}/${$('recipe').value}/${name}.f32?seed=${$('seed').value || 0}&v=${layer.revision}`, {signal: stop.signal});
    if (!reply.ok) throw new Error(`${name}: ${reply.status}`);
    const bytes = await reply.arrayBuffer();
    if (mine !== generation) return;
    stats.bytes += bytes.byteLength;
    const mesh = tile_mesh(tile, new Float32Array(bytes));
    meshes.set(name, mesh);
    scene.add(mesh);
  } catch (error) {
    if (error.name !== 'AbortError') ++stats.failed;
  } finally {
    if (loading.get(name) === stop) loading.delete(name);
    pump();
    sweep();
  }
}

function pump() {
  for (const [name, tile] of wanted) {
    if (loading.size >= 6) break;
    if (!meshes.has(name) && !loading.has(name)) {
      if (tile.tried) continue;
      tile.tried = true;
      load(name, tile);
    }
  }
}

function world(x, z) {
  const t = layer.transform, i = middle[0] + x / layer.cell_m[0], j = middle[1] + z / layer.cell_m[1];
  return [t[0] + i * t[1] + j * t[2], t[3] + i * t[4] + j * t[5]];
}

let is_asking = false, asked = '';
async function ask() {
  if (!layer || is_asking) return;
  const look = new THREE.Vector3();
  camera.getWorldDirection(look);
  const p = camera.position, ahead = p.clone().addScaledVector(look, 1000);
  const pixel = renderer.getPixelRatio();
  const body = JSON.stringify({crs: 'layer', eye: [...world(p.x, p.z), p.y], target: [...world(ahead.x, ahead.z), ahead.y], fov_y_deg: camera.fov,
    viewport: [Math.max(1, canvas.clientWidth * pixel), Math.max(1, canvas.clientHeight * pixel)], max_error_px: Number($('error').value), max_iterations: 12});
  const key = generation + body;
  if (key === asked) return;
  is_asking = true;
  const mine = generation;
  try {
    const start = performance.now();
    const reply = await fetch(`/view/${layer.name}/${$('recipe').value}`, {method: 'POST', body});
    const answer = await reply.json();
    if (mine !== generation) return;
    asked = key;
    stats.view_ms = performance.now() - start;
    if (!reply.ok) {
      stats.note = answer.detail;
      return;
    }
    stats.note = '';
    stats.culled = answer.culled;
    wanted = new Map(answer.tiles.map((tile) => [`${tile.z}/${tile.x}/${tile.y}`, tile]));
    for (const [name, stop] of loading) if (!wanted.has(name)) { stop.abort(); loading.delete(name); }
    pump();
    sweep();
  } catch (error) {
    stats.note = String(error);
  } finally {
    is_asking = false;
  }
}

const pressed = new Set();
addEventListener('keydown', (e) => { if (e.target.tagName !== 'INPUT') pressed.add(e.code); });
addEventListener('keyup', (e) => pressed.delete(e.code));
addEventListener('blur', () => pressed.clear());
canvas.addEventListener('pointerdown', (e) => canvas.setPointerCapture(e.pointerId));
canvas.addEventListener('pointermove', (e) => {
  if (e.buttons === 0) return;
  camera.rotation.y += e.movementX * 0.003;
  camera.rotation.x = Math.max(-1.55, Math.min(1.55, camera.rotation.x + e.movementY * 0.003));
});
canvas.addEventListener('wheel', (e) => { speed = Math.min(20000, Math.max(1, speed * Math.exp(-e.deltaY * 0.001))); }, {passive: true});
$('panel').addEventListener('submit', (e) => e.preventDefault());

let before = performance.now();
function frame(now) {
  const dt = Math.min(0.1, (now - before) / 1000);
  before = now;
  const pixel = Math.min(2, devicePixelRatio), w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.floor(w * pixel) || canvas.height !== Math.floor(h * pixel)) {
    renderer.setPixelRatio(pixel);
    renderer.setSize(w, h, false);
    camera.aspect = w / h;
  }
  const look = new THREE.Vector3();
  camera.getWorldDirection(look);
  const side = new THREE.Vector3(-look.z, 0, look.x).normalize();
  const go = (code, axis, sign) => { if (pressed.has(code)) camera.position.addScaledVector(axis, sign * speed * dt); };
  const up = new THREE.Vector3(0, 1, 0);
  go('KeyW', look, 1); go('KeyS', look, -1); go('KeyD', side, 1); go('KeyA', side, -1); go('KeyE', up, 1); go('KeyQ', up, -1);
  camera.near = Math.max(0.05, (camera.position.y - (layer ? layer.height_max_m : 0)) * 0.1);
  camera.updateProjectionMatrix();
  material.wireframe = $('wire').checked;
  $('error_text').textContent = `${$('error').value} px`;
  renderer.render(scene, camera);
  $('stats').textContent = `tiles ${meshes.size} drawn, ${loading.size} loading\nanswer ${wanted.size} in ${stats.view_ms.toFixed(1)} ms\n` +
    `culled ${stats.culled.frustum ?? 0} frustum, ${stats.culled.facing ?? 0} facing\n${(stats.bytes / 1e6).toFixed(1)} MB, ${renderer.info.render.triangles} triangles\n` +
    `height ${camera.position.y.toFixed(0)} m, ${speed.toFixed(0)} m/s${stats.failed ? `\n${stats.failed} failed` : ''}${stats.note ? `\n${stats.note}` : ''}`;
  document.body.dataset.drawn = meshes.size > 0 && loading.size === 0 ? meshes.size : 0;
  requestAnimationFrame(frame);
}

function options(id, names, chosen) {
  $(id).replaceChildren(...names.map((name) => Object.assign(document.createElement('option'), {value: name, textContent: name, selected: name === chosen})));
}

async function open_layer(name) {
  layer = await (await fetch(`/layers/${encodeURIComponent(name)}`)).json();
  options('recipe', layer.recipes.map((r) => r.name), query.get('recipe') ?? 'lsa');
  forget_all();
  middle = [layer.first_post[0] + (layer.width_posts - 1) / 2, layer.first_post[1] + (layer.height_posts - 1) / 2];
  const wide = layer.width_posts * layer.cell_m[0], high = layer.height_posts * layer.cell_m[1];
  camera.position.set(0, layer.height_max_m + Math.max(wide, high) * 0.06, high * 0.42);
  camera.rotation.set(-0.32, 0, 0);
  camera.far = 4 * Math.hypot(wide, high);
  scene.fog = new THREE.Fog(sky, 0.5 * high, 2 * Math.max(wide, high));
  speed = Math.max(wide, high) / 60;
}

for (const id of ['recipe', 'seed', 'step']) $(id).addEventListener('change', forget_all);
$('layer').addEventListener('change', () => open_layer($('layer').value));
if (query.has('seed')) $('seed').value = query.get('seed');
if (query.has('step')) $('step').value = query.get('step');
if (query.has('error')) $('error').value = query.get('error');
requestAnimationFrame(frame);
const names = (await (await fetch('/layers')).json()).layers.map((one) => one.name);
options('layer', names, query.get('layer'));
if (names.length > 0) await open_layer($('layer').value);
else stats.note = 'no layers yet';
setInterval(ask, 250);
