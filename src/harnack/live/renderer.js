// The renderer of the viewer: it traces surfaces on the device of the browser. The kernels are those
// that Dr.Jit recorded, as shaders; rays, light and pictures are made by passes.wgsl. It has no
// dependencies, and its data come from `harnack.live.live_scene`.
// @ts-check

import { Camera } from "./camera.js";
import { describeDisagreement } from "./device_check.js";
import { floorLight, lightDirections } from "./floor_light.js";

/** @import {Pose} from "./camera.js" */
/** @import {Shading} from "./floor_light.js" */
/** @import {Legend} from "./legend.js" */
/** Rays with known answers, as words in text.
 *  @typedef {{lanes: string, results: string, count: number}} Check */
/** A surface as Python describes it: its kernel, the data of this, and its colors.
 *  @typedef {{
 *   key: string, code: string, data: string | Uint32Array, lanes: number[], results: number[],
 *   paints: {front: number[], back: number[], glossy: boolean}[], tolerance: number, check?: Check
 * }} Surface */
/** @typedef {{surfaces: Surface[], curves: number[][][]}} State */
/** @typedef {{name: string, low: number, high: number, start: number, step: number | null}} Slider */
/** @typedef {{
 *   title: string, placement: number[], camera: Pose, floor: number, show: string,
 *   ground: string, shading: Shading, sliders: Slider[], editable: boolean, middle: number[], reach: number,
 *   materials: string[], material: string | null, tube: number | null,
 *   legends: Record<string, Legend>, evaluations_top: number, state: State
 * }} Scene */
/** Lines (pairs of points) or dots on the stage; width in pixels of the window.
 *  @typedef {{points: number[][], color: number[], width: number}} Marks */
/** A surface on the device. @typedef {{
 *   source: Surface, pipeline: GPUComputePipeline, data: GPUBuffer, uniforms: GPUBuffer
 * }} DeviceSurface */
/** @typedef {{width: number, height: number}} Size */
/** A pass of `count` threads from number `first` on. jitter: the position of the ray in a pixel.
 *  weight: of the new picture in the mean. directions, rotation: the directions across the picture
 *  along which the sky is estimated. kind: of light, or the number of marks.
 *  @typedef {Size & {first?: number, count?: number, jitter?: number[], weight?: number,
 *   directions?: number, rotation?: number, kind?: number}} PassOptions */

export const MODES = ["shaded", "normal", "depth", "evaluations", "status"];
// The most rays that are traced at once, and the milliseconds that they should take.
const MAX_TILE_RAYS = 1 << 17;
const TARGET_TILE_TIME = 60;
// Milliseconds that a coarse picture should take while something moves.
export const TARGET_FRAME_TIME = 40;
const SAMPLES_PER_PIXEL = 16;
// The entry points of passes.wgsl that are no render passes.
const COMPUTE_PASSES = [
  "camera_rays", "clear_hits", "merge_hits", "estimate_sky", "shade", "floor_rays", "merge_floor_hits",
];
const WORKGROUP_SIZE = 64;
const MAX_WORKGROUPS = 65535;
const UNIFORM_BYTES = 176;
// The most surface colors that the info word of a hit in passes.wgsl can number.
const MAX_SURFACE_COLORS = 2048;
const HIT_BYTES = 32;

/** The 32-bit words of a text, which `encode_arrays` of harnack.live.live_scene has written; words
 *  are returned as they are. @param {string | Uint32Array} text @returns {Promise<Uint32Array>} */
export async function decodeWords(text) {
  if (typeof text !== "string") return text;
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint32Array(await new Response(stream).arrayBuffer());
}

/** The scale of coarse pictures that take the target time, approached by half.
 *  @param {number} scale of the last picture @param {number} duration of it, in milliseconds */
export function adaptScale(scale, duration) {
  const target = scale * Math.sqrt(TARGET_FRAME_TIME / Math.max(duration, 1));
  return Math.min(1, Math.max(0.06, 0.5 * (scale + target)));
}

/** Renders a scene on a canvas by WebGPU. In what follows, buffers are given by the numbers of
 *  their bindings in passes.wgsl. */
export class WebGpuRenderer {
  /** @param {GPUDevice} device @param {Scene} scene @param {HTMLCanvasElement} canvas
   *  @param {string} passes the text of passes.wgsl */
  constructor(device, scene, canvas, passes) {
    this.device = device;
    this.scene = scene;
    this.canvas = canvas;
    this.passes = passes;
    this.camera = new Camera(scene.camera);
    /** The name of the ground. */
    this.ground = scene.ground;
    this.mode = "shaded";
    /** The least and the greatest visible depth, once it is known.
     *  @type {[number, number] | null} */
    this.depthRange = null;
    /** @type {Marks[]} */
    this.lines = [];
    /** @type {Marks[]} */
    this.dots = [];
    /** The size of coarse pictures relative to whole ones. */
    this.coarseScale = 0.25;
    /** The number of rays that are traced at once. */
    this.tileRays = 1 << 14;
    /** The number of the latest request to draw. */
    this.generation = 0;
    this.pictureCount = 0;
    /** The number of rays of each pixel when nothing moves. */
    this.samplesPerPixel = SAMPLES_PER_PIXEL;
    /** Whether a picture is given up when another one is requested. */
    this.isAbortable = false;
    this.isStopped = false;
    /** The rate of the last whole picture. */
    this.pixelsPerMillisecond = 0;
    /** @type {Map<string, Promise<GPUComputePipeline>>} */
    this.kernelPipelines = new Map();
    /** The pipelines of passes.wgsl. @type {any} */
    this.pipelines = {};
    /** @type {DeviceSurface[]} */
    this.surfaces = [];
    /** The last replacement of the surfaces. @type {Promise<any>} */
    this.lastReplacement = Promise.resolve();
    this.context = /** @type {GPUCanvasContext} */ (canvas.getContext("webgpu"));
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device, format: this.format, alphaMode: "opaque" });
    const { STORAGE, UNIFORM, COPY_SRC } = GPUBufferUsage;
    this.uniforms = this.createBuffer(UNIFORM_BYTES, UNIFORM);
    this.lanes = this.createBuffer(28 * MAX_TILE_RAYS, STORAGE);
    this.results = this.createBuffer(28 * MAX_TILE_RAYS, STORAGE | COPY_SRC);
    const { floor_cells: cells, rays_per_cell: rays, sky_directions: toSky } = scene.shading;
    /** The number of rays from the floor to the key light, and to the sky. */
    this.floorRays = cells * cells * rays;
    this.lightDirections = this.createBuffer(32 * toSky.length, STORAGE);
    this.occluded = this.createBuffer(8 * this.floorRays, STORAGE | COPY_SRC);
    this.floorLight = this.createBuffer(new Float32Array(2 * cells * cells).fill(1), STORAGE);
    this.surfaceColors = this.createBuffer(32 * MAX_SURFACE_COLORS, STORAGE);
    this.maxPixels = Math.floor(device.limits.maxStorageBufferBindingSize / HIT_BYTES);
    this.reservePixels(1024);
  }

  /** Creates a buffer of a number of bytes, or of data. @param {ArrayBufferView | number} content
   *  @param {number} usage */
  createBuffer(content, usage) {
    const size = typeof content === "number" ? content : content.byteLength;
    const buffer = this.device.createBuffer({
      size: Math.max(32, size), usage: usage | GPUBufferUsage.COPY_DST,
    });
    if (typeof content !== "number") this.device.queue.writeBuffer(buffer, 0, /** @type {any} */ (content));
    return buffer;
  }

  /** Makes room for a picture. @param {number} count the number of its pixels */
  reservePixels(count) {
    if (this.hits && this.hits.size >= HIT_BYTES * count) return;
    for (const buffer of [this.hits, this.skyVisibility, this.picture]) buffer?.destroy();
    this.hits = this.createBuffer(HIT_BYTES * count, GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC);
    this.skyVisibility = this.createBuffer(4 * count, GPUBufferUsage.STORAGE);
    this.picture = this.createBuffer(16 * count, GPUBufferUsage.STORAGE);
  }

  /** Compiles passes.wgsl. */
  async compile() {
    const { device, format } = this;
    const module = device.createShaderModule({ code: this.passes });
    const computePipelines = await Promise.all(COMPUTE_PASSES.map((entryPoint) =>
      device.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } })));
    COMPUTE_PASSES.forEach((name, k) => { this.pipelines[name] = computePipelines[k]; });
    const blend = /** @type {GPUBlendState} */ ({
      color: { srcFactor: "src-alpha", dstFactor: "one-minus-src-alpha" }, alpha: {},
    });
    const createPipeline = (/** @type {string} */ vertex, /** @type {string} */ fragment) =>
      device.createRenderPipelineAsync({
        layout: "auto", vertex: { module, entryPoint: vertex },
        fragment: { module, entryPoint: fragment,
                    targets: [fragment === "display" ? { format } : { format, blend }] },
      });
    [this.pipelines.display, this.pipelines.line, this.pipelines.dot] = await Promise.all([
      createPipeline("full_screen_vertex", "display"), createPipeline("line_vertex", "mark"),
      createPipeline("dot_vertex", "mark"),
    ]);
  }

  /** The pipeline of a kernel, which is compiled once. @param {Surface} surface */
  kernelPipeline(surface) {
    const cachedPipeline = this.kernelPipelines.get(surface.key);
    if (cachedPipeline) return cachedPipeline;
    const module = this.device.createShaderModule({ code: surface.code });
    const pipeline = this.device.createComputePipelineAsync({
      layout: "auto", compute: { module, entryPoint: "main" },
    });
    this.kernelPipelines.set(surface.key, pipeline);
    return pipeline;
  }

  /** Replaces the surfaces, after earlier replacements. They stay as they are if the device fails
   *  the check of the new ones. Returns how it fails; empty if it passes.
   *  @param {State} state @param {boolean} [checks] whether the device is checked
   *  @returns {Promise<string>} */
  setState(state, checks = true) {
    const replacement = this.lastReplacement.then(() => this.replaceSurfaces(state, checks));
    this.lastReplacement = replacement.catch(() => "");
    return replacement;
  }

  /** @param {State} state @param {boolean} checks */
  async replaceSurfaces(state, checks) {
    const newSurfaces = await this.createSurfaces(state.surfaces);
    let failure = "";
    if (checks) for (const surface of newSurfaces) failure ||= await this.compareWithReference(surface);
    const discarded = failure ? newSurfaces : this.surfaces;
    if (!failure) {
      this.writeSurfaceColors(state.surfaces);
      this.surfaces = newSurfaces;
    }
    for (const { data, uniforms } of discarded) { data.destroy(); uniforms.destroy(); }
    return failure;
  }

  /** Brings surfaces to the device. @param {Surface[]} surfaces @returns {Promise<DeviceSurface[]>} */
  async createSurfaces(surfaces) {
    const pipelines = await Promise.all(surfaces.map((surface) => this.kernelPipeline(surface)));
    const data = await Promise.all(surfaces.map((surface) => decodeWords(surface.data)));
    let firstColor = 0;
    return surfaces.map((source, k) => {
      const uniforms = new Uint32Array(20);
      uniforms.set(source.lanes, 0);
      uniforms.set(source.results, 8);
      uniforms.set([firstColor, source.lanes.length], 16);
      firstColor += source.paints.length;
      return { source, pipeline: pipelines[k], data: this.createBuffer(data[k], GPUBufferUsage.STORAGE),
               uniforms: this.createBuffer(uniforms, GPUBufferUsage.UNIFORM) };
    });
  }

  /** @param {Surface[]} surfaces */
  writeSurfaceColors(surfaces) {
    const colors = new Float32Array(8 * MAX_SURFACE_COLORS);
    colors.set(surfaces.flatMap((surface) => surface.paints).slice(0, MAX_SURFACE_COLORS).flatMap(
      ({ front, back, glossy }) => [...front, glossy ? 1 : 0, ...back, glossy ? 1 : 0]));
    this.device.queue.writeBuffer(this.surfaceColors, 0, colors);
  }

  /** Adds a dispatch to a compute pass. @param {GPUComputePassEncoder} pass
   *  @param {GPUComputePipeline} pipeline @param {Record<number, GPUBuffer>} buffers
   *  @param {number} count the number of threads */
  dispatch(pass, pipeline, buffers, count) {
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.createBindGroup(pipeline, buffers));
    pass.dispatchWorkgroups(Math.ceil(count / WORKGROUP_SIZE));
  }

  /** Submits a compute pass. @param {(pass: GPUComputePassEncoder) => void} addDispatches */
  submitPass(addDispatches) {
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    addDispatches(pass);
    pass.end();
    this.device.queue.submit([encoder.finish()]);
  }

  /** @param {GPUComputePipeline | GPURenderPipeline} pipeline
   *  @param {Record<number, GPUBuffer>} buffers */
  createBindGroup(pipeline, buffers) {
    return this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: Object.entries(buffers).map(([binding, buffer]) => ({
        binding: Number(binding), resource: { buffer },
      })),
    });
  }

  /** The words of a buffer. @param {GPUBuffer} buffer @param {number} size in bytes */
  async readBuffer(buffer, size) {
    const copy = this.device.createBuffer({
      size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST,
    });
    const encoder = this.device.createCommandEncoder();
    encoder.copyBufferToBuffer(buffer, 0, copy, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await copy.mapAsync(GPUMapMode.READ);
    const words = new Uint32Array(copy.getMappedRange().slice(0));
    copy.destroy();
    return words;
  }

  /** Traces the rays that come with a surface, and compares the hits with those of Dr.Jit. Returns
   *  the difference in words; empty if they agree. @param {DeviceSurface} surface */
  async compareWithReference({ source, pipeline, data }) {
    const { check } = source;
    if (!check) return "";
    const { count } = check;
    const [rays, expected] = await Promise.all([decodeWords(check.lanes), decodeWords(check.results)]);
    this.device.queue.writeBuffer(data, 0, new Uint32Array([count]));
    this.device.queue.writeBuffer(this.lanes, 0, /** @type {any} */ (rays));
    this.submitPass((pass) =>
      this.dispatch(pass, pipeline, { 0: data, 1: this.lanes, 2: this.results }, count));
    const computed = await this.readBuffer(this.results, 28 * count);
    return describeDisagreement(source, count, rays, expected, computed);
  }

  /** The uniforms of a pass: `PassUniforms` in passes.wgsl. @param {PassOptions} options */
  passUniforms(options) {
    const { width, height, first = 0, count = 0, jitter = [0.5, 0.5], weight = 1 } = options;
    const { floor, shading } = this.scene;
    const { directions = shading.sky_direction_count, rotation = 0.5, kind = 0 } = options;
    const { position, axes } = this.camera;
    const [low, high] = this.mode === "evaluations"
      ? [0, Math.log2(1 + this.scene.evaluations_top)] : this.depthRange ?? [0, 1];
    const hasFloor = position[2] > floor ? 1 : 0;
    const uniforms = new ArrayBuffer(UNIFORM_BYTES);
    new Float32Array(uniforms).set([
      ...position, directions, ...axes.right, this.camera.pixelSize(width, height), ...axes.up, rotation,
      ...axes.forward, Infinity, ...this.keyLightDirection(), floor, ...shading.reflectance[this.ground], hasFloor,
      low, 1 / (high - low), 0, 0, ...shading.background[this.ground], 1,
      this.canvas.width, this.canvas.height, ...jitter,
    ]);
    new Uint32Array(uniforms, 144).set([width, height, first, count]);
    new Float32Array(uniforms, 160).set([weight]);
    new Uint32Array(uniforms, 164).set([MODES.indexOf(this.mode), kind]);
    return uniforms;
  }

  /** The unit vector to the key light, which moves with the camera: `StudioLight.of`. */
  keyLightDirection() {
    const { right, up, forward } = this.camera.axes;
    const [toRight, toUp, toBack] = this.scene.shading.key_direction;
    return right.map((r, k) => toRight * r + toUp * up[k] - toBack * forward[k]);
  }

  /** Traces a picture, tile by tile. Returns whether it was completed, and not given up for another
   *  one. @param {PassOptions} options @param {number} generation */
  async trace(options, generation) {
    const pixelCount = options.width * options.height;
    for (let first = 0; first < pixelCount; ) {
      const count = Math.min(this.tileRays, pixelCount - first);
      const start = performance.now();
      this.submitTile({ ...options, first, count }, count);
      await this.device.queue.onSubmittedWorkDone();
      first += count;
      this.adaptTile(performance.now() - start);
      if (this.isStopped || (generation !== this.generation && this.isAbortable)) return false;
    }
    const [hits, skyVisibility] = /** @type {GPUBuffer[]} */ ([this.hits, this.skyVisibility]);
    if (this.mode === "shaded")
      await this.runOverPixels("estimate_sky", options, { 0: this.uniforms, 4: hits, 5: skyVisibility });
    return true;
  }

  /** Submits the passes that trace all surfaces in one tile. @param {PassOptions} options
   *  @param {number} count the number of its rays */
  submitTile(options, count) {
    const { uniforms, lanes, results, pipelines } = this;
    const { queue } = this.device;
    const hits = /** @type {GPUBuffer} */ (this.hits);
    queue.writeBuffer(uniforms, 0, this.passUniforms(options));
    this.submitPass((pass) => {
      this.dispatch(pass, pipelines.clear_hits, { 0: uniforms, 4: hits }, count);
      for (const surface of this.surfaces) {
        queue.writeBuffer(surface.data, 0, new Uint32Array([count]));
        this.dispatch(pass, pipelines.camera_rays, { 0: uniforms, 1: surface.uniforms, 2: lanes }, count);
        this.dispatch(pass, surface.pipeline, { 0: surface.data, 1: lanes, 2: results }, count);
        this.dispatch(pass, pipelines.merge_hits,
          { 0: uniforms, 1: surface.uniforms, 3: results, 4: hits }, count);
      }
    });
  }

  /** Adapts the size of tiles to the time that the last one took. @param {number} duration */
  adaptTile(duration) {
    if (duration < 0.5 * TARGET_TILE_TIME) this.tileRays = Math.min(MAX_TILE_RAYS, 2 * this.tileRays);
    else if (duration > 2 * TARGET_TILE_TIME) this.tileRays = Math.max(1024, this.tileRays / 2);
  }

  /** Runs a pass over all pixels. @param {string} name @param {PassOptions} options
   *  @param {Record<number, GPUBuffer>} buffers */
  async runOverPixels(name, options, buffers) {
    const pixelCount = options.width * options.height;
    const maxCount = MAX_WORKGROUPS * WORKGROUP_SIZE;
    for (let first = 0; first < pixelCount; first += maxCount) {
      const count = Math.min(maxCount, pixelCount - first);
      this.device.queue.writeBuffer(this.uniforms, 0, this.passUniforms({ ...options, first, count }));
      this.submitPass((pass) => this.dispatch(pass, this.pipelines[name], buffers, count));
    }
    await this.device.queue.onSubmittedWorkDone();
  }

  /** Computes the colors of all hits. @param {PassOptions} options */
  async shade(options) {
    const { uniforms, surfaceColors, floorLight: light } = this;
    const [hits, skyVisibility, picture] = /** @type {GPUBuffer[]} */ ([this.hits, this.skyVisibility, this.picture]);
    await this.runOverPixels("shade", options,
      { 0: uniforms, 4: hits, 5: skyVisibility, 6: picture, 7: surfaceColors, 8: light });
  }

  /** Computes the light on the floor. Returns whether it was completed, and not given up for
   *  another picture. @param {number} generation */
  async lightFloor(generation) {
    const { floorRays, device: { queue }, scene: { shading } } = this;
    queue.writeBuffer(this.lightDirections, 0, lightDirections(shading, this.keyLightDirection()));
    queue.writeBuffer(this.occluded, 0, new Uint32Array(2 * floorRays));
    for (const kind of [0, 1])
      for (let first = 0; first < floorRays; ) {
        const count = Math.min(this.tileRays, floorRays - first);
        this.submitFloorRays({ width: 1, height: 1, first, count, kind }, count);
        await queue.onSubmittedWorkDone();
        if (generation !== this.generation) return false;
        first += count;
      }
    const occluded = await this.readBuffer(this.occluded, 8 * floorRays);
    queue.writeBuffer(this.floorLight, 0, floorLight(shading, occluded));
    return true;
  }

  /** Submits the passes that trace rays from the floor. @param {PassOptions} options
   *  @param {number} count the number of rays */
  submitFloorRays(options, count) {
    const { uniforms, lanes, results, occluded, pipelines } = this;
    const { queue } = this.device;
    queue.writeBuffer(uniforms, 0, this.passUniforms(options));
    for (const surface of this.surfaces) {
      queue.writeBuffer(surface.data, 0, new Uint32Array([count]));
      this.submitPass((pass) => {
        this.dispatch(pass, pipelines.floor_rays,
          { 0: uniforms, 1: surface.uniforms, 2: lanes, 9: this.lightDirections }, count);
        this.dispatch(pass, surface.pipeline, { 0: surface.data, 1: lanes, 2: results }, count);
        this.dispatch(pass, pipelines.merge_floor_hits,
          { 0: uniforms, 1: surface.uniforms, 3: results, 10: occluded }, count);
      });
    }
  }

  /** Puts the picture on the canvas, and lines and dots in front of it. @param {number} width
   *  @param {number} height the size of the picture */
  present(width, height) {
    const { queue } = this.device;
    const picture = /** @type {GPUBuffer} */ (this.picture);
    queue.writeBuffer(this.uniforms, 0, this.passUniforms({ width, height }));
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: [{
      view: this.context.getCurrentTexture().createView(), loadOp: "clear", storeOp: "store",
    }] });
    pass.setPipeline(this.pipelines.display);
    pass.setBindGroup(0, this.createBindGroup(this.pipelines.display, { 0: this.uniforms, 11: picture }));
    pass.draw(3);
    const buffers = [
      ...this.lines.flatMap((marks) => this.drawMarks(pass, "line", marks, { width, height })),
      ...this.dots.flatMap((marks) => this.drawMarks(pass, "dot", marks, { width, height })),
    ];
    pass.end();
    queue.submit([encoder.finish()]);
    for (const buffer of buffers) buffer.destroy();
    this.presentedSize = [width, height];
    this.pictureCount++;
  }

  /** Adds marks to a render pass. Returns the buffers that it needs, to be destroyed afterwards.
   *  @param {GPURenderPassEncoder} pass @param {"line" | "dot"} name @param {Marks} marks
   *  @param {Size} size */
  drawMarks(pass, name, { points, color, width }, size) {
    const count = points.length;
    if (!count) return [];
    const pixelRatio = this.canvas.width / Math.max(this.canvas.clientWidth, 1);
    const content = new Float32Array(8 * count);
    points.forEach((p, k) => content.set([...p, pixelRatio * width], 4 * k));
    for (let k = 0; k < count; k++) content.set(color, 4 * (count + k));
    const marks = this.createBuffer(content, GPUBufferUsage.STORAGE);
    const uniforms = this.createBuffer(
      new Uint8Array(this.passUniforms({ ...size, kind: count })), GPUBufferUsage.UNIFORM);
    const hits = /** @type {GPUBuffer} */ (this.hits);
    pass.setPipeline(this.pipelines[name]);
    pass.setBindGroup(0, this.createBindGroup(this.pipelines[name], { 0: uniforms, 12: hits, 13: marks }));
    pass.draw(name === "line" ? 3 * count : 6 * count);
    return [marks, uniforms];
  }

  /** Measures the range of visible depths, for their colors. @param {number} pixelCount */
  async measureDepths(pixelCount) {
    const hits = await this.readBuffer(/** @type {GPUBuffer} */ (this.hits), HIT_BYTES * pixelCount);
    const hitFloats = new Float32Array(hits.buffer);
    let [low, high] = [Infinity, 0];
    for (let k = 0; k < pixelCount; k++) {
      const [t, kind] = [hitFloats[8 * k + 3], hits[8 * k + 7] & 3];
      if (kind === 2) { low = Math.min(low, t); high = Math.max(high, t); }  // KIND_SURFACE
    }
    this.depthRange = low < high ? [low, high] : null;
    this.canvas.dispatchEvent(new Event("depthrange"));
  }

  /** Draws: coarsely while something moves, then every pixel, then many rays of each pixel. */
  async draw() {
    const requested = ++this.generation;
    if (this.isBusy) return;
    this.isBusy = true;
    try {
      for (let generation = requested; !this.isStopped; generation = this.generation) {
        this.isAbortable = false;
        await this.drawCoarse(generation);
        // Something may have moved while the last picture was shaded.
        if (generation === this.generation && await this.drawWhole(generation) && generation === this.generation) break;
      }
    } finally {
      this.isBusy = false;
    }
    this.canvas.dispatchEvent(new Event("idle"));
  }

  /** Stops drawing, for good. */
  stop() {
    this.isStopped = true;
    this.generation++;
  }

  /** Draws one coarse picture. @param {number} generation */
  async drawCoarse(generation) {
    const start = performance.now();
    const { width, height } = this.pictureSize(this.coarseScale);
    const options = { width, height, directions: 6 };
    await this.trace(options, generation);
    if (this.isStopped) return;
    await this.shade(options);
    this.present(width, height);
    this.coarseScale = adaptScale(this.coarseScale, performance.now() - start);
  }

  /** Draws the mean of whole pictures. Returns whether it was completed, and not given up because
   *  something has moved. @param {number} generation */
  async drawWhole(generation) {
    const { width, height } = this.pictureSize(1);
    for (let k = 0; k < this.samplesPerPixel; k++) {
      this.isAbortable = true;
      const jitter = [(0.5 + k * 0.7548776662) % 1, (0.5 + k * 0.5698402910) % 1];
      const options = { width, height, jitter, weight: 1 / (k + 1),
                        directions: k ? 4 : undefined, rotation: (0.5 + 0.381966 * k) % 1 };
      const start = performance.now();
      if (!await this.trace(options, generation)) return false;
      this.pixelsPerMillisecond = (width * height) / (performance.now() - start);
      if (k === 0 && this.mode === "depth") await this.measureDepths(width * height);
      await this.shade(options);
      this.present(width, height);
      if (k === 0) this.canvas.dispatchEvent(new Event("wholepicture"));
      if (generation !== this.generation) return false;
      if (k === 0 && this.mode === "shaded") {
        if (!await this.lightFloor(generation)) return false;
        await this.shade(options);
        this.present(width, height);
      }
      // Means of evaluations and of statuses make no sense.
      if (this.mode === "evaluations" || this.mode === "status") return true;
    }
    return true;
  }

  /** The size of pictures, for which it makes room. @param {number} scale relative to the canvas
   *  @returns {Size} */
  pictureSize(scale) {
    const { canvas } = this;
    const possibleScale = Math.min(scale, Math.sqrt(this.maxPixels / (canvas.width * canvas.height)));
    const [width, height] = [canvas.width, canvas.height].map((x) => Math.max(8, Math.round(x * possibleScale)));
    this.reservePixels(width * height);
    return { width, height };
  }

  /** Fits the canvas to its size in the window. */
  resize() {
    const pixelRatio = Math.min(devicePixelRatio, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(
      (x) => Math.max(16, Math.round(x * pixelRatio)));
    if (width === this.canvas.width && height === this.canvas.height && this.pictureCount) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.draw();
  }
}
