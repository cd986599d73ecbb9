// The camera of the viewer: it turns about a target, on a stage whose z axis points up, and follows
// mouse, touch and keys.
// @ts-check

/** @typedef {[number, number, number]} Point */
/** Angles are in degrees.
 *  @typedef {{target: number[], azimuth: number, elevation: number, distance: number, fov: number}} Pose */

/** The scalar product of two vectors. @param {number[]} a @param {number[]} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** The vector a + s b. @param {number[]} a @param {number} s @param {number[]} b */
export const addScaled = (a, s, b) => a.map((x, k) => x + s * b[k]);
/** The vector product of two vectors. @param {number[]} a @param {number[]} b */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const RADIANS = Math.PI / 180;
// The aspect ratio of a picture that fits into every window.
const ASPECT_RATIO = 4 / 3;

export class Camera {
  /** @param {Pose} pose */
  constructor(pose) {
    this.initialPose = pose;
    this.target = pose.target;
    this.azimuth = pose.azimuth;
    this.elevation = pose.elevation;
    this.distance = pose.distance;
    this.fov = pose.fov;
    this.roll = 0;
  }

  /** Returns to the initial pose. */
  reset() { Object.assign(this, this.initialPose, { roll: 0 }); }

  /** Moves the camera to a position, upright and facing a target.
   *  @param {number[]} position @param {number[]} target @param {number} fov */
  lookAt(position, target, fov) {
    const backward = addScaled(position, -1, target);
    const distance = Math.hypot(...backward);
    if (!(distance > 0) || !(fov > 0 && fov < 180)) return;
    Object.assign(this, {
      target, fov, distance, roll: 0, elevation: Math.asin(backward[2] / distance) / RADIANS,
    });
    // Straight above or below the target, the azimuth is undefined and stays as it is.
    if (Math.hypot(backward[0], backward[1]) > 1e-9 * distance)
      this.azimuth = Math.atan2(backward[1], backward[0]) / RADIANS;
  }

  /** Unit vectors to the right, upwards and forwards. */
  get axes() {
    const [a, e, r] = [this.azimuth, this.elevation, this.roll].map((x) => x * RADIANS);
    const backward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const horizontal = [-Math.sin(a), Math.cos(a), 0];
    const upright = cross(backward, horizontal);
    const right = horizontal.map((x, k) => Math.cos(r) * x + Math.sin(r) * upright[k]);
    const up = upright.map((x, k) => Math.cos(r) * x - Math.sin(r) * horizontal[k]);
    return { right, up, forward: backward.map((x) => -x) };
  }

  /** The position of the camera on the stage. */
  get position() { return addScaled(this.target, -this.distance, this.axes.forward); }

  /** The width of a pixel at distance 1, in a picture of this size.
   *  @param {number} width @param {number} height */
  pixelSize(width, height) {
    return (2 * Math.tan(0.5 * this.fov * RADIANS)) / Math.min(width, ASPECT_RATIO * height);
  }

  /** Projects a point into a picture: x and y are in pixels, z is the depth along the camera's axis.
   *  @param {number[]} point @param {number} width @param {number} height */
  project(point, width, height) {
    const { right, up, forward } = this.axes;
    const direction = addScaled(point, -1, this.position);
    const z = dot(direction, forward);
    const pixelSize = z * this.pixelSize(width, height);
    return {
      x: 0.5 * width + dot(direction, right) / pixelSize,
      y: 0.5 * height - dot(direction, up) / pixelSize,
      z,
    };
  }

  /** The displacement on the stage that follows a pointer, in the plane parallel to the picture.
   *  @param {number} z the depth of the plane @param {number} x @param {number} y pixels by which
   *  the pointer moves @param {number} width @param {number} height */
  dragOffset(z, x, y, width, height) {
    const { right, up } = this.axes;
    const pixelSize = z * this.pixelSize(width, height);
    return right.map((r, k) => pixelSize * (x * r - y * up[k]));
  }

  /** Turns the camera about the target, by angles in degrees.
   *  @param {number} azimuth @param {number} elevation */
  orbit(azimuth, elevation) {
    const [c, s] = [Math.cos(this.roll * RADIANS), Math.sin(this.roll * RADIANS)];
    this.azimuth += c * azimuth - s * elevation;
    this.elevation = Math.max(-90, Math.min(90, this.elevation + s * azimuth + c * elevation));
  }

  /** Moves the target with a pointer. @param {number} x @param {number} y in pixels
   *  @param {number} width @param {number} height */
  pan(x, y, width, height) {
    this.target = addScaled(this.target, -1, this.dragOffset(this.distance, x, y, width, height));
  }

  /** Divides the distance from the target by a factor, within limits. @param {number} factor */
  zoom(factor) {
    const { distance } = this.initialPose;
    this.distance = Math.max(distance / 200, Math.min(20 * distance, this.distance / factor));
  }

  /** Turns the camera about its axis. @param {number} angle in degrees */
  rollBy(angle) { this.roll += angle; }

  /** Lets the camera follow mouse, touch and keys on an element.
   *  @param {HTMLElement} element @param {() => void} onChange called when the camera has moved
   *  @param {(event: PointerEvent) => boolean} [isTaken] whether a pressed pointer serves another
   *  purpose */
  listen(element, onChange, isTaken = () => false) {
    this.listenToPointers(element, onChange, isTaken);
    this.listenToWheel(element, onChange);
    this.listenToKeys(element, onChange);
  }

  /** @param {HTMLElement} element @param {() => void} onChange
   *  @param {(event: PointerEvent) => boolean} isTaken */
  listenToPointers(element, onChange, isTaken) {
    /** The last event of each pressed pointer. @type {Map<number, PointerEvent>} */
    const pressedPointers = new Map();
    element.addEventListener("pointerdown", (event) => {
      if (isTaken(event)) return;
      element.setPointerCapture(event.pointerId);
      pressedPointers.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"])
      element.addEventListener(name, (event) =>
        pressedPointers.delete(/** @type {PointerEvent} */ (event).pointerId));
    element.addEventListener("pointermove", (event) => {
      const previous = pressedPointers.get(event.pointerId);
      if (!previous) return;
      const secondPointer = [...pressedPointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
      this.followPointer(element, previous, event, secondPointer);
      pressedPointers.set(event.pointerId, event);
      onChange();
    });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /** Moves the camera as a pointer has moved. Two pointers zoom, roll and pan it; a single one pans
   *  it with the shift key or the right button, and turns it otherwise.
   *  @param {HTMLElement} element @param {PointerEvent} previous @param {PointerEvent} current
   *  @param {PointerEvent | undefined} secondPointer */
  followPointer(element, previous, current, secondPointer) {
    const [x, y] = [current.clientX - previous.clientX, current.clientY - previous.clientY];
    const [width, height] = [element.clientWidth, element.clientHeight];
    if (secondPointer) {
      const [after, before] = [current, previous].map(({ clientX, clientY }) =>
        [clientX - secondPointer.clientX, clientY - secondPointer.clientY]);
      this.zoom(Math.hypot(after[0], after[1]) / Math.max(Math.hypot(before[0], before[1]), 1));
      this.rollBy((Math.atan2(after[1], after[0]) - Math.atan2(before[1], before[0])) / RADIANS);
      this.pan(0.5 * x, 0.5 * y, width, height);
    } else if (current.shiftKey || (current.buttons & 2) !== 0) this.pan(x, y, width, height);
    else this.orbit((-220 * x) / Math.min(width, height), (220 * y) / Math.min(width, height));
  }

  /** @param {HTMLElement} element @param {() => void} onChange */
  listenToWheel(element, onChange) {
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-0.0015 * event.deltaY));
      onChange();
    }, { passive: false });
  }

  /** @param {HTMLElement} element @param {() => void} onChange */
  listenToKeys(element, onChange) {
    /** @type {Record<string, () => void>} */
    const actions = {
      ArrowLeft: () => this.orbit(-5, 0), ArrowRight: () => this.orbit(5, 0),
      ArrowUp: () => this.orbit(0, 5), ArrowDown: () => this.orbit(0, -5),
      "+": () => this.zoom(1.1), "=": () => this.zoom(1.1), "-": () => this.zoom(1 / 1.1),
      "[": () => this.rollBy(-5), "]": () => this.rollBy(5), Home: () => this.reset(),
    };
    element.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (!actions[event.key]) return;
      event.preventDefault();
      actions[event.key]();
      onChange();
    });
  }
}
