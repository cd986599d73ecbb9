// Channels to the Python process behind a view: a WebSocket, or the messages of a notebook widget.
// @ts-check

/** @import {Panel as PanelClass} from "./panel.js" */
/** @import {StateDelta} from "./slider_states.js" */
/** Called with the completed fraction of a request, and with a function that cancels it.
 *  @typedef {(completed: number, cancel: () => void) => void} ProgressHandler */
/** @typedef {{resolve: (answer: any) => void, reject: (error: Error) => void,
 *             onProgress?: ProgressHandler}} PendingRequest */

/** The requests of one client, and those that wait for an answer. */
class RequestChannel {
  constructor() {
    this.lastId = 0;
    /** @type {Map<number, PendingRequest>} */
    this.pendingRequests = new Map();
  }

  /** Sends a message, as soon as that is possible. @param {object} message
   *  @returns {Promise<void>} */
  async send(message) { throw new Error(`nobody hears ${JSON.stringify(message)}`); }

  /** Handles an answer, or the completed fraction of one.
   *  @param {{id: number | null, answer?: any, error?: string, done?: number}} message */
  receive({ id, answer, error, done }) {
    // Python cannot tell which request it was if it could not parse the text.
    if (id === null) return this.rejectAll(new Error(error));
    const request = this.pendingRequests.get(id);
    if (done !== undefined) return request?.onProgress?.(done, () => this.cancel(id));
    this.pendingRequests.delete(id);
    if (error) request?.reject(new Error(error));
    else request?.resolve(answer);
  }

  /** Handles a picture. Its bytes follow the id of the request, the height and the width (32-bit
   *  integers), and the range of depths (two 32-bit floats). @param {ArrayBuffer} data */
  receivePicture(data) {
    const [id, height, width] = new Uint32Array(data, 0, 3);
    const image = new ImageData(new Uint8ClampedArray(data, 20), width, height);
    this.pendingRequests.get(id)?.resolve({ image, range: [...new Float32Array(data, 12, 2)] });
    this.pendingRequests.delete(id);
  }

  /** Rejects all pending requests, as none will be answered. @param {Error} error */
  rejectAll(error) {
    for (const request of this.pendingRequests.values()) request.reject(error);
    this.pendingRequests.clear();
  }

  /** Sends a request and waits for its answer. @param {string} kind @param {object} parameters
   *  @param {ProgressHandler} [onProgress] @returns {Promise<any>} */
  request(kind, parameters, onProgress) {
    const id = ++this.lastId;
    return new Promise((resolve, reject) => {
      this.pendingRequests.set(id, { resolve, reject, onProgress });
      this.send({ ...parameters, id, kind }).catch((error) => {
        this.pendingRequests.delete(id);
        reject(error);
      });
      onProgress?.(0, () => this.cancel(id));
    });
  }

  /** Asks Python to stop working on a request. @param {number} id */
  cancel(id) { this.send({ kind: "cancel", which: id }); }

  /** The state delta at values of the controls. @param {object} controlValues
   *  @returns {Promise<StateDelta>} */
  fetchDelta(controlValues) { return this.request("change", controlValues); }
}

/** A channel to the server of `harnack.view`. A socket that was lost is opened again. */
export class WebSocketChannel extends RequestChannel {
  /** @param {string} address the address of the socket */
  constructor(address) {
    super();
    this.address = address;
    /** The text of the scene file that was opened last. */
    this.sceneText = "";
  }

  /** An open socket: the present one, or a new one. @returns {Promise<WebSocket>} */
  connect() {
    if (this.socket && this.socket.readyState <= WebSocket.OPEN && this.openedSocket) return this.openedSocket;
    const socket = new WebSocket(this.address);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) =>
      (typeof event.data === "string" ? this.receive(JSON.parse(event.data)) : this.receivePicture(event.data));
    socket.onclose = () =>
      this.rejectAll(new Error("Python does not answer any more: it may have been stopped."));
    this.openedSocket = new Promise((resolve, reject) => {
      socket.onopen = () => {
        // The server knows nothing of a scene file that was opened through the previous socket.
        if (this.sceneText)
          socket.send(JSON.stringify({ kind: "load", text: this.sceneText, id: ++this.lastId }));
        resolve(socket);
      };
      socket.onerror = () => reject(new Error("Python does not answer: it may have been stopped."));
    });
    return this.openedSocket;
  }

  /** @param {object} message */
  async send(message) { (await this.connect()).send(JSON.stringify(message)); }

  /** @param {string} kind @param {object} parameters @param {ProgressHandler} [onProgress] */
  async request(kind, parameters, onProgress) {
    const answer = await super.request(kind, parameters, onProgress);
    if (kind === "load") this.sceneText = /** @type {any} */ (parameters).text;
    return answer;
  }
}

/** The model that anywidget gives to the JavaScript side of a widget.
 * @typedef {{
 *   get(name: string): any, set(name: string, value: any): void, save_changes(): void,
 *   send(message: any): void, on(event: string, handler: (...parameters: any[]) => void): void,
 * }} WidgetModel */

/** A channel to the kernel of a notebook, by the messages of a widget. */
export class WidgetChannel extends RequestChannel {
  /** @param {WidgetModel} model */
  constructor(model) {
    super();
    this.model = model;
    model.on("msg:custom", (message, buffers) => {
      if (!buffers?.length) return this.receive(message);
      const { buffer, byteOffset, byteLength } = /** @type {DataView} */ (buffers[0]);
      return this.receivePicture(/** @type {ArrayBuffer} */ (buffer.slice(byteOffset, byteOffset + byteLength)));
    });
  }

  /** @param {object} message */
  async send(message) { this.model.send(JSON.stringify(message)); }
}

/** Renders a notebook widget: a panel whose camera, sliders, points and mode are attributes in
 *  Python. Returns a function that closes it.
 *  @param {typeof PanelClass} Panel @param {WidgetModel} model @param {HTMLElement} parent */
export function renderWidget(Panel, model, parent) {
  const root = document.createElement("div");
  root.style.height = `${model.get("height")}px`;
  parent.append(root);
  let panel = new Panel(root, model.get("_scene"), model.get("_passes"), new WidgetChannel(model), model.get("_still"));
  root.addEventListener("panel", (event) => { panel = /** @type {CustomEvent} */ (event).detail; });
  root.addEventListener("attributes", (event) => {
    for (const [name, value] of Object.entries(/** @type {CustomEvent} */ (event).detail))
      model.set(name, value);
    model.save_changes();
  });
  for (const name of ["camera", "sliders", "points", "show"])
    model.on(`change:${name}`, () => panel.applyAttributes({ [name]: model.get(name) }));
  panel.open();
  return () => panel.close();
}
