// Questions to the Python behind a view: by a socket, or by messages of a notebook's widget.
// @ts-check

/** @import {Panel as PanelClass} from "./panel.js" */

/** Questions that wait for an answer. */
class Questions {
  constructor() {
    this.last = 0;
    /** @type {Map<number, {resolve: (answer: any) => void, reject: (wrong: Error) => void,
     *                      on_progress?: (done: number, stop: () => void) => void}>} */
    this.waiting = new Map();
  }

  /** Sends a question, as soon as that can be done. @param {object} question
   *  @returns {Promise<void>} */
  async send(question) { throw new Error(`nobody hears ${JSON.stringify(question)}`); }

  /** An answer, or how much of it is done.
   *  @param {{id: number | null, answer?: any, error?: string, done?: number}} message */
  receive({ id, answer, error, done }) {
    // Of a text that is no question Python cannot say which it was.
    if (id === null) return this.reject_all(new Error(error));
    const asked = this.waiting.get(id);
    if (done !== undefined) return asked?.on_progress?.(done, () => this.cancel(id));
    this.waiting.delete(id);
    if (error) asked?.reject(new Error(error));
    else asked?.resolve(answer);
  }

  /** A picture; before it its number, its size, and the range of its depths.
   *  @param {ArrayBuffer} data */
  receive_picture(data) {
    const [id, height, width] = new Uint32Array(data, 0, 3);
    const image = new ImageData(new Uint8ClampedArray(data, 20), width, height);
    this.waiting.get(id)?.resolve({ image, range: [...new Float32Array(data, 12, 2)] });
    this.waiting.delete(id);
  }

  /** Nothing that was asked will be answered. @param {Error} wrong */
  reject_all(wrong) {
    for (const one of this.waiting.values()) one.reject(wrong);
    this.waiting.clear();
  }

  /** @param {string} kind @param {object} given
   *  @param {(done: number, stop: () => void) => void} [on_progress] how much of it is done
   *  @returns {Promise<any>} */
  ask(kind, given, on_progress) {
    const id = ++this.last;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject, on_progress });
      this.send({ ...given, id, kind }).catch((wrong) => { this.waiting.delete(id); reject(wrong); });
      on_progress?.(0, () => this.cancel(id));
    });
  }

  /** Has Python stop with an answer. @param {number} which */
  cancel(which) { this.send({ kind: "cancel", which }); }

  /** @param {object} wanted */
  change(wanted) { return this.ask("change", wanted); }
}

/** The server of `harnack.view`; its socket is opened again when it was lost. */
export class Server extends Questions {
  /** @param {string} address of the socket */
  constructor(address) {
    super();
    this.address = address;
    this.loaded = "";
  }

  /** @returns {Promise<WebSocket>} */
  connected() {
    if (this.socket && this.socket.readyState <= WebSocket.OPEN && this.opened) return this.opened;
    const socket = new WebSocket(this.address);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = (e) =>
      (typeof e.data === "string" ? this.receive(JSON.parse(e.data)) : this.receive_picture(e.data));
    socket.onclose = () =>
      this.reject_all(new Error("Python does not answer any more: it may have been stopped."));
    this.opened = new Promise((resolve, reject) => {
      socket.onopen = () => {
        // A socket that is opened again knows nothing of the scene that was opened in the old one.
        if (this.loaded)
          socket.send(JSON.stringify({ kind: "load", text: this.loaded, id: ++this.last }));
        resolve(socket);
      };
      socket.onerror = () => reject(new Error("Python does not answer: it may have been stopped."));
    });
    return this.opened;
  }

  /** @param {object} question */
  async send(question) { (await this.connected()).send(JSON.stringify(question)); }

  /** @param {string} kind @param {object} given
   *  @param {(done: number, stop: () => void) => void} [on_progress] */
  async ask(kind, given, on_progress) {
    const answer = await super.ask(kind, given, on_progress);
    if (kind === "load") this.loaded = /** @type {any} */ (given).text;
    return answer;
  }
}

/** What anywidget gives a widget of its Python side.
 * @typedef {{
 *   get(name: string): any, set(name: string, value: any): void, save_changes(): void,
 *   send(message: any): void, on(event: string, handler: (...given: any[]) => void): void,
 * }} Model */

/** The kernel of a notebook, by the messages of a widget. */
export class Kernel extends Questions {
  /** @param {Model} model */
  constructor(model) {
    super();
    this.model = model;
    model.on("msg:custom", (message, buffers) => {
      if (!buffers?.length) return this.receive(message);
      const { buffer, byteOffset, byteLength } = /** @type {DataView} */ (buffers[0]);
      return this.receive_picture(/** @type {ArrayBuffer} */ (buffer.slice(byteOffset, byteOffset + byteLength)));
    });
  }

  /** @param {object} question */
  async send(question) { this.model.send(JSON.stringify(question)); }
}

/** A widget of a notebook: the panel, whose camera, sliders and points are attributes in Python.
 *  @param {typeof PanelClass} Panel @param {Model} model @param {HTMLElement} el */
export function widget(Panel, model, el) {
  const root = document.createElement("div");
  root.style.height = `${model.get("height")}px`;
  el.append(root);
  let panel = new Panel(root, model.get("_scene"), model.get("_passes"), new Kernel(model), model.get("_still"));
  root.addEventListener("panel", (e) => { panel = /** @type {CustomEvent} */ (e).detail; });
  root.addEventListener("attributes", (e) => {
    for (const [name, value] of Object.entries(/** @type {CustomEvent} */ (e).detail))
      model.set(name, value);
    model.save_changes();
  });
  for (const name of ["camera", "sliders", "points", "show"])
    model.on(`change:${name}`, () => panel.apply_attributes({ [name]: model.get(name) }));
  panel.open();
  return () => panel.close();
}
