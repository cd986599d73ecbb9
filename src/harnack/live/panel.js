// The window: a canvas, what is said of it, and the controls beside it.
// @ts-check

import { Camera, add_scaled, dot } from "./camera.js";
import { Drawing, FRAME_TIME, SHOWS } from "./drawing.js";
import { element, format } from "./elements.js";
import { changed } from "./frames.js";
import { legend_of } from "./legend.js";

/** @import {Marks, Scene, Slider} from "./drawing.js" */
/** @import {Change} from "./frames.js" */
/** What brings other states, and in a view with Python behind it what else can be asked for.
 * @typedef {{
 *   change(wanted: {sliders: Record<string, number>, loops: number[][][] | null, cut: Cut | null,
 *     settings: Settings, checks: boolean}): Promise<Change>,
 *   ask?(kind: string, given: object, on_progress?: (done: number, stop: () => void) => void): Promise<any>,
 * }} Link */
/** Settings of `harnack.render` that are changed here: see `CONTROLLED` in harnack.live.live_scene.
 * @typedef {{material?: string, boundary?: number | null}} Settings */
/** A volume that cuts all surfaces: see `harnack.live.session`.
 * @typedef {{ball?: number[], box?: number[], plane?: number[]}} Cut */

const GROUNDS = { light: [0.74, 0.73, 0.715], dark: [0.055, 0.058, 0.065] };
// What cuts the surfaces, and the numbers of it: from, to, at first.
/** @type {Record<string, Record<string, number[]>>} */
const CUTS = {
  none: {},
  ball: { size: [0.02, 1.05, 0.8] },
  box: { "size x": [0.02, 1.05, 0.6], "size y": [0.02, 1.05, 0.6], "size z": [0.02, 1.05, 0.6] },
  plane: { azimuth: [-180, 180, -60], elevation: [-90, 90, 20], offset: [-1, 1, 0] },
};
const CURVE = [0.95, 0.75, 0.2, 1];
// Pixels within which a pointer takes a point.
const PICK_RADIUS = 12;
// Milliseconds after which nothing moves any more.
const IDLE_TIME = 400;

export class Panel {
  /** @param {HTMLElement} root @param {Scene} scene @param {string} passes @param {Link | null} link
   *  @param {string} still a picture for where there is no GPU */
  constructor(root, scene, passes, link, still) {
    this.root = root;
    this.scene = scene;
    this.passes = passes;
    this.link = link;
    /** @type {Record<string, number>} */
    this.values = Object.fromEntries(scene.sliders.map((one) => [one.name, one.start]));
    this.curves = scene.state.curves;
    /** @type {number[][][][]} */
    this.undo_stack = [];
    /** @type {number[][][][]} */
    this.redo_stack = [];
    this.edited = false;
    this.editing = false;
    this.probing = false;
    /** The least and the greatest depth of the last picture by Python, on the stage.
     *  @type {[number, number] | null} */
    this.depth_range = null;
    /** @type {Camera | undefined} */
    this.own_camera = undefined;
    this.show = scene.show;
    /** What was last reported of each attribute. @type {Record<string, string>} */
    this.reported = {};
    this.is_report_due = false;
    this.ground = scene.ground[0] < 0.3 ? "dark" : "light";
    /** @type {Marks[]} */
    this.probe_marks = [];
    /** @type {Settings} */
    this.settings = {};
    this.cut_kind = "none";
    /** @type {Record<string, number>} */
    this.cut_numbers = {};
    /** @type {ResizeObserver[]} */
    this.observers = [];
    /** @type {[number, number] | null} */
    this.selected_point = null;
    root.classList.add("harnack");
    this.canvas = element("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label",
      `${scene.title}. Drag or use the arrow keys to turn it, the wheel or + and - to come closer.`);
    this.still = element("img", { alt: scene.title, src: still });
    this.message = element("p", { className: "message" });
    this.message.setAttribute("role", "status");
    this.controls = this.build();
    this.remote_canvas = element("canvas", { tabIndex: 0, className: "remote" });
    this.remote_canvas.style.display = "none";
    this.image_canvas = document.createElement("canvas");
    this.scale = 0.25;
    this.pictures = 0;
    /** @type {Marks[]} */
    this.lines = [];
    /** @type {Marks[]} */
    this.dots = [];
    this.legend = element("div");
    const notes = element("div", { className: "notes" }, this.legend, this.message);
    root.append(this.still, this.canvas, this.remote_canvas, notes, this.controls);
  }

  /** @param {string} words @param {boolean} [is_drawn] */
  show_message(words, is_drawn = this.drawing !== undefined) {
    this.message.textContent = words;
    this.canvas.style.visibility = is_drawn ? "visible" : "hidden";
    this.still.style.display = is_drawn || this.is_remote ? "none" : "";
    this.root.dataset.state = is_drawn ? "drawn" : words ? "message" : "";
  }

  build() {
    const { scene } = this;
    const show = element("select", { name: "show", onchange: () => { this.show = show.value; this.redraw(); } },
      ...SHOWS.map((name) => element("option", { value: name }, name)));
    const ground = element("select", { onchange: () => { this.ground = ground.value; this.redraw(); } },
      ...Object.keys(GROUNDS).map((name) => element("option", { value: name }, name)));
    [show.value, ground.value] = [this.show, this.ground];
    this.show_select = show;
    /** @type {HTMLElement[]} */
    const rows = [
      element("label", {}, "Show ", show), element("label", {}, "Ground ", ground),
      ...scene.sliders.map((one) => this.slider(one)),
    ];
    /** @type {HTMLElement[]} */
    const buttons = [this.button("Reset view", () => { this.camera().reset(); this.redraw(); })];
    if (scene.editable) {
      const edit = element("input", { type: "checkbox", onchange: () => {
        this.editing = edit.checked;
        this.selected_point = null;
        this.update_marks();
      } });
      rows.push(element("label", {}, edit, " Edit points"));
      buttons.push(
        this.button("Undo", () => this.undo(this.undo_stack, this.redo_stack)),
        this.button("Redo", () => this.undo(this.redo_stack, this.undo_stack)),
        this.button("Smooth", () => this.edit(this.curves.map(smoothed))),
      );
    }
    buttons.push(this.button("Save picture", () => this.save()));
    if (this.link?.ask) {
      const probe = element("input", { type: "checkbox", onchange: () => {
        this.probing = probe.checked;
        this.probe_marks = [];
        this.update_marks();
      } });
      rows.push(element("label", {}, probe, " Probe by click"));
      rows.push(...this.material_controls(), ...this.cut_controls());
      const width = element("input", { type: "number", min: "16", max: "8192", value: "1600", name: "width" });
      const quality = element("select", { name: "quality" },
        ...["shaded", "path"].map((name) => element("option", { value: name }, name)));
      rows.push(element("label", {}, "Render, pixels wide ", width, quality));
      const file = element("input", { type: "file", accept: ".json", hidden: true, name: "scene",
        onchange: () => { if (file.files?.[0]) this.load(file.files[0]); file.value = ""; } });
      buttons.push(
        this.button("Render", () => this.render(Number(width.value), quality.value)),
        this.button("Save scene", () => this.save_scene()),
        this.button("Open scene", () => file.click()), file,
      );
    }
    this.buttons = element("div", { className: "buttons" }, ...buttons);
    this.device_note = element("small");
    return element("details", { open: innerWidth > 600 && scene.sliders.length > 0 },
      element("summary", {}, "Controls"), ...rows, this.buttons, this.device_note);
  }

  /** What the surfaces are made of, and how thick the tubes around the curves are at which they end. */
  material_controls() {
    const { materials, material, tube, reach, state } = this.scene;
    const [GIVEN, COLOR] = ["as given", "color"];
    const set = () => {
      if (select.value === GIVEN) delete this.settings.material;
      else this.settings.material = select.value === COLOR ? color.value : select.value;
      color.hidden = select.value !== COLOR;
      this.change();
    };
    const names = material && materials.includes(material) ? materials : [GIVEN, ...materials];
    const select = element("select", { name: "material", onchange: set },
      ...[...names, COLOR].map((name) => element("option", { value: name }, name)));
    select.value = material && materials.includes(material) ? material : GIVEN;
    const color = element("input", { type: "color", name: "color", value: "#4682b4", hidden: true, oninput: set });
    color.setAttribute("aria-label", "Color");
    const rows = [element("label", {}, "Material ", select, " ", color)];
    if (!state.curves.length || "boundary" in this.values) return rows;
    const shown = element("output", {}, tube === null ? "none" : format(tube));
    const radius = element("input", {
      type: "range", min: "0", max: String(Math.max(0.1 * reach, tube ?? 0)), step: "any",
      name: "tube", value: String(tube ?? 0),
      oninput: () => {
        this.settings.boundary = Number(radius.value) || null;
        shown.textContent = this.settings.boundary === null ? "none" : format(this.settings.boundary);
        this.change();
      },
    });
    return [...rows, element("label", {}, "Radius of the edge's tube ", shown, radius)];
  }

  /** What cuts the surfaces, and sliders of it. */
  cut_controls() {
    const numbers = element("div", { className: "cut" });
    const chosen = element("select", { name: "cut", onchange: () => {
      this.cut_kind = chosen.value;
      this.cut_numbers = Object.fromEntries(
        Object.entries(CUTS[chosen.value]).map(([name, ends]) => [name, ends[2]]));
      numbers.replaceChildren(...Object.entries(CUTS[chosen.value]).map(([name, [low, high, start]]) => {
        const input = element("input", {
          type: "range", min: String(low), max: String(high), step: "any", name, value: String(start),
          oninput: () => { this.cut_numbers[name] = Number(input.value); this.change(); },
        });
        return element("label", {}, `${name} `, input);
      }));
      this.change();
    } }, ...Object.keys(CUTS).map((name) => element("option", { value: name }, name)));
    return [element("label", {}, "Cut by ", chosen), numbers];
  }

  /** What cuts the surfaces now, in their coordinates. @returns {Cut | null} */
  cut() {
    const { middle, reach } = this.scene;
    const { size, azimuth, elevation, offset } = this.cut_numbers;
    if (this.cut_kind === "ball") return { ball: [...middle, size * reach] };
    if (this.cut_kind === "box") {
      const half = ["x", "y", "z"].map((axis) => reach * this.cut_numbers[`size ${axis}`]);
      return { box: [...middle.map((x, k) => x - half[k]), ...middle.map((x, k) => x + half[k])] };
    }
    if (this.cut_kind !== "plane") return null;
    const [a, b] = [azimuth, elevation].map((degrees) => degrees * Math.PI / 180);
    const normal = [Math.cos(b) * Math.cos(a), Math.cos(b) * Math.sin(a), Math.sin(b)];
    return { plane: [...normal, dot(normal, middle) + offset * reach] };
  }

  /** @param {string} name @param {() => void} onclick */
  button(name, onclick) { return element("button", { type: "button", onclick }, name); }

  /** @param {Slider} one */
  slider(one) {
    const shown = element("output", {}, format(one.start));
    const input = element("input", {
      type: "range", min: String(one.low), max: String(one.high),
      step: one.step === null ? "any" : String(one.step), name: one.name, value: String(one.start),
      oninput: () => {
        this.values[one.name] = Number(input.value);
        shown.textContent = format(Number(input.value));
        this.change();
      },
    });
    return element("label", {}, `${one.name} `, shown, input);
  }

  async open() {
    if (!navigator.gpu) return this.fall_back("This browser has no WebGPU here (the page must come "
      + "from https, or from 127.0.0.1)");
    this.show_message("Compiling the surface for this GPU ...");
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) return this.fall_back("No GPU was found for WebGPU");
    const { maxStorageBufferBindingSize, maxBufferSize, maxStorageBuffersPerShaderStage } = adapter.limits;
    const device = await adapter.requestDevice({ requiredLimits: {
      maxStorageBufferBindingSize, maxBufferSize, maxStorageBuffersPerShaderStage } });
    device.lost.then((e) => { if (!this.is_closed) this.fall_back(`The GPU was lost (${e.message})`); });
    device.addEventListener("uncapturederror", (e) => console.error(e.error.message));
    if (this.is_closed) return device.destroy();
    const drawing = new Drawing(device, this.scene, this.canvas, this.passes);
    try {
      await drawing.compile();
      const wrong = await drawing.set(this.scene.state);
      if (this.is_closed) return device.destroy();
      if (wrong) return this.fall_back(`This GPU does not compute what the surface was proved with: ${wrong}`);
    } catch (wrong) {
      if (this.is_closed) return device.destroy();
      return this.fall_back(`This GPU cannot compile the surface (${wrong})`);
    }
    this.drawing = drawing;
    this.canvas.addEventListener("range", () => this.update_legend());
    this.show_message("");
    const { vendor = "", architecture = "", description = "" } = adapter.info ?? {};
    const name = description || `${vendor} ${architecture}`.trim() || "this browser's device";
    const rays = this.scene.state.surfaces.reduce((sum, one) => sum + (one.check?.count ?? 0), 0);
    this.show_device(`Traced by ${name}: ${rays} rays agree with Dr.Jit's.`);
    this.listen(this.canvas);
    this.observe(this.canvas, () => drawing.resize());
    this.update_marks();
    drawing.resize();
    if (this.link?.ask) this.canvas.addEventListener("full_picture", () => this.choose_renderer(), { once: true });
  }

  /** @param {HTMLElement} target @param {() => void} handler */
  observe(target, handler) {
    const one = new ResizeObserver(handler);
    one.observe(target);
    this.observers.push(one);
  }

  /** Draws no more, and frees the device. */
  close() {
    this.is_closed = true;
    for (const one of this.observers) one.disconnect();
    clearTimeout(this.recheck_timer);
    this.drawing?.stop();
    this.drawing?.device.destroy();
    this.drawing = undefined;
    this.is_remote = false;
    this.root.replaceChildren();
  }

  /** Shows another scene in this place. @param {Scene} scene */
  replace(scene) {
    this.close();
    const next = new Panel(this.root, scene, this.passes, this.link, "");
    this.root.dispatchEvent(new CustomEvent("panel", { detail: next }));
    next.open();
  }

  /** @param {HTMLElement} target */
  listen(target) {
    this.camera().listen(target, () => this.redraw(), (e) => this.grab_point(e));
    target.addEventListener("pointermove", (e) => this.drag(e));
    target.addEventListener("pointerup", (e) => this.release(e));
    target.addEventListener("dblclick", (e) => this.insert(e));
    target.addEventListener("keydown", (e) => this.key(e));
  }

  /** @returns {Camera} */
  camera() {
    if (this.drawing) return this.drawing.camera;
    this.own_camera ??= new Camera(this.scene.camera);
    return this.own_camera;
  }

  /** Without a GPU that can be trusted: Python draws, where it is; else a picture stands still.
   *  @param {string} why */
  fall_back(why) {
    if (this.link?.ask) return this.let_python_draw(`${why}: Python draws.`);
    this.drawing?.stop();
    this.drawing = undefined;
    this.show_message(`${why}: this is a still picture.`, false);
  }

  /** Says who traces. @param {string} words */
  show_device(words) { if (this.device_note) this.device_note.textContent = words; }

  /** @param {string} why */
  let_python_draw(why) {
    this.show_device("Traced by Python.");
    const camera = this.camera();
    this.drawing?.stop();
    this.drawing = undefined;
    this.own_camera = camera;
    this.is_remote = true;
    this.remote_canvas.style.display = "";
    this.show_message(why, false);
    this.listen(this.remote_canvas);
    this.observe(this.root, () => this.redraw());
    this.redraw();
  }

  /** What a person has moved, as the attributes of a notebook's widget have it. */
  attributes() {
    const camera = this.camera();
    return {
      camera: { position: this.from_stage(camera.eye()), target: this.from_stage(camera.target), fov: camera.fov },
      sliders: { ...this.values }, points: this.curves, show: this.show,
    };
  }

  /** Tells those who listen what has been moved, once a frame at most. */
  report() {
    if (this.is_report_due) return;
    this.is_report_due = true;
    requestAnimationFrame(() => {
      this.is_report_due = false;
      if (this.is_closed) return;
      const now = this.attributes();
      const changed = Object.fromEntries(Object.entries(now).filter(
        ([name, value]) => JSON.stringify(value) !== this.reported[name]));
      for (const [name, value] of Object.entries(changed)) this.reported[name] = JSON.stringify(value);
      if (Object.keys(changed).length)
        this.root.dispatchEvent(new CustomEvent("attributes", { detail: changed }));
    });
  }

  /** Moves what somebody else than the person has moved.
   *  @param {{camera?: {position: number[], target: number[], fov: number},
   *  sliders?: Record<string, number>, points?: number[][][], show?: string}} given */
  apply_attributes(given) {
    for (const [name, value] of Object.entries(given)) {
      if (JSON.stringify(value) === this.reported[name]) continue;
      this.reported[name] = JSON.stringify(value);
      if (name === "camera") {
        const { position, target, fov } = /** @type {any} */ (value);
        this.camera().look_at(this.to_stage(position), this.to_stage(target), fov);
        this.redraw();
      } else if (name === "show") {
        this.show = /** @type {string} */ (value);
        if (this.show_select) this.show_select.value = this.show;
        this.redraw();
      } else if (name === "points") this.scene.editable && this.edit(/** @type {number[][][]} */ (value));
      else this.move_sliders(/** @type {Record<string, number>} */ (value));
    }
  }

  /** Moves sliders. @param {Record<string, number>} values */
  move_sliders(values) {
    Object.assign(this.values, values);
    for (const [name, value] of Object.entries(values)) {
      const input = this.controls.querySelector(`input[name="${CSS.escape(name)}"]`);
      if (!(input instanceof HTMLInputElement)) continue;
      input.value = String(value);
      const shown = input.parentElement?.querySelector("output");
      if (shown) shown.textContent = format(value);
    }
    this.change();
  }

  /** Shows what the colors of the picture mean. */
  update_legend() {
    const legend = this.scene.legends[this.show];
    const range = this.drawing ? this.drawing.depth_range : this.depth_range;
    const scale = this.scene.placement[12];
    const made = legend && (this.drawing || this.is_remote) ? [legend_of(
      legend, range && [range[0] / scale, range[1] / scale],
      this.ground === "dark" ? "#1a1a1c" : "#e6e6e3")] : [];
    this.legend.replaceChildren(...made);
  }

  redraw() {
    const { drawing } = this;
    this.report();
    this.update_legend();
    if (!drawing) { if (this.is_remote) this.draw_remotely(); return; }
    drawing.show = this.show;
    drawing.lines = this.lines;
    drawing.dots = this.dots;
    drawing.ground = GROUNDS[/** @type {"light" | "dark"} */ (this.ground)];
    drawing.draw();
  }

  /** Pictures from Python: coarse ones, and when nothing moves any more a whole one, first with the
   *  shadow that was there and then with its own. */
  async draw_remotely() {
    this.is_picture_due = true;
    if (this.is_fetching) return;
    this.is_fetching = true;
    try {
      for (let step = 0; this.is_picture_due || step < 3; step++) {
        if (this.is_picture_due) step = 0;
        this.is_picture_due = false;
        const start = performance.now();
        const { image, range } = await this.fetch_picture(step ? 1 : this.scale, step === 2);
        if (this.show === "depth") this.depth_range = range;
        this.update_legend();
        this.show_image(image);
        if (step === 1 && this.show !== "shaded") step = 2;  // no shadow
        if (step) continue;
        const better = this.scale * Math.sqrt(FRAME_TIME / Math.max(performance.now() - start, 1));
        this.scale = Math.min(1, Math.max(0.06, 0.5 * (this.scale + better)));
      }
      this.remote_canvas.dispatchEvent(new Event("idle"));
    } catch (wrong) {
      this.show_message(/** @type {Error} */ (wrong).message, false);
    } finally {
      this.is_fetching = false;
    }
  }

  /** Puts a picture of any size into the window, and lines and dots before it.
   *  @param {ImageData} image */
  show_image(image) {
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    this.image_canvas.width = image.width;
    this.image_canvas.height = image.height;
    this.image_canvas.getContext("2d")?.putImageData(image, 0, 0);
    this.remote_canvas.width = width;
    this.remote_canvas.height = height;
    const pen = this.remote_canvas.getContext("2d");
    if (!pen) return;
    pen.drawImage(this.image_canvas, 0, 0, width, height);
    const camera = this.camera();
    const at = (/** @type {number[]} */ p) => camera.project(p, width, height);
    const color = (/** @type {number[]} */ c) =>
      `rgb(${c.slice(0, 3).map((x) => Math.round(255 * x)).join(" ")} / ${0.7 * c[3]})`;
    for (const { points, color: c, width: wide } of this.lines) {
      pen.strokeStyle = color(c);
      pen.lineWidth = wide;
      pen.beginPath();
      points.map(at).forEach((p, k) => (k % 2 ? pen.lineTo(p.x, p.y) : pen.moveTo(p.x, p.y)));
      pen.stroke();
    }
    for (const { points, color: c, width: wide } of this.dots) {
      pen.fillStyle = color(c);
      for (const p of points.map(at)) {
        pen.beginPath();
        pen.arc(p.x, p.y, 0.5 * wide, 0, 7);
        pen.fill();
      }
    }
    this.pictures++;
  }

  /** A picture by Python of one ray a pixel. @param {number} scale @param {boolean} is_idle
   *  @returns {Promise<{image: ImageData, range: [number, number]}>} */
  fetch_picture(scale, is_idle) {
    const camera = this.camera();
    const size = [this.root.clientWidth, this.root.clientHeight].map((x) => Math.max(8, Math.round(scale * x)));
    const eye = { origin: camera.eye(), ...camera.axes(), pixel: camera.pixel(size[0], size[1]) };
    return /** @type {any} */ (this.link).ask("draw", {
      ...this.control_values(), size, show: this.show, ground: this.ground, eye, is_idle,
    });
  }

  /** Lets draw who is quicker: this browser's device, or Python. */
  async choose_renderer() {
    const { drawing } = this;
    if (!drawing || !this.link?.ask) return;
    const pixels = (this.root.clientWidth * this.root.clientHeight) / 16;
    let took = 0;
    try {
      for (let k = 0; k < 2; k++) {  // the first picture compiles kernels
        const start = performance.now();
        await this.fetch_picture(0.25, false);
        took = performance.now() - start;
      }
    } catch (wrong) {
      return this.show_message(/** @type {Error} */ (wrong).message);
    }
    if (pixels / took > 1.5 * drawing.rate && drawing === this.drawing)
      this.let_python_draw("Python draws: it is quicker here than this browser's device.");
  }

  /** What is seen now, at a size: what Python needs to draw the same. @param {number} width */
  render_request(width) {
    const camera = this.camera();
    const shape = this.root.clientHeight / this.root.clientWidth;
    const size = [width, Math.max(1, Math.round(width * shape))];
    // The larger side's, of a camera whose 4 : 3 picture fits into the window.
    const half = 0.5 * camera.pixel(size[0], size[1]) * Math.max(size[0], size[1]);
    return {
      ...this.control_values(), size, show: this.show, ground: this.ground,
      camera: { position: camera.eye(), target: camera.target, fov: (360 / Math.PI) * Math.atan(half) },
    };
  }

  /** A picture by Python of what is seen. @param {number} width @param {string} [quality] */
  async picture(width, quality = "shaded") {
    const request = this.render_request(width);
    const show = quality === "path" && request.show === "shaded" ? "path" : request.show;
    const bar = element("progress", { max: 1, value: 0 });
    const { png } = await /** @type {Link} */ (this.link).ask?.("picture", { ...request, show },
      (done, stop) => {
        if (!bar.isConnected) {
          this.show_message("Rendering ");
          this.message.append(bar, " ", this.button("Cancel", stop));
        }
        bar.value = done;
      });
    return `data:image/png;base64,${png}`;
  }

  /** @param {number} width @param {string} quality */
  async render(width, quality) {
    await this.with_errors_shown(async () => {
      element("a", { href: await this.picture(width, quality), download: "surface.png" }).click();
      this.show_message("");
    });
  }

  /** Does something, or says what is wrong. @param {() => Promise<void>} what */
  async with_errors_shown(what) {
    try {
      await what();
    } catch (wrong) {
      this.show_message(/** @type {Error} */ (wrong).message);
    }
  }

  /** Saves what is seen as a scene file. */
  save_scene() {
    return this.with_errors_shown(async () => {
      const { text, lost } = await this.link?.ask?.("save", this.render_request(800));
      const href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
      element("a", { href, download: "scene.json" }).click();
      setTimeout(() => URL.revokeObjectURL(href), 1000);
      this.show_message(lost.length ? `Saved as it stands: a file cannot hold the sliders ${lost.join(", ")}.` : "");
    });
  }

  /** Opens a scene file in this window. @param {File} file */
  load(file) {
    return this.with_errors_shown(async () => this.replace(
      await this.link?.ask?.("load", { text: await file.text() })));
  }

  /** What the sliders and the curves are now. */
  control_values() {
    return { sliders: { ...this.values }, loops: this.edited ? this.curves : null,
      cut: this.cut(), settings: { ...this.settings } };
  }

  /** @param {Link} link @param {boolean} checks */
  async fetch_state(link, checks) {
    return changed(this.scene.state, await link.change({ ...this.control_values(), checks }));
  }

  /** Asks for the state at the sliders and points, one after the other, the last one for sure. */
  async change() {
    this.is_change_due = true;
    if (this.is_changing || !this.link) return;
    this.is_changing = true;
    try {
      while (this.is_change_due) {
        this.is_change_due = false;
        if (this.is_remote) { this.update_marks(); continue; }
        const state = await this.fetch_state(this.link, false);
        if (!this.drawing) continue;
        const wrong = await this.drawing.set(state, state.surfaces.some((one) => one.check));
        if (wrong) return this.fall_back(`This GPU does not compute what the surface was proved with: ${wrong}`);
        // An answer may be to an older question than the last edit.
        if (!this.edited) this.curves = state.curves;
        this.show_message("");
        this.update_marks();
      }
    } catch (wrong) {
      this.show_message(/** @type {Error} */ (wrong).message);
    } finally {
      this.is_changing = false;
    }
    if (!this.link.ask) return;
    clearTimeout(this.recheck_timer);
    this.recheck_timer = setTimeout(() => this.recheck(), IDLE_TIME);
  }

  /** Has the device checked against Dr.Jit for what is drawn now. */
  async recheck() {
    if (this.is_changing || !this.drawing || !this.link) return;
    const now = JSON.stringify(this.control_values());
    try {
      const state = await this.fetch_state(this.link, true);
      if (this.is_changing || !this.drawing || JSON.stringify(this.control_values()) !== now) return;
      const wrong = await this.drawing.set(state);
      if (wrong) this.fall_back(`This GPU does not compute what the surface was proved with: ${wrong}`);
      else this.redraw();
    } catch (wrong) {
      this.show_message(/** @type {Error} */ (wrong).message);
    }
  }

  /** Draws the curves and their points while they are edited, and what was probed. */
  update_marks() {
    this.lines = !this.editing ? [] : this.curves.map((curve) => ({
      points: curve.flatMap((p, k) => [this.to_stage(p), this.to_stage(curve[(k + 1) % curve.length])]),
      color: CURVE, width: 2.5,
    }));
    this.dots = !this.editing ? [] : this.curves.map((curve) => ({
      points: curve.map((p) => this.to_stage(p)), color: [0.1, 0.1, 0.1, 1], width: 6,
    }));
    const chosen = this.selected_point && this.curves[this.selected_point[0]]?.[this.selected_point[1]];
    if (this.editing && chosen)
      this.dots.push({ points: [this.to_stage(chosen)], color: [1, 0.3, 0.1, 1], width: 8 });
    this.lines.push(...this.probe_marks.filter((one) => one.width < 4));
    this.dots.push(...this.probe_marks.filter((one) => one.width >= 4));
    this.redraw();
  }

  /** A point of the surfaces, on the stage. @param {number[]} p */
  to_stage(p) {
    const { placement } = this.scene;
    return [0, 1, 2].map((k) => placement[12] * (placement[3 * k] * p[0] + placement[3 * k + 1] * p[1]
      + placement[3 * k + 2] * p[2]) + placement[9 + k]);
  }

  /** A point on the stage, in the surfaces' coordinates. @param {number[]} p */
  from_stage(p) {
    const { placement } = this.scene;
    return this.direction_from_stage(p.map((x, k) => x - placement[9 + k]));
  }

  /** A direction on the stage, in the surfaces' coordinates. @param {number[]} d */
  direction_from_stage(d) {
    const { placement } = this.scene;
    return [0, 1, 2].map((k) => (placement[k] * d[0] + placement[3 + k] * d[1] + placement[6 + k] * d[2])
      / placement[12]);
  }

  /** Where a pointer is. @param {MouseEvent} e */
  pointer(e) {
    const box = this.root.getBoundingClientRect();
    return { width: box.width, height: box.height, x: e.clientX - box.left, y: e.clientY - box.top };
  }

  /** The point that is nearest to a pointer; null if none is near. @param {MouseEvent} e */
  nearest_point(e) {
    const camera = this.camera();
    const { width, height, x, y } = this.pointer(e);
    /** @type {{at: [number, number], distance: number, z: number} | null} */
    let best = null;
    this.curves.forEach((curve, c) => curve.forEach((p, k) => {
      const there = camera.project(this.to_stage(p), width, height);
      const distance = Math.hypot(there.x - x, there.y - y);
      if (distance < PICK_RADIUS && (!best || distance < best.distance)) best = { at: [c, k], distance, z: there.z };
    }));
    return /** @type {{at: [number, number], distance: number, z: number} | null} */ (best);
  }

  /** Whether a pointer takes a point. @param {PointerEvent} e */
  grab_point(e) {
    this.pressed = e;
    if (!this.editing || e.button !== 0) return false;
    const found = this.nearest_point(e);
    this.selected_point = found ? found.at : null;
    if (!found) { this.update_marks(); return false; }
    this.push_undo();
    /** @type {Element} */ (e.target).setPointerCapture(e.pointerId);
    this.dragged = { x: e.clientX, y: e.clientY, z: found.z };
    this.update_marks();
    return true;
  }

  /** @param {PointerEvent} e */
  drag(e) {
    if (!this.dragged || !this.selected_point) return;
    const { width, height } = this.pointer(e);
    const direction = this.camera().drag_offset(
      this.dragged.z, e.clientX - this.dragged.x, e.clientY - this.dragged.y, width, height);
    this.dragged = { ...this.dragged, x: e.clientX, y: e.clientY };
    const [c, k] = this.selected_point;
    this.curves = this.curves.map((curve, i) => (i !== c ? curve
      : curve.map((p, j) => (j === k ? add_scaled(p, 1, this.direction_from_stage(direction)) : p))));
    this.edited = true;
    this.change();
  }

  /** @param {PointerEvent} e */
  release(e) {
    const { pressed } = this;
    if (this.probing && pressed && Math.hypot(e.clientX - pressed.clientX, e.clientY - pressed.clientY) < 3)
      this.probe(e);
    this.dragged = undefined;
  }

  /** Asks Python what the ray through a pointer meets, and draws its proved steps.
   *  @param {MouseEvent} e */
  async probe(e) {
    const { width, height, x, y } = this.pointer(e);
    const camera = this.camera();
    const { right, up, forward } = camera.axes();
    const pixel = camera.pixel(width, height);
    const on_stage = add_scaled(add_scaled(forward, pixel * (x - 0.5 * width), right), -pixel * (y - 0.5 * height), up);
    const eye = camera.eye();
    const origin = this.from_stage(eye);
    const direction = this.direction_from_stage(on_stage);
    try {
      const found = await this.link?.ask?.("probe", { ...this.control_values(), origin, direction });
      const length = Math.hypot(...direction);
      const at = (/** @type {number} */ t) => this.to_stage(add_scaled(origin, t / length, direction));
      const ends = [...found.steps, ...(found.t === undefined ? [] : [found.t])].map(at);
      this.probe_marks = [
        { points: ends.slice(1).flatMap((p, k) => [ends[k], p]), color: [0.1, 0.4, 0.9, 0.9], width: 2 },
        { points: ends.slice(1), color: [0.1, 0.4, 0.9, 1], width: 5 },
      ];
      this.show_message(probe_text(found));
      this.update_marks();
    } catch (wrong) {
      this.show_message(/** @type {Error} */ (wrong).message);
    }
  }

  /** A new point on the segment that is nearest to a pointer. @param {MouseEvent} e */
  insert(e) {
    const camera = this.camera();
    if (!this.editing) { camera.reset(); this.redraw(); return; }
    const { width, height, x, y } = this.pointer(e);
    /** @type {{c: number, k: number, point: number[], distance: number} | null} */
    let best = null;
    this.curves.forEach((curve, c) => curve.forEach((p, k) => {
      const q = curve[(k + 1) % curve.length];
      const [a, b] = [p, q].map((one) => camera.project(this.to_stage(one), width, height));
      const [dx, dy] = [b.x - a.x, b.y - a.y];
      const s = Math.max(0, Math.min(1, ((x - a.x) * dx + (y - a.y) * dy) / Math.max(dx * dx + dy * dy, 1e-9)));
      const distance = Math.hypot(a.x + s * dx - x, a.y + s * dy - y);
      if (distance < PICK_RADIUS && (!best || distance < best.distance))
        best = { c, k, point: add_scaled(p, s, add_scaled(q, -1, p)), distance };
    }));
    const found = /** @type {{c: number, k: number, point: number[]} | null} */ (/** @type {unknown} */ (best));
    if (!found) return;
    this.selected_point = [found.c, found.k + 1];
    this.edit(this.curves.map((curve, c) => (c !== found.c ? curve
      : [...curve.slice(0, found.k + 1), found.point, ...curve.slice(found.k + 1)])));
  }

  /** @param {KeyboardEvent} e */
  key(e) {
    if (!this.scene.editable) return;
    if ((e.ctrlKey || e.metaKey) && e.key.toLowerCase() === "z") {
      e.preventDefault();
      if (e.shiftKey) this.undo(this.redo_stack, this.undo_stack);
      else this.undo(this.undo_stack, this.redo_stack);
    } else if ((e.key === "Delete" || e.key === "Backspace") && this.editing && this.selected_point) {
      e.preventDefault();
      const [c, k] = this.selected_point;
      if (this.curves[c].length <= 3) return this.show_message("A curve has three points at least.");
      this.selected_point = null;
      this.edit(this.curves.map((curve, i) => (i === c ? curve.filter((_, j) => j !== k) : curve)));
    }
  }

  push_undo() {
    this.undo_stack.push(this.curves);
    this.redo_stack.length = 0;
  }

  /** @param {number[][][]} curves */
  edit(curves) {
    this.push_undo();
    this.curves = curves;
    this.edited = true;
    this.update_marks();
    this.change();
  }

  /** @param {number[][][][]} from @param {number[][][][]} to */
  undo(from, to) {
    const curves = from.pop();
    if (!curves) return;
    to.push(this.curves);
    this.curves = curves;
    this.edited = true;
    this.selected_point = null;
    this.update_marks();
    this.change();
  }

  /** What is on the canvas, as a file. */
  save() {
    this.drawing?.present(...(/** @type {[number, number]} */ (this.drawing.shown_size)));
    this.canvas.toBlob((blob) => {
      if (!blob) return;
      const address = URL.createObjectURL(blob);
      element("a", { href: address, download: "surface.png" }).click();
      setTimeout(() => URL.revokeObjectURL(address), 1000);
    });
  }
}

/** Each point halfway to the middle of its neighbors. @param {number[][]} curve */
function smoothed(curve) {
  const n = curve.length;
  return curve.map((p, k) => p.map((x, i) =>
    0.5 * x + 0.25 * (curve[(k + 1) % n][i] + curve[(k + n - 1) % n][i])));
}

/** What a probe has found, in words. @param {any} found */
function probe_text(found) {
  const looks = `${found.evaluations} evaluations`;
  if (found.t === undefined) return `${found.status.toLowerCase().replaceAll("_", " ")}, ${looks}`;
  const point = (/** @type {number[]} */ p) => `(${p.map(format).join(", ")})`;
  const bent = found.mean === undefined ? ""
    : `, mean curvature ${format(found.mean)}, Gaussian ${format(found.gaussian)}`;
  const what = found.triangle === undefined ? `f = ${format(found.value)}`
    : `on triangle ${found.triangle}, where f jumps`;
  return `at ${point(found.position)}, normal ${point(found.normal)}, ${what}${bent}, ${looks}`;
}
