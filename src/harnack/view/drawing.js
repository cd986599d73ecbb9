// Draws one traced surface on the visitor's GPU: rays of a camera, the kernel that Dr.Jit recorded
// as a shader, and light. No dependency; the page hands over what `harnack.view.page` has written.
// @ts-check

/** @typedef {{
 *   code: string, data: string, lanes: number[], results: Record<string, number>, count: number,
 *   center: number[], radius: number, front: number[], back: number[], tolerance: number,
 *   check: {lanes: string, status: string, t: string, normal: string, count: number}
 * }} Scene */

const STATUS = { MISS: 0, HIT: 1, OUT_OF_STEPS: 2 };
const TILE = 1 << 16;
const GROUP = 64;
// Milliseconds that a picture may take while the camera moves.
const QUICK = 40;
const SAMPLES = 16;

const PASSES = (/** @type {Scene} */ scene) => `
struct View {
  eye: vec4f, right: vec4f, up: vec4f, forward: vec4f,
  width: u32, height: u32, first: u32, count: u32,
  jitter: vec2f, weight: f32, dark: f32,
}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> lanes: array<f32>;
@group(0) @binding(2) var<storage, read> results: array<u32>;
@group(0) @binding(3) var<storage, read_write> picture: array<vec4f>;

fn direction(pixel: u32) -> vec3f {
  let place = vec2f(f32(pixel % view.width), f32(pixel / view.width)) + view.jitter;
  let size = vec2f(f32(view.width), f32(view.height));
  let across = (place - 0.5 * size) / min(size.x, size.y);
  return normalize(view.forward.xyz + across.x * view.right.xyz - across.y * view.up.xyz);
}

@compute @workgroup_size(${GROUP})
fn aim(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let d = direction(view.first + id.x);
  let values = array<f32, 6>(view.eye.x, view.eye.y, view.eye.z, d.x, d.y, d.z);
  let order = array<u32, 6>(${scene.lanes.map((k) => `${k}u`).join(", ")});
  for (var k = 0u; k < 6u; k++) { lanes[k * view.count + id.x] = values[order[k]]; }
}

fn result(k: u32, lane: u32) -> u32 { return results[k * view.count + lane]; }

@compute @workgroup_size(${GROUP})
fn light(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let pixel = view.first + id.x;
  let d = direction(pixel);
  let high = f32(pixel / view.width) / f32(view.height);
  var color = mix(vec3f(0.93, 0.94, 0.96), vec3f(0.78, 0.80, 0.84), high);
  if (view.dark > 0.5) { color = mix(vec3f(0.10, 0.11, 0.13), vec3f(0.04, 0.045, 0.05), high); }
  let status = result(${scene.results.status}u, id.x);
  if (status == ${STATUS.OUT_OF_STEPS}u) { color = vec3f(1.0, 0.0, 1.0); }
  if (status == ${STATUS.HIT}u) {
    let n = vec3f(
      bitcast<f32>(result(${scene.results["normal 0"]}u, id.x)),
      bitcast<f32>(result(${scene.results["normal 1"]}u, id.x)),
      bitcast<f32>(result(${scene.results["normal 2"]}u, id.x)),
    );
    let outside = dot(n, d) < 0.0;
    let facing = select(-n, n, outside);
    let base = select(vec3f(${scene.back.join(", ")}), vec3f(${scene.front.join(", ")}), outside);
    let key = normalize(view.up.xyz * 0.8 + view.right.xyz * 0.5 - view.forward.xyz * 0.7);
    let sky = 0.5 + 0.5 * dot(facing, vec3f(0.0, 0.0, 1.0));
    let lit = max(dot(facing, key), 0.0);
    let half_way = normalize(key - d);
    let shine = pow(max(dot(facing, half_way), 0.0), 60.0);
    let rim = pow(1.0 - abs(dot(facing, d)), 5.0);
    color = base * (0.25 + 0.35 * sky + 0.75 * lit) + vec3f(0.18 * shine + 0.12 * rim);
  }
  let linear = vec4f(color, 1.0) * view.weight;
  if (view.weight > 0.99) { picture[pixel] = linear; return; }
  picture[pixel] = picture[pixel] * (1.0 - view.weight) + linear;
}

@vertex
fn corner(@builtin(vertex_index) k: u32) -> @builtin(position) vec4f {
  return vec4f(f32(k & 1u) * 4.0 - 1.0, f32(k >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
struct Shown { width: u32, height: u32, across: f32, down: f32 }
@group(0) @binding(4) var<uniform> shown: Shown;
@group(0) @binding(5) var<storage, read> seen: array<vec4f>;
@fragment
fn show(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let x = min(u32(at.x * shown.across), shown.width - 1u);
  let y = min(u32(at.y * shown.down), shown.height - 1u);
  let color = seen[y * shown.width + x].rgb;
  return vec4f(pow(clamp(color, vec3f(0.0), vec3f(1.0)), vec3f(1.0 / 2.2)), 1.0);
}
`;

/** The 32-bit words of a text in base64. @param {string} text */
function words(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Uint32Array(bytes.buffer);
}

/** @param {number[]} a @param {number[]} b */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class Drawing {
  /** @param {GPUDevice} device @param {Scene} scene @param {HTMLCanvasElement} canvas */
  constructor(device, scene, canvas) {
    this.device = device;
    this.scene = scene;
    this.canvas = canvas;
    this.home = { azimuth: -50, elevation: 28, zoom: 1, across: 0, down: 0 };
    this.view = { ...this.home };
    this.scale = 0.25;
    this.turn = 0;
    this.context = /** @type {GPUCanvasContext} */ (canvas.getContext("webgpu"));
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device, format: this.format, alphaMode: "opaque" });
    const usage = GPUBufferUsage;
    const count = Object.keys(scene.results).length;
    this.data = this.buffer(words(scene.data), usage.STORAGE);
    this.lanes = this.buffer(24 * TILE, usage.STORAGE);
    this.results = this.buffer(4 * count * TILE, usage.STORAGE | usage.COPY_SRC);
    this.traced_with = { 0: this.data, 1: this.lanes, 2: this.results };
    this.camera = this.buffer(96, usage.UNIFORM);
    this.shown = this.buffer(16, usage.UNIFORM);
    this.picture = this.buffer(16, usage.STORAGE);
  }

  /** @param {Uint32Array | number} given @param {number} usage */
  buffer(given, usage) {
    const size = typeof given === "number" ? given : given.byteLength;
    const made = this.device.createBuffer({
      size: Math.max(16, size), usage: usage | GPUBufferUsage.COPY_DST,
    });
    if (typeof given !== "number") this.device.queue.writeBuffer(made, 0, given);
    return made;
  }

  async compile() {
    const device = this.device;
    const traced = device.createShaderModule({ code: this.scene.code });
    const passes = device.createShaderModule({ code: PASSES(this.scene) });
    const compute = (/** @type {GPUShaderModule} */ module, /** @type {string} */ entryPoint) =>
      device.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } });
    [this.trace, this.aim, this.light] = await Promise.all([
      compute(traced, "main"), compute(passes, "aim"), compute(passes, "light"),
    ]);
    this.show = await device.createRenderPipelineAsync({
      layout: "auto",
      vertex: { module: passes, entryPoint: "corner" },
      fragment: { module: passes, entryPoint: "show", targets: [{ format: this.format }] },
    });
  }

  /** @param {GPUComputePassEncoder} pass @param {any} pipeline
   *  @param {Record<number, GPUBuffer>} buffers @param {number} count */
  run(pass, pipeline, buffers, count) {
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: Object.entries(buffers).map(([binding, buffer]) => ({
        binding: Number(binding), resource: { buffer },
      })),
    }));
    pass.dispatchWorkgroups(Math.ceil(count / GROUP));
  }

  /** What the device says of the rays that came with the page, against what Dr.Jit said of them.
   *  Nothing, if they agree. */
  async check() {
    const { check, results, tolerance } = this.scene;
    const n = check.count;
    this.device.queue.writeBuffer(this.data, 0, new Uint32Array([n]));
    this.device.queue.writeBuffer(this.lanes, 0, words(check.lanes));
    const size = 4 * n * Object.keys(results).length;
    const back = this.device.createBuffer({
      size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST,
    });
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    this.run(pass, this.trace, this.traced_with, n);
    pass.end();
    encoder.copyBufferToBuffer(this.results, 0, back, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await back.mapAsync(GPUMapMode.READ);
    const bits = new Uint32Array(back.getMappedRange().slice(0));
    back.destroy();
    const numbers = new Float32Array(bits.buffer);
    const [status, t] = [words(check.status), new Float32Array(words(check.t).buffer)];
    const normal = new Float32Array(words(check.normal).buffer);
    const rays = new Float32Array(words(check.lanes).buffer);
    const order = this.scene.lanes;
    const at = (/** @type {number} */ k, /** @type {number} */ part) =>
      rays[order.indexOf(part) * n + k];
    let [other, far, hits] = [0, 0, 0];
    for (let k = 0; k < n; k++) {
      const found = bits[results.status * n + k];
      if (found !== status[k]) { other++; continue; }
      if (found !== STATUS.HIT) continue;
      hits++;
      const [d, m] = [[3, 4, 5].map((p) => at(k, p)), [0, 1, 2].map((p) => normal[p * n + k])];
      const climb = Math.max(Math.abs(dot(d, m)), 0.1);
      const off = Math.abs(numbers[results.t * n + k] - t[k]) * climb;
      const turned = Math.hypot(...[0, 1, 2].map(
        (p) => numbers[results[`normal ${p}`] * n + k] - m[p]));
      if (!(off <= 0.2 * tolerance + 8e-6 * (1 + t[k])) || !(turned < 2e-3 || climb <= 0.1)) far++;
    }
    if (other > 1e-3 * n) return `${other} of ${n} rays end otherwise`;
    if (far > 0.05 * hits) return `${far} of ${hits} hits lie elsewhere`;
    return "";
  }

  /** The camera, in coordinates of the surface. */
  pose() {
    const { azimuth, elevation, zoom, across, down } = this.view;
    const [a, e] = [azimuth, elevation].map((x) => (x * Math.PI) / 180);
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [
      back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
      back[0] * right[1] - back[1] * right[0],
    ];
    const slope = Math.tan((13 * Math.PI) / 180);
    const distance = (1.15 * this.scene.radius) / Math.sin((13 * Math.PI) / 180) / zoom;
    const move = this.scene.radius / zoom;
    const eye = this.scene.center.map(
      (c, k) => c + distance * back[k] - move * (across * right[k] - down * up[k]));
    return { eye, right: right.map((x) => 2 * slope * x), up: up.map((x) => 2 * slope * x),
             forward: back.map((x) => -x) };
  }

  /** Traces one picture, tile by tile, until the camera moves. @param {number} width
   *  @param {number} height @param {number[]} jitter @param {number} weight @param {number} turn */
  async traced(width, height, jitter, weight, turn) {
    const { eye, right, up, forward } = this.pose();
    const dark = matchMedia("(prefers-color-scheme: dark)").matches ? 1 : 0;
    for (let first = 0; first < width * height; first += TILE) {
      const count = Math.min(TILE, width * height - first);
      const view = new ArrayBuffer(96);
      new Float32Array(view).set([...eye, 0, ...right, 0, ...up, 0, ...forward, 0]);
      new Uint32Array(view, 64).set([width, height, first, count]);
      new Float32Array(view, 80).set([...jitter, weight, dark]);
      this.device.queue.writeBuffer(this.camera, 0, view);
      this.device.queue.writeBuffer(this.data, 0, new Uint32Array([count]));
      const encoder = this.device.createCommandEncoder();
      const pass = encoder.beginComputePass();
      this.run(pass, this.aim, { 0: this.camera, 1: this.lanes }, count);
      this.run(pass, this.trace, this.traced_with, count);
      this.run(pass, this.light, { 0: this.camera, 2: this.results, 3: this.picture }, count);
      pass.end();
      this.device.queue.submit([encoder.finish()]);
      await this.device.queue.onSubmittedWorkDone();
      if (turn !== this.turn && weight < 1) return false;
    }
    return true;
  }

  /** @param {number} width @param {number} height */
  present(width, height) {
    const { canvas } = this;
    const shown = new ArrayBuffer(16);
    new Uint32Array(shown).set([width, height]);
    new Float32Array(shown, 8).set([width / canvas.width, height / canvas.height]);
    this.device.queue.writeBuffer(this.shown, 0, shown);
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: [{
      view: this.context.getCurrentTexture().createView(), loadOp: "clear", storeOp: "store",
    }] });
    pass.setPipeline(/** @type {GPURenderPipeline} */ (this.show));
    pass.setBindGroup(0, this.device.createBindGroup({
      layout: /** @type {GPURenderPipeline} */ (this.show).getBindGroupLayout(0),
      entries: [{ binding: 4, resource: { buffer: this.shown } },
                { binding: 5, resource: { buffer: this.picture } }],
    }));
    pass.draw(3);
    pass.end();
    this.device.queue.submit([encoder.finish()]);
  }

  /** Room for a picture. @param {number} pixels */
  reserve(pixels) {
    if (this.picture.size >= 16 * pixels) return;
    this.picture.destroy();
    this.picture = this.buffer(16 * pixels, GPUBufferUsage.STORAGE);
  }

  /** Draws: coarsely while the camera moves, then at every pixel, then with many rays a pixel. */
  async draw() {
    const turn = ++this.turn;
    if (this.busy) return;
    this.busy = true;
    for (let now = turn, round = -1; ; ) {
      const scale = round < 0 ? this.scale : 1;
      const width = Math.max(8, Math.round(this.canvas.width * scale));
      const height = Math.max(8, Math.round(this.canvas.height * scale));
      this.reserve(width * height);
      const jitter = round < 1 ? [0.5, 0.5] : [(0.5 + round * 0.7549) % 1, (0.5 + round * 0.5698) % 1];
      const start = performance.now();
      const done = await this.traced(width, height, jitter, round < 1 ? 1 : 1 / (round + 1), now);
      if (done) this.present(width, height);
      if (round < 0) {
        const better = this.scale * Math.sqrt(QUICK / Math.max(performance.now() - start, 1));
        this.scale = Math.min(1, Math.max(0.06, 0.5 * (this.scale + better)));
      }
      if (now !== this.turn) { now = this.turn; round = -1; continue; }
      if (++round >= SAMPLES) break;
    }
    this.busy = false;
    this.canvas.dispatchEvent(new Event("rest"));
  }

  /** Mouse, touch and keys. */
  listen() {
    const { canvas } = this;
    /** @type {Map<number, PointerEvent>} */
    const down = new Map();
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      down.set(e.pointerId, e);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (e) => down.delete(/** @type {PointerEvent} */ (e).pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = down.get(e.pointerId);
      if (!before) return;
      const size = Math.min(canvas.clientWidth, canvas.clientHeight);
      const [x, y] = [(e.clientX - before.clientX) / size, (e.clientY - before.clientY) / size];
      if (down.size === 2) {
        const [one, two] = [...down.values()].filter((p) => p.pointerId !== e.pointerId).concat(e);
        const length = Math.hypot(one.clientX - two.clientX, one.clientY - two.clientY);
        const was = Math.hypot(one.clientX - before.clientX, one.clientY - before.clientY);
        this.zoom(length / Math.max(was, 1));
      } else if (e.shiftKey || before.button === 2) {
        this.view.across += 2.3 * x;
        this.view.down += 2.3 * y;
      } else this.orbit(-220 * x, 220 * y);
      down.set(e.pointerId, e);
      this.draw();
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(-0.0015 * e.deltaY));
      this.draw();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.view = { ...this.home }; this.draw(); });
    canvas.addEventListener("keydown", (e) => {
      const move = /** @type {Record<string, () => void>} */ ({
        ArrowLeft: () => this.orbit(-5, 0), ArrowRight: () => this.orbit(5, 0),
        ArrowUp: () => this.orbit(0, 5), ArrowDown: () => this.orbit(0, -5),
        "+": () => this.zoom(1.1), "-": () => this.zoom(1 / 1.1),
        Home: () => { this.view = { ...this.home }; },
      })[e.key];
      if (!move) return;
      e.preventDefault();
      move();
      this.draw();
    });
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** @param {number} azimuth @param {number} elevation */
  orbit(azimuth, elevation) {
    this.view.azimuth += azimuth;
    this.view.elevation = Math.max(-89.9, Math.min(89.9, this.view.elevation + elevation));
  }

  /** @param {number} factor */
  zoom(factor) { this.view.zoom = Math.max(0.2, Math.min(50, this.view.zoom * factor)); }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = Math.max(16, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(16, Math.round(this.canvas.clientHeight * ratio));
    this.draw();
  }
}

/** Draws a scene on a canvas; says in words what it does. @param {Scene} scene
 *  @param {HTMLCanvasElement} canvas @param {(words: string, isDrawn?: boolean) => void} say */
export async function open(scene, canvas, say) {
  if (!navigator.gpu) return say("This browser has no WebGPU here (the page must come from https, "
    + "or from 127.0.0.1): this is a still picture.");
  const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) return say("No GPU was found for WebGPU: this is a still picture.");
  const most = adapter.limits.maxStorageBufferBindingSize;
  const device = await adapter.requestDevice({ requiredLimits: {
    maxStorageBufferBindingSize: most, maxBufferSize: adapter.limits.maxBufferSize } });
  device.lost.then((e) => say(`The GPU was lost: ${e.message}`, false));
  say("Compiling the surface for this GPU ...");
  const drawing = new Drawing(device, scene, canvas);
  try {
    await drawing.compile();
  } catch (wrong) {
    return say(`This GPU cannot compile the surface (${wrong}): this is a still picture.`);
  }
  const wrong = await drawing.check();
  if (wrong) return say("This GPU does not compute what the surface was proved with: "
    + `${wrong}. This is a still picture.`);
  say("", true);
  drawing.listen();
  drawing.resize();
  return drawing;
}
