// The window of the viewer: a canvas, a message, a legend and the controls beside them. It gets
// states from Python or from the page, and pictures from the renderer of the browser or from Python.
// @ts-check

import { Camera, addScaled, dot } from "./camera.js";
import { CurveEditor } from "./curve_editor.js";
import {
  createButton, createCheckbox, createElement, createOptions, createRangeInput, download,
  downloadBlob, formatNumber,
} from "./dom.js";
import { createLegend } from "./legend.js";
import { Placement } from "./placement.js";
import { MODES, WebGpuRenderer, adaptScale } from "./renderer.js";
import { applyDelta } from "./slider_states.js";

/** @import {Curves} from "./curve_editor.js" */
/** @import {Marks, Scene, Slider} from "./renderer.js" */
/** @import {StateDelta} from "./slider_states.js" */
/** Options of `harnack.render` that the controls change: see `LIVE_OPTIONS` in
 *  harnack.live.live_scene. @typedef {{material?: string, boundary_radius?: number | null}} RenderOptions */
/** A volume that cuts all surfaces: see `harnack.live.session`.
 * @typedef {{ball?: number[], box?: number[], plane?: number[]}} CutVolume */
/** The state of the controls, as Python takes it.
 * @typedef {{sliders: Record<string, number>, loops: Curves | null, cut: CutVolume | null,
 *            settings: RenderOptions}} ControlValues */
/** The source of states. A channel to Python answers further requests, too.
 * @typedef {{
 *   fetchDelta(controlValues: ControlValues & {checks: boolean}): Promise<StateDelta>,
 *   request?(kind: string, parameters: object,
 *     onProgress?: (completed: number, cancel: () => void) => void): Promise<any>,
 * }} Channel */

/** The parameters of the volumes that cut the surfaces: least, greatest and first value.
 *  @type {Record<string, Record<string, number[]>>} */
const CUT_PARAMETERS = {
  none: {},
  ball: { size: [0.02, 1.05, 0.8] },
  box: { "size x": [0.02, 1.05, 0.6], "size y": [0.02, 1.05, 0.6], "size z": [0.02, 1.05, 0.6] },
  plane: { azimuth: [-180, 180, -60], elevation: [-90, 90, 20], offset: [-1, 1, 0] },
};
// Choices of the list of materials, beside their names.
const ORIGINAL_MATERIAL = "as given";
const PLAIN_COLOR = "color";
// The distance in pixels beyond which a press of a pointer is no click.
const CLICK_RADIUS = 3;
// The milliseconds without a change after which the device is checked.
const IDLE_TIME = 400;
// How many times faster Python must be than the device of the browser to render instead of it.
const MIN_SPEEDUP = 1.5;

export class Panel {
  /** @param {HTMLElement} root @param {Scene} scene @param {string} passes the text of passes.wgsl
   *  @param {Channel | null} channel @param {string} still the address of a picture, which is shown
   *  until a surface is rendered */
  constructor(root, scene, passes, channel, still) {
    this.root = root;
    this.scene = scene;
    this.passes = passes;
    this.channel = channel;
    /** @type {Record<string, number>} */
    this.sliderValues = Object.fromEntries(scene.sliders.map(({ name, start }) => [name, start]));
    this.mode = scene.show;
    this.ground = scene.ground;
    /** @type {RenderOptions} */
    this.renderOptions = {};
    this.cutKind = "none";
    /** @type {Record<string, number>} */
    this.cutParameters = {};
    this.placement = new Placement(scene.placement);
    this.curveEditor = new CurveEditor(this, scene.state.curves);
    /** Whether a click probes the surface. */
    this.isProbing = false;
    /** @type {Marks[]} */
    this.probeMarks = [];
    /** @type {Marks[]} */
    this.lines = [];
    /** @type {Marks[]} */
    this.dots = [];
    /** The camera where this browser does not render. @type {Camera | undefined} */
    this.remoteCamera = undefined;
    /** The least and the greatest depth of the last picture by Python, on the stage.
     *  @type {[number, number] | null} */
    this.remoteDepthRange = null;
    /** The size of coarse pictures by Python, relative to whole ones. */
    this.coarseScale = 0.25;
    /** The JSON of the value of each attribute that was last reported. @type {Record<string, string>} */
    this.reportedAttributes = {};
    this.isReportDue = false;
    /** @type {ResizeObserver[]} */
    this.observers = [];
    root.classList.add("harnack");
    this.canvas = createElement("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label",
      `${scene.title}. Drag or use the arrow keys to turn it, the wheel or + and - to come closer.`);
    this.stillImage = createElement("img", { alt: scene.title, src: still });
    this.message = createElement("p", { className: "message" });
    this.message.setAttribute("role", "status");
    this.controls = this.createControls();
    this.remoteCanvas = createElement("canvas", { tabIndex: 0, className: "remote" });
    this.remoteCanvas.style.display = "none";
    this.imageCanvas = document.createElement("canvas");
    this.legend = createElement("div");
    const notes = createElement("div", { className: "notes" }, this.legend, this.message);
    root.append(this.stillImage, this.canvas, this.remoteCanvas, notes, this.controls);
  }

  /** Shows a message, and the canvas or the still picture.
   *  @param {string} text @param {boolean} [isDrawn] whether the canvas shows a surface */
  showMessage(text, isDrawn = this.renderer !== undefined) {
    this.message.textContent = text;
    this.canvas.style.visibility = isDrawn ? "visible" : "hidden";
    this.stillImage.style.display = isDrawn || this.isRemote ? "none" : "";
    this.root.dataset.state = isDrawn ? "drawn" : text ? "message" : "";
  }

  /** Shows a message of what goes wrong in an action. @param {() => Promise<void>} action */
  async showErrors(action) {
    try {
      await action();
    } catch (error) {
      this.showMessage(/** @type {Error} */ (error).message);
    }
  }

  // Controls.

  createControls() {
    const { scene } = this;
    const hasPython = this.channel?.request !== undefined;
    const rows = [
      ...this.createModeControls(), ...scene.sliders.map((slider) => this.createSlider(slider)),
    ];
    /** @type {HTMLElement[]} */
    const buttons = [createButton("Reset view", () => { this.camera.reset(); this.redraw(); })];
    if (scene.editable) {
      rows.push(createCheckbox("Edit points", (isChecked) => this.curveEditor.setActive(isChecked)));
      buttons.push(
        createButton("Undo", () => this.curveEditor.undo()),
        createButton("Redo", () => this.curveEditor.redo()),
        createButton("Smooth", () => this.curveEditor.smooth()),
      );
    }
    buttons.push(createButton("Save picture", () => this.savePicture()));
    if (hasPython) {
      rows.push(
        createCheckbox("Probe by click", (isChecked) => {
          this.isProbing = isChecked;
          this.probeMarks = [];
          this.updateMarks();
        }),
        ...this.createMaterialControls(), ...this.createCutControls(),
      );
      const { row, button } = this.createRenderControls();
      rows.push(row);
      buttons.push(button, ...this.createSceneFileControls());
    }
    const buttonRow = createElement("div", { className: "buttons" }, ...buttons);
    this.deviceNote = createElement("small");
    return createElement("details", { open: innerWidth > 600 && scene.sliders.length > 0 },
      createElement("summary", {}, "Controls"), ...rows, buttonRow, this.deviceNote);
  }

  /** The lists of modes and of grounds. @returns {HTMLElement[]} */
  createModeControls() {
    const mode = createElement("select",
      { name: "show", onchange: () => { this.mode = mode.value; this.redraw(); } }, ...createOptions(MODES));
    const ground = createElement("select",
      { onchange: () => { this.ground = ground.value; this.redraw(); } },
      ...createOptions(Object.keys(this.scene.shading.reflectance)));
    [mode.value, ground.value] = [this.mode, this.ground];
    this.modeSelect = mode;
    return [createElement("label", {}, "Show ", mode), createElement("label", {}, "Ground ", ground)];
  }

  /** @param {Slider} slider @returns {HTMLElement} */
  createSlider(slider) {
    const output = createElement("output", {}, formatNumber(slider.start));
    const input = createRangeInput(slider, (value) => {
      this.sliderValues[slider.name] = value;
      output.textContent = formatNumber(value);
      this.updateState();
    });
    return createElement("label", {}, `${slider.name} `, output, input);
  }

  /** The material of the surfaces, and the radius of the tubes around the curves at which they end.
   *  @returns {HTMLElement[]} */
  createMaterialControls() {
    const { materials, material } = this.scene;
    const onChange = () => {
      if (select.value === ORIGINAL_MATERIAL) delete this.renderOptions.material;
      else this.renderOptions.material = select.value === PLAIN_COLOR ? color.value : select.value;
      color.hidden = select.value !== PLAIN_COLOR;
      this.updateState();
    };
    const isNamed = material !== null && materials.includes(material);
    const names = isNamed ? materials : [ORIGINAL_MATERIAL, ...materials];
    const select = createElement("select", { name: "material", onchange: onChange },
      ...createOptions([...names, PLAIN_COLOR]));
    select.value = isNamed ? material : ORIGINAL_MATERIAL;
    const color = createElement("input",
      { type: "color", name: "color", value: "#4682b4", hidden: true, oninput: onChange });
    color.setAttribute("aria-label", "Color");
    return [createElement("label", {}, "Material ", select, " ", color), ...this.createTubeControls()];
  }

  /** @returns {HTMLElement[]} */
  createTubeControls() {
    const { tube, reach, state } = this.scene;
    if (!state.curves.length || "boundary_radius" in this.sliderValues) return [];
    const output = createElement("output", {}, tube === null ? "none" : formatNumber(tube));
    const start = tube ?? 0;
    const slider = { name: "tube", low: 0, high: Math.max(0.1 * reach, start), start, step: null };
    const input = createRangeInput(slider, (value) => {
      this.renderOptions.boundary_radius = value || null;
      output.textContent = value ? formatNumber(value) : "none";
      this.updateState();
    });
    return [createElement("label", {}, "Radius of the edge's tube ", output, input)];
  }

  /** The volume that cuts the surfaces, and sliders of its parameters. @returns {HTMLElement[]} */
  createCutControls() {
    const sliders = createElement("div", { className: "cut" });
    const select = createElement("select", { name: "cut", onchange: () => {
      const parameters = Object.entries(CUT_PARAMETERS[select.value]);
      this.cutKind = select.value;
      this.cutParameters = Object.fromEntries(parameters.map(([name, [, , start]]) => [name, start]));
      sliders.replaceChildren(...parameters.map(([name, [low, high, start]]) => {
        const input = createRangeInput({ name, low, high, start, step: null }, (value) => {
          this.cutParameters[name] = value;
          this.updateState();
        });
        return createElement("label", {}, `${name} `, input);
      }));
      this.updateState();
    } }, ...createOptions(Object.keys(CUT_PARAMETERS)));
    return [createElement("label", {}, "Cut by ", select), sliders];
  }

  /** The size and the quality of pictures that Python renders, and the button for it. */
  createRenderControls() {
    const width = createElement("input", { type: "number", min: "16", max: "8192", value: "1600", name: "width" });
    const quality = createElement("select", { name: "quality" }, ...createOptions(["shaded", "path"]));
    const row = createElement("label", {}, "Render, pixels wide ", width, quality);
    return { row, button: createButton("Render", () => this.render(Number(width.value), quality.value)) };
  }

  /** Buttons that save and open scene files. @returns {HTMLElement[]} */
  createSceneFileControls() {
    const input = createElement("input", { type: "file", accept: ".json", hidden: true, name: "scene",
      onchange: () => { if (input.files?.[0]) this.openSceneFile(input.files[0]); input.value = ""; } });
    return [
      createButton("Save scene", () => this.saveScene()),
      createButton("Open scene", () => input.click()), input,
    ];
  }

  /** The volume that cuts the surfaces now, in their coordinates. @returns {CutVolume | null} */
  get cutVolume() {
    const { middle, reach } = this.scene;
    const { size, azimuth, elevation, offset } = this.cutParameters;
    if (this.cutKind === "ball") return { ball: [...middle, size * reach] };
    if (this.cutKind === "box") {
      const half = ["x", "y", "z"].map((axis) => reach * this.cutParameters[`size ${axis}`]);
      return { box: [...middle.map((x, k) => x - half[k]), ...middle.map((x, k) => x + half[k])] };
    }
    if (this.cutKind !== "plane") return null;
    const [a, b] = [azimuth, elevation].map((degrees) => degrees * Math.PI / 180);
    const normal = [Math.cos(b) * Math.cos(a), Math.cos(b) * Math.sin(a), Math.sin(b)];
    return { plane: [...normal, dot(normal, middle) + offset * reach] };
  }

  /** The state of the controls now. @returns {ControlValues} */
  get controlValues() {
    const { curves, isEdited } = this.curveEditor;
    return { sliders: { ...this.sliderValues }, loops: isEdited ? curves : null,
      cut: this.cutVolume, settings: { ...this.renderOptions } };
  }

  // Opening and closing.

  /** Starts to render, in this browser if its device passes the check. */
  async open() {
    if (!navigator.gpu) return this.useFallback("This browser has no WebGPU here (the page must come "
      + "from https, or from 127.0.0.1)");
    this.showMessage("Compiling the surface for this GPU ...");
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) return this.useFallback("No GPU was found for WebGPU");
    const device = await this.requestDevice(adapter);
    if (this.isClosed) return device.destroy();
    const renderer = new WebGpuRenderer(device, this.scene, this.canvas, this.passes);
    const failure = await this.prepareRenderer(renderer);
    if (this.isClosed) return device.destroy();
    if (failure) return this.useFallback(failure);
    this.startRenderer(renderer, adapter);
  }

  /** @param {GPUAdapter} adapter */
  async requestDevice(adapter) {
    const { maxStorageBufferBindingSize, maxBufferSize, maxStorageBuffersPerShaderStage } = adapter.limits;
    const device = await adapter.requestDevice({ requiredLimits: {
      maxStorageBufferBindingSize, maxBufferSize, maxStorageBuffersPerShaderStage } });
    device.lost.then(({ message }) => {
      if (!this.isClosed) this.useFallback(`The GPU was lost (${message})`);
    });
    device.addEventListener("uncapturederror", ({ error }) => console.error(error.message));
    return device;
  }

  /** Compiles the initial state and checks the device. Returns why that fails; empty if it does not.
   *  @param {WebGpuRenderer} renderer */
  async prepareRenderer(renderer) {
    try {
      await renderer.compile();
      const failure = await renderer.setState(this.scene.state);
      return failure && describeFailedCheck(failure);
    } catch (error) {
      return `This GPU cannot compile the surface (${error})`;
    }
  }

  /** Renders in this browser from now on. @param {WebGpuRenderer} renderer @param {GPUAdapter} adapter */
  startRenderer(renderer, adapter) {
    this.renderer = renderer;
    this.canvas.addEventListener("depthrange", () => this.updateLegend());
    this.showMessage("");
    const { vendor = "", architecture = "", description = "" } = adapter.info ?? {};
    const name = description || `${vendor} ${architecture}`.trim() || "this browser's device";
    const rayCount = this.scene.state.surfaces.reduce((sum, { check }) => sum + (check?.count ?? 0), 0);
    this.showDevice(`Traced by ${name}: ${rayCount} rays agree with Dr.Jit's.`);
    this.listen(this.canvas);
    this.observeSize(this.canvas, () => renderer.resize());
    this.updateMarks();
    renderer.resize();
    if (this.channel?.request)
      this.canvas.addEventListener("wholepicture", () => this.chooseRenderer(), { once: true });
  }

  /** @param {HTMLElement} target @param {() => void} onResize */
  observeSize(target, onResize) {
    const observer = new ResizeObserver(onResize);
    observer.observe(target);
    this.observers.push(observer);
  }

  /** Stops drawing, and frees the device. */
  close() {
    this.isClosed = true;
    for (const observer of this.observers) observer.disconnect();
    clearTimeout(this.recheckTimer);
    this.renderer?.stop();
    this.renderer?.device.destroy();
    this.renderer = undefined;
    this.isRemote = false;
    this.root.replaceChildren();
  }

  /** Replaces this panel by one of another scene. @param {Scene} scene */
  replaceScene(scene) {
    this.close();
    const panel = new Panel(this.root, scene, this.passes, this.channel, "");
    this.root.dispatchEvent(new CustomEvent("panel", { detail: panel }));
    panel.open();
  }

  /** Lets the camera and the curves follow mouse, touch and keys. @param {HTMLElement} target */
  listen(target) {
    this.camera.listen(target, () => this.redraw(), (event) => this.pressPointer(event));
    target.addEventListener("pointermove", (event) => this.curveEditor.dragPoint(event));
    target.addEventListener("pointerup", (event) => this.releasePointer(event));
    target.addEventListener("dblclick", (event) => this.handleDoubleClick(event));
    target.addEventListener("keydown", (event) => { if (this.scene.editable) this.curveEditor.handleKey(event); });
  }

  /** The camera of the renderer; or, where Python renders, that of the panel. @returns {Camera} */
  get camera() {
    if (this.renderer) return this.renderer.camera;
    this.remoteCamera ??= new Camera(this.scene.camera);
    return this.remoteCamera;
  }

  // The choice of a renderer.

  /** Does without a device that can be trusted: Python renders, or a still picture is shown.
   *  @param {string} reason */
  useFallback(reason) {
    if (this.channel?.request) return this.useRemoteRenderer(`${reason}: Python draws.`);
    this.renderer?.stop();
    this.renderer = undefined;
    this.showMessage(`${reason}: this is a still picture.`, false);
  }

  /** Lets Python render from now on. @param {string} message */
  useRemoteRenderer(message) {
    this.showDevice("Traced by Python.");
    const { camera } = this;
    this.renderer?.stop();
    this.renderer = undefined;
    this.remoteCamera = camera;
    this.isRemote = true;
    this.remoteCanvas.style.display = "";
    this.showMessage(message, false);
    this.listen(this.remoteCanvas);
    this.observeSize(this.root, () => this.redraw());
    this.redraw();
  }

  /** Lets Python render if it is faster than the device of this browser. */
  async chooseRenderer() {
    const { renderer } = this;
    if (!renderer || !this.channel?.request) return;
    const pixelCount = (this.root.clientWidth * this.root.clientHeight) / 16;
    let duration = 0;
    try {
      for (let k = 0; k < 2; k++) {  // the first picture compiles kernels
        const start = performance.now();
        await this.fetchPreview(0.25, false);
        duration = performance.now() - start;
      }
    } catch (error) {
      return this.showMessage(/** @type {Error} */ (error).message);
    }
    if (pixelCount / duration > MIN_SPEEDUP * renderer.pixelsPerMillisecond && renderer === this.renderer)
      this.useRemoteRenderer("Python draws: it is quicker here than this browser's device.");
  }

  /** Shows which device traces. @param {string} text */
  showDevice(text) { if (this.deviceNote) this.deviceNote.textContent = text; }

  // The attributes of a notebook widget.

  /** The attributes of a notebook widget that a person can change. */
  get attributes() {
    const { camera, placement } = this;
    return {
      camera: {
        position: placement.fromStage(camera.position), target: placement.fromStage(camera.target), fov: camera.fov,
      },
      sliders: { ...this.sliderValues }, points: this.curveEditor.curves, show: this.mode,
    };
  }

  /** Reports changed attributes by an event, at most once a frame. */
  reportAttributes() {
    if (this.isReportDue) return;
    this.isReportDue = true;
    requestAnimationFrame(() => {
      this.isReportDue = false;
      if (this.isClosed) return;
      const changes = Object.entries(this.attributes).filter(
        ([name, value]) => JSON.stringify(value) !== this.reportedAttributes[name]);
      for (const [name, value] of changes) this.reportedAttributes[name] = JSON.stringify(value);
      if (changes.length)
        this.root.dispatchEvent(new CustomEvent("attributes", { detail: Object.fromEntries(changes) }));
    });
  }

  /** Applies attributes that were changed in Python, and are not those that were reported.
   *  @param {{camera?: {position: number[], target: number[], fov: number},
   *  sliders?: Record<string, number>, points?: Curves, show?: string}} attributes */
  applyAttributes(attributes) {
    for (const [name, value] of Object.entries(attributes)) {
      if (JSON.stringify(value) === this.reportedAttributes[name]) continue;
      this.reportedAttributes[name] = JSON.stringify(value);
      if (name === "camera") {
        const { position, target, fov } = /** @type {any} */ (value);
        this.camera.lookAt(this.placement.toStage(position), this.placement.toStage(target), fov);
        this.redraw();
      } else if (name === "show") {
        this.mode = /** @type {string} */ (value);
        if (this.modeSelect) this.modeSelect.value = this.mode;
        this.redraw();
      } else if (name === "points") this.scene.editable && this.curveEditor.edit(/** @type {Curves} */ (value));
      else this.moveSliders(/** @type {Record<string, number>} */ (value));
    }
  }

  /** Moves sliders, and what they change. @param {Record<string, number>} values */
  moveSliders(values) {
    Object.assign(this.sliderValues, values);
    for (const [name, value] of Object.entries(values)) {
      const input = this.controls.querySelector(`input[name="${CSS.escape(name)}"]`);
      if (!(input instanceof HTMLInputElement)) continue;
      input.value = String(value);
      const output = input.parentElement?.querySelector("output");
      if (output) output.textContent = formatNumber(value);
    }
    this.updateState();
  }

  // Drawing.

  /** Shows what the colors of the picture mean. */
  updateLegend() {
    const legend = this.scene.legends[this.mode];
    const range = this.renderer ? this.renderer.depthRange : this.remoteDepthRange;
    const { scale } = this.placement;
    const elements = legend && (this.renderer || this.isRemote) ? [createLegend(
      legend, range && [range[0] / scale, range[1] / scale],
      this.scene.shading.css_background[this.ground])] : [];
    this.legend.replaceChildren(...elements);
  }

  /** Draws again, after anything has changed. */
  redraw() {
    const { renderer } = this;
    this.reportAttributes();
    this.updateLegend();
    if (!renderer) { if (this.isRemote) this.drawRemotely(); return; }
    renderer.mode = this.mode;
    renderer.lines = this.lines;
    renderer.dots = this.dots;
    renderer.ground = this.ground;
    renderer.draw();
  }

  /** Draws pictures by Python: coarse ones (step 0) while something moves; then a whole one with
   *  the last shadow (step 1), and one with its own shadow (step 2). */
  async drawRemotely() {
    this.isPictureDue = true;
    if (this.isFetching) return;
    this.isFetching = true;
    try {
      for (let step = 0; this.isPictureDue || step < 3; step++) {
        if (this.isPictureDue) step = 0;
        this.isPictureDue = false;
        const start = performance.now();
        const { image, range } = await this.fetchPreview(step ? 1 : this.coarseScale, step === 2);
        if (this.mode === "depth") this.remoteDepthRange = range;
        this.updateLegend();
        this.showImage(image);
        if (step === 1 && this.mode !== "shaded") step = 2;  // no shadow
        if (!step) this.coarseScale = adaptScale(this.coarseScale, performance.now() - start);
      }
      this.remoteCanvas.dispatchEvent(new Event("idle"));
    } catch (error) {
      this.showMessage(/** @type {Error} */ (error).message, false);
    } finally {
      this.isFetching = false;
    }
  }

  /** Shows a picture of any size, and lines and dots in front of it. @param {ImageData} image */
  showImage(image) {
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    this.imageCanvas.width = image.width;
    this.imageCanvas.height = image.height;
    this.imageCanvas.getContext("2d")?.putImageData(image, 0, 0);
    this.remoteCanvas.width = width;
    this.remoteCanvas.height = height;
    const context = this.remoteCanvas.getContext("2d");
    if (!context) return;
    context.drawImage(this.imageCanvas, 0, 0, width, height);
    this.drawMarks(context, width, height);
  }

  /** Draws lines and dots. @param {CanvasRenderingContext2D} context @param {number} width
   *  @param {number} height */
  drawMarks(context, width, height) {
    const { camera } = this;
    const project = (/** @type {number[]} */ point) => camera.project(point, width, height);
    for (const marks of this.lines) {
      context.strokeStyle = cssColor(marks.color);
      context.lineWidth = marks.width;
      context.beginPath();
      marks.points.map(project).forEach(({ x, y }, k) => (k % 2 ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.stroke();
    }
    for (const marks of this.dots) {
      context.fillStyle = cssColor(marks.color);
      for (const { x, y } of marks.points.map(project)) {
        context.beginPath();
        context.arc(x, y, 0.5 * marks.width, 0, 7);
        context.fill();
      }
    }
  }

  /** Fetches a picture by Python, with one ray in each pixel.
   *  @param {number} scale relative to the window @param {boolean} isIdle whether nothing moves, so
   *  that it gets its own shadow @returns {Promise<{image: ImageData, range: [number, number]}>} */
  fetchPreview(scale, isIdle) {
    const { camera } = this;
    const size = [this.root.clientWidth, this.root.clientHeight].map((x) => Math.max(8, Math.round(scale * x)));
    const eye = { origin: camera.position, ...camera.axes, pixel: camera.pixelSize(size[0], size[1]) };
    return /** @type {any} */ (this.channel).request("draw", {
      ...this.controlValues, size, show: this.mode, ground: this.ground, eye, is_idle: isIdle,
    });
  }

  // Pictures and scene files.

  /** The request for a picture of what the window shows. @param {number} width in pixels */
  renderRequest(width) {
    const { camera } = this;
    const aspectRatio = this.root.clientHeight / this.root.clientWidth;
    const size = [width, Math.max(1, Math.round(width * aspectRatio))];
    // Python takes the angle of the larger side; that of the camera is of a 4 : 3 picture.
    const tangent = 0.5 * camera.pixelSize(size[0], size[1]) * Math.max(size[0], size[1]);
    return {
      ...this.controlValues, size, show: this.mode, ground: this.ground,
      camera: { position: camera.position, target: camera.target, fov: (360 / Math.PI) * Math.atan(tangent) },
    };
  }

  /** The address of a picture by Python of what the window shows.
   *  @param {number} width @param {string} [quality] "shaded" or "path" */
  async fetchPicture(width, quality = "shaded") {
    const request = this.renderRequest(width);
    const show = quality === "path" && request.show === "shaded" ? "path" : request.show;
    const bar = createElement("progress", { max: 1, value: 0 });
    const { png } = await /** @type {Channel} */ (this.channel).request?.("picture", { ...request, show },
      (completed, cancel) => {
        if (!bar.isConnected) {
          this.showMessage("Rendering ");
          this.message.append(bar, " ", createButton("Cancel", cancel));
        }
        bar.value = completed;
      });
    return `data:image/png;base64,${png}`;
  }

  /** Saves a picture by Python. @param {number} width @param {string} quality */
  render(width, quality) {
    return this.showErrors(async () => {
      download(await this.fetchPicture(width, quality), "surface.png");
      this.showMessage("");
    });
  }

  /** Saves the picture on the canvas. */
  savePicture() {
    this.renderer?.present(...(/** @type {[number, number]} */ (this.renderer.presentedSize)));
    this.canvas.toBlob((blob) => { if (blob) downloadBlob(blob, "surface.png"); });
  }

  /** Saves what the window shows as a scene file. */
  saveScene() {
    return this.showErrors(async () => {
      const { text, lost } = await this.channel?.request?.("save", this.renderRequest(800));
      downloadBlob(new Blob([text], { type: "application/json" }), "scene.json");
      this.showMessage(lost.length ? `Saved as it stands: a file cannot hold the sliders ${lost.join(", ")}.` : "");
    });
  }

  /** Opens a scene file in this window. @param {File} file */
  openSceneFile(file) {
    return this.showErrors(async () => this.replaceScene(
      await this.channel?.request?.("load", { text: await file.text() })));
  }

  // States.

  /** The state at the values of the controls. @param {Channel} channel
   *  @param {boolean} checks whether it comes with rays that check the device */
  async fetchState(channel, checks) {
    return applyDelta(this.scene.state, await channel.fetchDelta({ ...this.controlValues, checks }));
  }

  /** Gets the state at the values of the controls. States are requested one after the other; those
   *  in between may be left out, but never the last one. */
  async updateState() {
    this.isUpdateDue = true;
    if (this.isUpdating || !this.channel) return;
    this.isUpdating = true;
    try {
      while (this.isUpdateDue) {
        this.isUpdateDue = false;
        if (this.isRemote) { this.updateMarks(); continue; }
        const state = await this.fetchState(this.channel, false);
        if (!this.renderer) continue;
        const failure = await this.renderer.setState(state, state.surfaces.some(({ check }) => check));
        if (failure) return this.useFallback(describeFailedCheck(failure));
        // The state may be older than the last edit.
        if (!this.curveEditor.isEdited) this.curveEditor.curves = state.curves;
        this.showMessage("");
        this.updateMarks();
      }
    } catch (error) {
      this.showMessage(/** @type {Error} */ (error).message);
    } finally {
      this.isUpdating = false;
    }
    if (!this.channel.request) return;
    clearTimeout(this.recheckTimer);
    this.recheckTimer = setTimeout(() => this.recheckDevice(), IDLE_TIME);
  }

  /** Checks the device for the present state. */
  async recheckDevice() {
    if (this.isUpdating || !this.renderer || !this.channel) return;
    const controlValues = JSON.stringify(this.controlValues);
    try {
      const state = await this.fetchState(this.channel, true);
      if (this.isUpdating || !this.renderer || JSON.stringify(this.controlValues) !== controlValues) return;
      const failure = await this.renderer.setState(state);
      if (failure) this.useFallback(describeFailedCheck(failure));
      else this.redraw();
    } catch (error) {
      this.showMessage(/** @type {Error} */ (error).message);
    }
  }

  /** Draws the curves and their points while they are edited, and the marks of the last probe. */
  updateMarks() {
    [this.lines, this.dots] = this.curveEditor.createMarks();
    // Wide marks of a probe are dots.
    this.lines.push(...this.probeMarks.filter(({ width }) => width < 4));
    this.dots.push(...this.probeMarks.filter(({ width }) => width >= 4));
    this.redraw();
  }

  // Pointers.

  /** The position of a pointer in the window, and the size of this. @param {MouseEvent} event */
  pointerPosition(event) {
    const { left, top, width, height } = this.root.getBoundingClientRect();
    return { width, height, x: event.clientX - left, y: event.clientY - top };
  }

  /** The ray through a pointer, in the coordinates of the surfaces. @param {MouseEvent} event */
  pointerRay(event) {
    const { width, height, x, y } = this.pointerPosition(event);
    const { camera, placement } = this;
    const { right, up, forward } = camera.axes;
    const pixelSize = camera.pixelSize(width, height);
    const direction = addScaled(
      addScaled(forward, pixelSize * (x - 0.5 * width), right), -pixelSize * (y - 0.5 * height), up);
    return { origin: placement.fromStage(camera.position), direction: placement.vectorFromStage(direction) };
  }

  /** Asks Python for the hit of the ray through a pointer, and draws the proved steps to it.
   *  @param {MouseEvent} event */
  probe(event) {
    const { origin, direction } = this.pointerRay(event);
    return this.showErrors(async () => {
      const hit = await this.channel?.request?.("probe", { ...this.controlValues, origin, direction });
      const length = Math.hypot(...direction);
      const distances = [...hit.steps, ...(hit.t === undefined ? [] : [hit.t])];
      const points = distances.map((t) => this.placement.toStage(addScaled(origin, t / length, direction)));
      this.probeMarks = [
        { points: points.slice(1).flatMap((p, k) => [points[k], p]), color: [0.1, 0.4, 0.9, 0.9], width: 2 },
        { points: points.slice(1), color: [0.1, 0.4, 0.9, 1], width: 5 },
      ];
      this.showMessage(describeHit(hit));
      this.updateMarks();
    });
  }

  /** Starts to drag a point, if one is at the pointer. Returns whether one is.
   *  @param {PointerEvent} event */
  pressPointer(event) {
    this.pressEvent = event;
    return this.curveEditor.grabPoint(event);
  }

  /** Ends a drag; probes the surface after a click. @param {PointerEvent} event */
  releasePointer(event) {
    const { pressEvent } = this;
    if (this.isProbing && pressEvent && Math.hypot(
      event.clientX - pressEvent.clientX, event.clientY - pressEvent.clientY) < CLICK_RADIUS) this.probe(event);
    this.curveEditor.releasePoint();
  }

  /** Inserts a point while curves are edited, and resets the camera otherwise.
   *  @param {MouseEvent} event */
  handleDoubleClick(event) {
    if (this.curveEditor.isActive) this.curveEditor.insertPoint(event);
    else { this.camera.reset(); this.redraw(); }
  }
}

/** A message about a device that fails the check. @param {string} failure */
function describeFailedCheck(failure) {
  return `This GPU does not compute what the surface was proved with: ${failure}`;
}

/** A color of CSS. @param {number[]} color red, green, blue and opacity, from 0 to 1 */
function cssColor(color) {
  return `rgb(${color.slice(0, 3).map((x) => Math.round(255 * x)).join(" ")} / ${0.7 * color[3]})`;
}

/** The answer to a probe, in words. @param {any} hit */
function describeHit(hit) {
  const evaluations = `${hit.evaluations} evaluations`;
  if (hit.t === undefined) return `${hit.status.toLowerCase().replaceAll("_", " ")}, ${evaluations}`;
  const formatPoint = (/** @type {number[]} */ p) => `(${p.map(formatNumber).join(", ")})`;
  const value = hit.triangle === undefined ? `f = ${formatNumber(hit.value)}`
    : `on triangle ${hit.triangle}, where f jumps`;
  const curvature = hit.mean === undefined ? ""
    : `, mean curvature ${formatNumber(hit.mean)}, Gaussian ${formatNumber(hit.gaussian)}`;
  return `at ${formatPoint(hit.position)}, normal ${formatPoint(hit.normal)}, ${value}${curvature}, ${evaluations}`;
}
