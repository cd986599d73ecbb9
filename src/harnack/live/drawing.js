// Draws traced surfaces on the visitor's GPU: rays of a camera, the kernels that Dr.Jit recorded as
// shaders, and the light of shaded pictures. No dependency: what is drawn comes from
// `harnack.live.live_scene`, what is done around the kernels is in passes.wgsl.
// @ts-check

import { Camera, dot } from "./camera.js";

/** @import {Pose} from "./camera.js" */
/** @import {Legend} from "./legend.js" */
/** @typedef {{lanes: string, results: string, count: number}} Check */
/** @typedef {{
 *   key: string, code: string, data: string | Uint32Array, lanes: number[], results: number[],
 *   paints: {front: number[], back: number[], glossy: boolean}[], tolerance: number, check?: Check
 * }} Surface */
/** @typedef {{surfaces: Surface[], curves: number[][][]}} State */
/** @typedef {{name: string, low: number, high: number, start: number, step: number | null}} Slider */
/** @typedef {{
 *   title: string, placement: number[], camera: Pose, floor: number, show: string,
 *   ground: number[], sliders: Slider[], editable: boolean, middle: number[], reach: number,
 *   materials: string[], material: string | null, tube: number | null,
 *   legends: Record<string, Legend>, evaluations_top: number, state: State
 * }} Scene */
/** @typedef {{points: number[][], color: number[], width: number}} Marks */

const STATUS = { MISS: 0, HIT: 1, OUT_OF_STEPS: 2 };
export const SHOWS = ["shaded", "normal", "depth", "evaluations", "status"];
// Rays that are traced at once, at most, and milliseconds that they should take.
const TILE = 1 << 17;
const TILE_TIME = 60;
// Milliseconds that a picture may take while something moves.
export const FRAME_TIME = 40;
const SAMPLES = 16;
const GROUP = 64;
// What other roundings explain: see `harnack.tracer.hits`.
const [GRAZING, OTHER_STATUS, OTHER_DISTANCE, OTHER_NORMAL, OTHER_EVALUATIONS] = [0.1, 1e-3, 0.1, 2e-4, 0.03];
const VIEW_BYTES = 176;
// What passes.wgsl has room for beside a pixel.
const PAINTS = 2048;
// Of the floor's light: see `harnack.rendering.shading`.
const [CELLS, RAYS, BLOCK, SPREAD] = [64, 8, 4, 0.34];
const BLUR = [0.025, 0.125, 0.225, 0.25, 0.225, 0.125, 0.025];

/** The 32-bit words of a text, as `packed` of harnack.live.live_scene writes it; words as they are.
 *  @param {string | Uint32Array} text @returns {Promise<Uint32Array>} */
export async function words(text) {
  if (typeof text !== "string") return text;
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const unzipped = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint32Array(await new Response(unzipped).arrayBuffer());
}

/** Places in the unit square, spread evenly (Roberts 2018), as `floor._square` has them. */
function sample_square() {
  const plastic = 1.32471795724474602596;
  const count = BLOCK * BLOCK;
  /** @type {number[][]} */
  const places = [];
  for (let block = 0; block < count; block++)
    for (let ray = 0; ray < RAYS; ray++) {
      const k = ray * count + block;
      places.push([(0.5 + k / plastic) % 1, (0.5 + k / plastic ** 2) % 1]);
    }
  return places;
}

export class Drawing {
  /** @param {GPUDevice} device @param {Scene} scene @param {HTMLCanvasElement} canvas
   *  @param {string} passes */
  constructor(device, scene, canvas, passes) {
    this.device = device;
    this.scene = scene;
    this.canvas = canvas;
    this.camera = new Camera(scene.camera);
    this.ground = scene.ground;
    this.show = "shaded";
    /** The least and the greatest depth that is seen, once it is known.
     *  @type {[number, number] | null} */
    this.depth_range = null;
    /** @type {Marks[]} */
    this.lines = [];
    /** @type {Marks[]} */
    this.dots = [];
    this.scale = 0.25;
    this.tile = 1 << 14;
    this.generation = 0;
    this.pictures = 0;
    // Rays of a pixel when nothing moves.
    this.samples = SAMPLES;
    this.can_abort = 0;
    this.stopped = false;
    // Pixels that are traced in a millisecond.
    this.rate = 0;
    this.passes = passes;
    /** @type {Map<string, Promise<GPUComputePipeline>>} */
    this.pipelines_by_key = new Map();
    /** @type {any} */
    this.pipelines = {};
    /** @type {any[]} */
    this.surfaces = [];
    /** The last change of surfaces. @type {Promise<any>} */
    this.setting = Promise.resolve();
    this.context = /** @type {GPUCanvasContext} */ (canvas.getContext("webgpu"));
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device, format: this.format, alphaMode: "opaque" });
    const { STORAGE, UNIFORM, COPY_SRC } = GPUBufferUsage;
    this.view = this.buffer(VIEW_BYTES, UNIFORM);
    this.overlay = this.buffer(VIEW_BYTES, UNIFORM);
    this.lanes = this.buffer(28 * TILE, STORAGE);
    this.results = this.buffer(28 * TILE, STORAGE | COPY_SRC);
    this.light_directions = this.buffer(32 * BLOCK * BLOCK * RAYS, STORAGE);
    this.occluded = this.buffer(8 * CELLS * CELLS * RAYS, STORAGE | COPY_SRC);
    this.floor = this.buffer(new Float32Array(2 * CELLS * CELLS).fill(1), STORAGE);
    this.paints = this.buffer(32 * PAINTS, STORAGE);
    this.marks = this.buffer(32, STORAGE);
    this.max_pixels = Math.floor(device.limits.maxStorageBufferBindingSize / 32);
    this.reserve(1024);
  }

  /** @param {ArrayBufferView | number} given @param {number} usage */
  buffer(given, usage) {
    const size = typeof given === "number" ? given : given.byteLength;
    const made = this.device.createBuffer({
      size: Math.max(32, size), usage: usage | GPUBufferUsage.COPY_DST,
    });
    if (typeof given !== "number") this.device.queue.writeBuffer(made, 0, /** @type {any} */ (given));
    return made;
  }

  /** Room for a picture. @param {number} pixels */
  reserve(pixels) {
    if (this.hits && this.hits.size >= 32 * pixels) return;
    for (const one of [this.hits, this.sky_visibility, this.picture]) one?.destroy();
    this.hits = this.buffer(32 * pixels, GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC);
    this.sky_visibility = this.buffer(4 * pixels, GPUBufferUsage.STORAGE);
    this.picture = this.buffer(16 * pixels, GPUBufferUsage.STORAGE);
  }

  async compile() {
    const { device, format } = this;
    const module = device.createShaderModule({ code: this.passes });
    const names = ["camera_rays", "clear_hits", "merge_hits", "estimate_sky", "shade", "floor_rays", "merge_floor_hits"];
    const made = await Promise.all(names.map((entryPoint) =>
      device.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } })));
    names.forEach((name, k) => { this.pipelines[name] = made[k]; });
    const blend = /** @type {GPUBlendState} */ ({
      color: { srcFactor: "src-alpha", dstFactor: "one-minus-src-alpha" }, alpha: {},
    });
    const drawn = (/** @type {string} */ vertex, /** @type {string} */ fragment) =>
      device.createRenderPipelineAsync({
        layout: "auto", vertex: { module, entryPoint: vertex },
        fragment: { module, entryPoint: fragment,
                    targets: [fragment === "display" ? { format } : { format, blend }] },
      });
    [this.pipelines.display, this.pipelines.line, this.pipelines.dot] = await Promise.all(
      [drawn("full_screen", "display"), drawn("line", "mark"), drawn("dot_at", "mark")]);
  }

  /** The pipeline of a kernel, compiled once. @param {Surface} surface */
  pipeline_of(surface) {
    const found = this.pipelines_by_key.get(surface.key);
    if (found) return found;
    const module = this.device.createShaderModule({ code: surface.code });
    const made = this.device.createComputePipelineAsync({
      layout: "auto", compute: { module, entryPoint: "main" },
    });
    this.pipelines_by_key.set(surface.key, made);
    return made;
  }

  /** Draws other surfaces from now on, one change after the other; not those with which something is
   *  wrong on this device: what, if anything.
   *  @param {State} state @param {boolean} [checks] @returns {Promise<string>} */
  set(state, checks = true) {
    const made = this.setting.then(() => this.replace(state, checks));
    this.setting = made.catch(() => "");
    return made;
  }

  /** @param {State} state @param {boolean} checks */
  async replace(state, checks) {
    const made = await Promise.all(state.surfaces.map((one) => this.pipeline_of(one)));
    const data = await Promise.all(state.surfaces.map((one) => words(one.data)));
    let paints = 0;
    const next = state.surfaces.map((given, k) => {
      const numbers = new Uint32Array(20);
      numbers.set(given.lanes, 0);
      numbers.set(given.results, 8);
      numbers.set([paints, given.lanes.length], 16);
      paints += given.paints.length;
      return { given, trace: made[k], data: this.buffer(data[k], GPUBufferUsage.STORAGE),
               numbers: this.buffer(numbers, GPUBufferUsage.UNIFORM) };
    });
    let wrong = "";
    if (checks) for (const one of next) wrong ||= await this.check(one);
    const old = wrong ? next : this.surfaces;
    if (!wrong) {
      const colors = new Float32Array(8 * PAINTS);
      colors.set(state.surfaces.flatMap((one) => one.paints).slice(0, PAINTS).flatMap(
        ({ front, back, glossy }) => [...front, glossy ? 1 : 0, ...back, glossy ? 1 : 0]));
      this.device.queue.writeBuffer(this.paints, 0, colors);
      this.surfaces = next;
    }
    for (const one of old) { one.data.destroy(); one.numbers.destroy(); }
    return wrong;
  }

  /** @param {GPUComputePassEncoder} pass @param {GPUComputePipeline} pipeline
   *  @param {Record<number, GPUBuffer>} buffers @param {number} count */
  run(pass, pipeline, buffers, count) {
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.bind_group(pipeline, buffers));
    pass.dispatchWorkgroups(Math.ceil(count / GROUP));
  }

  /** @param {GPUComputePipeline | GPURenderPipeline} pipeline
   *  @param {Record<number, GPUBuffer>} buffers */
  bind_group(pipeline, buffers) {
    return this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: Object.entries(buffers).map(([binding, buffer]) => ({
        binding: Number(binding), resource: { buffer },
      })),
    });
  }

  /** @param {GPUBuffer} buffer @param {number} size */
  async read(buffer, size) {
    const back = this.device.createBuffer({
      size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST,
    });
    const encoder = this.device.createCommandEncoder();
    encoder.copyBufferToBuffer(buffer, 0, back, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await back.mapAsync(GPUMapMode.READ);
    const found = new Uint32Array(back.getMappedRange().slice(0));
    back.destroy();
    return found;
  }

  /** What the device says of the rays that came with a surface, against what Dr.Jit said of them.
   *  Nothing, if they agree. @param {any} surface */
  async check(surface) {
    const { check, results, tolerance, lanes } = /** @type {Surface} */ (surface.given);
    if (!check) return "";
    const n = check.count;
    const [asked, expected] = await Promise.all([words(check.lanes), words(check.results)]);
    this.device.queue.writeBuffer(surface.data, 0, new Uint32Array([n]));
    this.device.queue.writeBuffer(this.lanes, 0, /** @type {any} */ (asked));
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    this.run(pass, surface.trace, { 0: surface.data, 1: this.lanes, 2: this.results }, n);
    pass.end();
    this.device.queue.submit([encoder.finish()]);
    const bits = await this.read(this.results, 28 * n);
    const numbers = new Float32Array(bits.buffer);
    const [wanted, rays] = [new Float32Array(expected.buffer), new Float32Array(asked.buffer)];
    const at = (/** @type {number} */ k, /** @type {number} */ part) => rays[lanes.indexOf(part) * n + k];
    // The criteria are those of `harnack.tracer.hits`, with what was measured there.
    let [other, stray, evaluation_sum, evaluation_difference] = [0, 0, 0, 0];
    /** @type {number[][]} */
    const [off, turned] = [[], []];
    for (let k = 0; k < n; k++) {
      const [found, evaluations] = [bits[results[0] * n + k], bits[results[5] * n + k]];
      const expected_evaluations = expected[5 * n + k];
      [evaluation_sum, evaluation_difference] = [evaluation_sum + expected_evaluations, evaluation_difference + Math.abs(evaluations - expected_evaluations)];
      const normal = [2, 3, 4].map((p) => wanted[p * n + k]);
      const climb = Math.abs(dot([3, 4, 5].map((p) => at(k, p)), normal));
      if (found !== expected[k]) {
        other++;
        const grazes = Math.max(found, expected[k]) === STATUS.OUT_OF_STEPS || climb < GRAZING;
        if (!grazes && expected[k] === STATUS.HIT) stray++;
      }
      if (found !== STATUS.HIT || expected[k] !== STATUS.HIT) continue;
      const t = wanted[n + k];
      const apart = Math.abs(numbers[results[1] * n + k] - t) * Math.max(climb, GRAZING) - 8e-6 * (1 + t);
      off.push(Number.isNaN(apart) ? Infinity : apart / tolerance);
      if (climb >= GRAZING)
        turned.push(Math.hypot(...[2, 3, 4].map((p, c) => numbers[results[p] * n + k] - normal[c])));
    }
    if (stray || other > OTHER_STATUS * n) return `${other} of ${n} rays end otherwise`;
    if (off.filter((one) => one > 2).length > OTHER_STATUS * n) return "hits lie off the surface";
    if (quantile(off, 0.9) > OTHER_DISTANCE) return "hits lie elsewhere, if within the tolerance";
    if (!(quantile(turned, 0.9) <= OTHER_NORMAL)) return "normals differ";
    if (evaluation_difference > OTHER_EVALUATIONS * (evaluation_sum + n) + 2)
      return "rays take another number of evaluations";
    return "";
  }

  /** The numbers of a pass. @param {{width: number, height: number, first?: number, count?: number,
   *  jitter?: number[], weight?: number, directions?: number, rotation?: number, kind?: number}} asked */
  numbers(asked) {
    const { width, height, first = 0, count = 0, jitter = [0.5, 0.5], weight = 1 } = asked;
    const { directions = 16, rotation = 0.5, kind = 0 } = asked;
    const { floor } = this.scene;
    const [eye, axes] = [this.camera.eye(), this.camera.axes()];
    const [low, high] = this.show === "evaluations"
      ? [0, Math.log2(1 + this.scene.evaluations_top)] : this.depth_range ?? [0, 1];
    const dark = this.ground[0] < 0.3;
    const has_floor = eye[2] > floor ? 1 : 0;
    const made = new ArrayBuffer(VIEW_BYTES);
    new Float32Array(made).set([
      ...eye, directions, ...axes.right, this.camera.pixel(width, height), ...axes.up, rotation,
      ...axes.forward, Infinity, ...this.key(), floor, ...this.ground, has_floor,
      low, 1 / (high - low), 0, 0, ...(dark ? [0.10, 0.10, 0.11] : [0.90, 0.90, 0.89]), 1,
      this.canvas.width, this.canvas.height, ...jitter,
    ]);
    new Uint32Array(made, 144).set([width, height, first, count]);
    new Float32Array(made, 160).set([weight]);
    new Uint32Array(made, 164).set([SHOWS.indexOf(this.show), kind]);
    return made;
  }

  /** To the key light: `Light.of`. */
  key() {
    const { right, up, forward } = this.camera.axes();
    const length = Math.hypot(0.52, 0.62, 0.59);
    return right.map((r, k) => (-0.52 * r + 0.62 * up[k] - 0.59 * forward[k]) / length);
  }

  /** Traces one picture, tile by tile; false if something moved before it was done.
   *  @param {{width: number, height: number, jitter?: number[], weight?: number, directions?: number,
   *  rotation?: number}} asked @param {number} generation */
  async trace(asked, generation) {
    const { queue } = this.device;
    const pixels = asked.width * asked.height;
    const { view, lanes, results } = this;
    const [hits, sky_visibility] = [/** @type {GPUBuffer} */ (this.hits), /** @type {GPUBuffer} */ (this.sky_visibility)];
    for (let first = 0; first < pixels; ) {
      const count = Math.min(this.tile, pixels - first);
      const start = performance.now();
      queue.writeBuffer(view, 0, this.numbers({ ...asked, first, count }));
      const encoder = this.device.createCommandEncoder();
      const pass = encoder.beginComputePass();
      this.run(pass, this.pipelines.clear_hits, { 0: view, 4: hits }, count);
      for (const one of this.surfaces) {
        queue.writeBuffer(one.data, 0, new Uint32Array([count]));
        this.run(pass, this.pipelines.camera_rays, { 0: view, 1: one.numbers, 2: lanes }, count);
        this.run(pass, one.trace, { 0: one.data, 1: lanes, 2: results }, count);
        this.run(pass, this.pipelines.merge_hits, { 0: view, 1: one.numbers, 3: results, 4: hits }, count);
      }
      pass.end();
      queue.submit([encoder.finish()]);
      await queue.onSubmittedWorkDone();
      first += count;
      const took = performance.now() - start;
      if (took < 0.5 * TILE_TIME) this.tile = Math.min(TILE, 2 * this.tile);
      else if (took > 2 * TILE_TIME) this.tile = Math.max(1024, this.tile / 2);
      if (this.stopped || (generation !== this.generation && this.can_abort > 0)) return false;
    }
    if (this.show === "shaded") await this.run_over_pixels("estimate_sky", asked, { 0: view, 4: hits, 5: sky_visibility });
    return true;
  }

  /** Runs a pass over all pixels. @param {string} name @param {{width: number, height: number}} asked
   *  @param {Record<number, GPUBuffer>} buffers */
  async run_over_pixels(name, asked, buffers) {
    const pixels = asked.width * asked.height;
    const most = 65535 * GROUP;
    for (let first = 0; first < pixels; first += most) {
      const count = Math.min(most, pixels - first);
      this.device.queue.writeBuffer(this.view, 0, this.numbers({ ...asked, first, count }));
      const encoder = this.device.createCommandEncoder();
      const pass = encoder.beginComputePass();
      this.run(pass, this.pipelines[name], buffers, count);
      pass.end();
      this.device.queue.submit([encoder.finish()]);
    }
    await this.device.queue.onSubmittedWorkDone();
  }

  /** @param {{width: number, height: number, weight?: number}} asked */
  async paint(asked) {
    const [hits, sky_visibility, picture] = /** @type {GPUBuffer[]} */ ([this.hits, this.sky_visibility, this.picture]);
    await this.run_over_pixels("shade", asked, {
      0: this.view, 4: hits, 5: sky_visibility, 6: picture, 7: this.paints, 8: this.floor,
    });
  }

  /** What of the key light and of the sky reaches the floor, as `harnack.rendering.shading`
   *  has it. False if something moved before it was done. @param {number} generation */
  async light_floor(generation) {
    const { queue } = this.device;
    const { view, lanes, results, light_directions, occluded } = this;
    const key = this.key();
    const rays = CELLS * CELLS * RAYS;
    queue.writeBuffer(light_directions, 0, directions(key));
    queue.writeBuffer(occluded, 0, new Uint32Array(2 * rays));
    for (const kind of [0, 1])
      for (let first = 0; first < rays; ) {
        const count = Math.min(this.tile, rays - first);
        queue.writeBuffer(view, 0, this.numbers({ width: 1, height: 1, first, count, kind }));
        for (const one of this.surfaces) {
          queue.writeBuffer(one.data, 0, new Uint32Array([count]));
          const encoder = this.device.createCommandEncoder();
          const pass = encoder.beginComputePass();
          this.run(pass, this.pipelines.floor_rays,
            { 0: view, 1: one.numbers, 2: lanes, 9: light_directions }, count);
          this.run(pass, one.trace, { 0: one.data, 1: lanes, 2: results }, count);
          this.run(pass, this.pipelines.merge_floor_hits,
            { 0: view, 1: one.numbers, 3: results, 10: occluded }, count);
          pass.end();
          queue.submit([encoder.finish()]);
        }
        await queue.onSubmittedWorkDone();
        if (generation !== this.generation) return false;
        first += count;
      }
    const found = await this.read(occluded, 8 * rays);
    const light = new Float32Array(2 * CELLS * CELLS);
    for (const kind of [0, 1]) {
      const free = Array.from({ length: CELLS }, (_, j) => Array.from({ length: CELLS }, (_, i) => {
        let sum = 0;
        const at = kind * rays + RAYS * (j * CELLS + i);
        for (let k = 0; k < RAYS; k++) sum += found[at + k];
        return 1 - sum / RAYS;
      }));
      blurred(free).forEach((row, j) => row.forEach((x, i) => { light[2 * (j * CELLS + i) + kind] = x; }));
    }
    queue.writeBuffer(this.floor, 0, light);
    return true;
  }

  /** Puts the picture on the canvas, and lines and dots before it. @param {number} width
   *  @param {number} height */
  present(width, height) {
    const { queue } = this.device;
    const [hits, picture] = /** @type {GPUBuffer[]} */ ([this.hits, this.picture]);
    queue.writeBuffer(this.view, 0, this.numbers({ width, height }));
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: [{
      view: this.context.getCurrentTexture().createView(), loadOp: "clear", storeOp: "store",
    }] });
    pass.setPipeline(this.pipelines.display);
    pass.setBindGroup(0, this.bind_group(this.pipelines.display, { 0: this.view, 11: picture }));
    pass.draw(3);
    const kept = [];
    for (const [name, several] of /** @type {[string, Marks[]][]} */ ([["line", this.lines], ["dot", this.dots]]))
      for (const one of several) {
        const count = one.points.length;
        if (!count) continue;
        const ratio = this.canvas.width / Math.max(this.canvas.clientWidth, 1);
        const numbers = new Float32Array(8 * count);
        one.points.forEach((p, k) => numbers.set([...p, ratio * one.width], 4 * k));
        for (let k = 0; k < count; k++) numbers.set(one.color, 4 * (count + k));
        const marks = this.buffer(numbers, GPUBufferUsage.STORAGE);
        const view = this.buffer(new Uint8Array(this.numbers({ width, height, kind: count })), GPUBufferUsage.UNIFORM);
        kept.push(marks, view);
        pass.setPipeline(this.pipelines[name]);
        pass.setBindGroup(0, this.bind_group(this.pipelines[name], { 0: view, 12: hits, 13: marks }));
        pass.draw(name === "line" ? 3 * count : 6 * count);
      }
    pass.end();
    queue.submit([encoder.finish()]);
    for (const one of kept) one.destroy();
    this.shown_size = [width, height];
    this.pictures++;
  }

  /** The depths of what is seen, for their colors. @param {number} pixels */
  async measure_depths(pixels) {
    const found = await this.read(/** @type {GPUBuffer} */ (this.hits), 32 * pixels);
    const t = new Float32Array(found.buffer);
    let [low, high] = [Infinity, 0];
    for (let k = 0; k < pixels; k++)
      if ((found[8 * k + 7] & 3) === 2) { low = Math.min(low, t[8 * k + 3]); high = Math.max(high, t[8 * k + 3]); }
    this.depth_range = low < high ? [low, high] : null;
    this.canvas.dispatchEvent(new Event("range"));
  }

  /** Draws: coarsely while something moves, then at every pixel, then with many rays a pixel. */
  async draw() {
    const requested = ++this.generation;
    if (this.busy) return;
    this.busy = true;
    try {
      for (let generation = requested; !this.stopped; generation = this.generation) {
        this.can_abort = 0;
        await this.draw_coarse(generation);
        // Something may have moved while the last picture was painted.
        if (generation === this.generation && await this.draw_full(generation) && generation === this.generation) break;
      }
    } finally {
      this.busy = false;
    }
    this.canvas.dispatchEvent(new Event("idle"));
  }

  /** Draws no more. */
  stop() {
    this.stopped = true;
    this.generation++;
  }

  /** One coarse picture. @param {number} generation */
  async draw_coarse(generation) {
    const start = performance.now();
    const { width, height } = this.size(this.scale);
    const asked = { width, height, directions: 6 };
    await this.trace(asked, generation);
    if (this.stopped) return;
    await this.paint(asked);
    this.present(width, height);
    const better = this.scale * Math.sqrt(FRAME_TIME / Math.max(performance.now() - start, 1));
    this.scale = Math.min(1, Math.max(0.06, 0.5 * (this.scale + better)));
  }

  /** Whole pictures; false if something moved. @param {number} generation */
  async draw_full(generation) {
    const { width, height } = this.size(1);
    for (let k = 0; k < this.samples; k++) {
      this.can_abort = 1;
      const jitter = [(0.5 + k * 0.7548776662) % 1, (0.5 + k * 0.5698402910) % 1];
      const asked = { width, height, jitter, weight: 1 / (k + 1),
                      directions: k ? 4 : 16, rotation: (0.5 + 0.381966 * k) % 1 };
      const start = performance.now();
      if (!await this.trace(asked, generation)) return false;
      this.rate = (width * height) / (performance.now() - start);
      if (k === 0 && this.show === "depth") await this.measure_depths(width * height);
      await this.paint(asked);
      this.present(width, height);
      if (k === 0) this.canvas.dispatchEvent(new Event("full_picture"));
      if (generation !== this.generation) return false;
      if (k === 0 && this.show === "shaded") {
        if (!await this.light_floor(generation)) return false;
        await this.paint(asked);
        this.present(width, height);
      }
      if (this.show === "evaluations" || this.show === "status") return true;
    }
    return true;
  }

  /** The size of pictures at a scale. @param {number} scale */
  size(scale) {
    const { canvas } = this;
    const fit = Math.min(scale, Math.sqrt(this.max_pixels / (canvas.width * canvas.height)));
    const [width, height] = [canvas.width, canvas.height].map((x) => Math.max(8, Math.round(x * fit)));
    this.reserve(width * height);
    return { width, height };
  }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(
      (x) => Math.max(16, Math.round(x * ratio)));
    if (width === this.canvas.width && height === this.canvas.height && this.pictures) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.draw();
  }
}

/** What a part of numbers is at most; NaN if one of them is. @param {number[]} several @param {number} part */
function quantile(several, part) {
  if (several.some(Number.isNaN)) return NaN;
  return several.sort((a, b) => a - b)[Math.floor(part * (several.length - 1))] ?? 0;
}

/** Directions to places on the round key light and to the sky. @param {number[]} key */
function directions(key) {
  const axis = key.map(Math.abs).indexOf(Math.min(...key.map(Math.abs)));
  const e = [0, 0, 0];
  e[axis] = 1;
  const unit = (/** @type {number[]} */ v) => v.map((x) => x / Math.hypot(...v));
  const cross = (/** @type {number[]} */ a, /** @type {number[]} */ b) =>
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const u = unit(cross(key, e));
  const v = cross(key, u);
  const places = sample_square();
  const made = new Float32Array(8 * places.length);
  places.forEach(([s, turn], k) => {
    const [radius, angle] = [SPREAD * Math.sqrt(s), 2 * Math.PI * turn];
    const d = key.map((x, i) => x + radius * (Math.cos(angle) * u[i] + Math.sin(angle) * v[i]));
    d[2] = Math.max(d[2], 0.05);
    made.set(unit(d), 4 * k);
    const across = Math.sqrt(s);
    made.set([across * Math.cos(angle), across * Math.sin(angle), Math.sqrt(Math.max(1 - s, 1e-3))],
      4 * (places.length + k));
  });
  return made;
}

/** A picture blurred along both axes; outside of it, all is free. @param {number[][]} picture */
function blurred(picture) {
  const n = picture.length;
  const once = (/** @type {number[][]} */ rows) => Array.from({ length: n }, (_, i) =>
    rows.map((row) => BLUR.reduce((sum, weight, k) => {
      const at = i + k - 3;
      return sum + weight * (at < 0 || at >= n ? 1 : row[at]);
    }, 0)));
  return once(once(picture));
}
