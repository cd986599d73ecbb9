// A camera that turns about a point before it, on a stage whose z axis points up.
// @ts-check

/** @typedef {[number, number, number]} Point */
/** @typedef {{target: number[], azimuth: number, elevation: number, distance: number, fov: number}} Pose */

/** @param {number[]} a @param {number[]} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** a + s b @param {number[]} a @param {number} s @param {number[]} b */
export const add_scaled = (a, s, b) => a.map((x, k) => x + s * b[k]);
/** @param {number[]} a @param {number[]} b */
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const RADIANS = Math.PI / 180;

export class Camera {
  /** @param {Pose} pose */
  constructor(pose) {
    this.home = pose;
    this.target = pose.target;
    this.azimuth = pose.azimuth;
    this.elevation = pose.elevation;
    this.distance = pose.distance;
    this.fov = pose.fov;
    this.roll = 0;
  }

  /** As it was at first. */
  reset() { Object.assign(this, this.home, { roll: 0 }); }

  /** Stands somewhere and looks at something, upright. @param {number[]} eye
   *  @param {number[]} target @param {number} fov */
  look_at(eye, target, fov) {
    const back = add_scaled(eye, -1, target);
    const distance = Math.hypot(...back);
    if (!(distance > 0) || !(fov > 0 && fov < 180)) return;
    Object.assign(this, {
      target, fov, distance, roll: 0, elevation: Math.asin(back[2] / distance) / RADIANS,
    });
    if (Math.hypot(back[0], back[1]) > 1e-9 * distance)
      this.azimuth = Math.atan2(back[1], back[0]) / RADIANS;
  }

  /** Unit vectors to the right, upwards and forwards. */
  axes() {
    const [a, e, r] = [this.azimuth, this.elevation, this.roll].map((x) => x * RADIANS);
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const level = [-Math.sin(a), Math.cos(a), 0];
    const upright = cross(back, level);
    const right = level.map((x, k) => Math.cos(r) * x + Math.sin(r) * upright[k]);
    const up = upright.map((x, k) => Math.cos(r) * x - Math.sin(r) * level[k]);
    return { right, up, forward: back.map((x) => -x) };
  }

  eye() { return add_scaled(this.target, -this.distance, this.axes().forward); }

  /** How wide a pixel is at distance 1. A picture of 4 : 3 fits into every window.
   *  @param {number} width @param {number} height */
  pixel(width, height) {
    return (2 * Math.tan(0.5 * this.fov * RADIANS)) / Math.min(width, (4 / 3) * height);
  }

  /** Where a point is in a picture, in pixels, and how far before the eye.
   *  @param {number[]} point @param {number} width @param {number} height */
  project(point, width, height) {
    const { right, up, forward } = this.axes();
    const direction = add_scaled(point, -1, this.eye());
    const z = dot(direction, forward);
    const pixel = z * this.pixel(width, height);
    return { x: 0.5 * width + dot(direction, right) / pixel, y: 0.5 * height - dot(direction, up) / pixel, z };
  }

  /** How far a point moves with a pointer, in the plane that faces the eye. @param {number} z
   *  before the eye @param {number} x @param {number} y pixels @param {number} width
   *  @param {number} height */
  drag_offset(z, x, y, width, height) {
    const { right, up } = this.axes();
    const pixel = z * this.pixel(width, height);
    return right.map((r, k) => pixel * (x * r - y * up[k]));
  }

  /** Degrees. @param {number} azimuth @param {number} elevation */
  orbit(azimuth, elevation) {
    const [c, s] = [Math.cos(this.roll * RADIANS), Math.sin(this.roll * RADIANS)];
    this.azimuth += c * azimuth - s * elevation;
    this.elevation = Math.max(-90, Math.min(90, this.elevation + s * azimuth + c * elevation));
  }

  /** Pixels. @param {number} x @param {number} y @param {number} width @param {number} height */
  pan(x, y, width, height) {
    this.target = add_scaled(this.target, -1, this.drag_offset(this.distance, x, y, width, height));
  }

  /** @param {number} factor */
  zoom(factor) {
    const { distance } = this.home;
    this.distance = Math.max(distance / 200, Math.min(20 * distance, this.distance / factor));
  }

  /** Degrees. @param {number} angle */
  roll_by(angle) { this.roll += angle; }

  /** Mouse, touch and keys on an element. @param {HTMLElement} element @param {() => void} changed
   *  @param {(e: PointerEvent) => boolean} [is_taken] whether a pointer does something else */
  listen(element, changed, is_taken = () => false) {
    /** @type {Map<number, PointerEvent>} */
    const down = new Map();
    element.addEventListener("pointerdown", (e) => {
      if (is_taken(e)) return;
      element.setPointerCapture(e.pointerId);
      down.set(e.pointerId, e);
    });
    for (const name of ["pointerup", "pointercancel"])
      element.addEventListener(name, (e) => down.delete(/** @type {PointerEvent} */ (e).pointerId));
    element.addEventListener("pointermove", (e) => {
      const before = down.get(e.pointerId);
      if (!before) return;
      const [x, y] = [e.clientX - before.clientX, e.clientY - before.clientY];
      const [width, height] = [element.clientWidth, element.clientHeight];
      const other = [...down.values()].find((one) => one.pointerId !== e.pointerId);
      if (other) {
        const [now, was] = [e, before].map((one) => [one.clientX - other.clientX, one.clientY - other.clientY]);
        this.zoom(Math.hypot(now[0], now[1]) / Math.max(Math.hypot(was[0], was[1]), 1));
        this.roll_by((Math.atan2(now[1], now[0]) - Math.atan2(was[1], was[0])) / RADIANS);
        this.pan(0.5 * x, 0.5 * y, width, height);
      } else if (e.shiftKey || before.button === 2) this.pan(x, y, width, height);
      else this.orbit((-220 * x) / Math.min(width, height), (220 * y) / Math.min(width, height));
      down.set(e.pointerId, Object.assign(e, { first: before }));
      changed();
    });
    element.addEventListener("contextmenu", (e) => e.preventDefault());
    element.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(-0.0015 * e.deltaY));
      changed();
    }, { passive: false });
    element.addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.metaKey || e.altKey) return;
      /** @type {Record<string, () => void>} */
      const moves = {
        ArrowLeft: () => this.orbit(-5, 0), ArrowRight: () => this.orbit(5, 0),
        ArrowUp: () => this.orbit(0, 5), ArrowDown: () => this.orbit(0, -5),
        "+": () => this.zoom(1.1), "=": () => this.zoom(1.1), "-": () => this.zoom(1 / 1.1),
        "[": () => this.roll_by(-5), "]": () => this.roll_by(5), Home: () => this.reset(),
      };
      if (!moves[e.key]) return;
      e.preventDefault();
      moves[e.key]();
      changed();
    });
  }
}
