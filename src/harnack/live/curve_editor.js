// The editor of the curves of a scene: their points are dragged, inserted, removed and smoothed, and
// that is undone.
// @ts-check

import { addScaled } from "./camera.js";

/** @import {Panel} from "./panel.js" */
/** @import {Marks} from "./renderer.js" */
/** Closed curves: lists of points. @typedef {number[][][]} Curves */
/** The number of a curve and that of its point. @typedef {[number, number]} PointIndex */
/** The position of a pointer in the window, and the size of this.
 *  @typedef {{width: number, height: number, x: number, y: number}} PointerPosition */

const CURVE_COLOR = [0.95, 0.75, 0.2, 1];
const POINT_COLOR = [0.1, 0.1, 0.1, 1];
const SELECTED_POINT_COLOR = [1, 0.3, 0.1, 1];
// The distance in pixels within which a pointer takes a point.
const PICK_RADIUS = 12;

export class CurveEditor {
  /** @param {Panel} panel the window in which curves are edited @param {Curves} curves */
  constructor(panel, curves) {
    this.panel = panel;
    this.curves = curves;
    /** @type {Curves[]} */
    this.undoStack = [];
    /** @type {Curves[]} */
    this.redoStack = [];
    /** Whether the curves differ from those that Python has sent. */
    this.isEdited = false;
    /** Whether pointers and keys edit the curves. */
    this.isActive = false;
    /** @type {PointIndex | null} */
    this.selectedPoint = null;
    /** The last position of the pointer that drags the selected point, and the depth of this.
     *  @type {{x: number, y: number, z: number} | null} */
    this.dragPosition = null;
  }

  /** @param {boolean} isActive */
  setActive(isActive) {
    this.isActive = isActive;
    this.selectedPoint = null;
    this.panel.updateMarks();
  }

  /** Lines along the curves, and dots at their points; none if the editor is not active.
   *  @returns {[Marks[], Marks[]]} */
  createMarks() {
    if (!this.isActive) return [[], []];
    const stageCurves = this.curves.map((curve) => curve.map((p) => this.panel.placement.toStage(p)));
    const lines = stageCurves.map((curve) => ({
      points: curve.flatMap((p, k) => [p, curve[(k + 1) % curve.length]]), color: CURVE_COLOR, width: 2.5,
    }));
    const dots = stageCurves.map((points) => ({ points, color: POINT_COLOR, width: 6 }));
    const selected = this.selectedPoint && stageCurves[this.selectedPoint[0]]?.[this.selectedPoint[1]];
    if (selected) dots.push({ points: [selected], color: SELECTED_POINT_COLOR, width: 8 });
    return [lines, dots];
  }

  /** The point nearest to a pointer; null if none is near. @param {PointerPosition} pointer */
  nearestPoint({ width, height, x, y }) {
    const { camera, placement } = this.panel;
    /** @type {{index: PointIndex, distance: number, z: number} | null} */
    let nearest = null;
    for (const [c, curve] of this.curves.entries())
      for (const [k, point] of curve.entries()) {
        const projection = camera.project(placement.toStage(point), width, height);
        const distance = Math.hypot(projection.x - x, projection.y - y);
        if (distance < (nearest?.distance ?? PICK_RADIUS)) nearest = { index: [c, k], distance, z: projection.z };
      }
    return nearest;
  }

  /** The point on a segment of a curve nearest to a pointer, and the index of the start of the
   *  segment; null if none is near. @param {PointerPosition} pointer */
  nearestPointOnSegments({ width, height, x, y }) {
    const { camera, placement } = this.panel;
    /** @type {{index: PointIndex, point: number[], distance: number} | null} */
    let nearest = null;
    for (const [c, curve] of this.curves.entries())
      for (const [k, start] of curve.entries()) {
        const end = curve[(k + 1) % curve.length];
        const [a, b] = [start, end].map((point) => camera.project(placement.toStage(point), width, height));
        const [dx, dy] = [b.x - a.x, b.y - a.y];
        const s = Math.max(0, Math.min(1, ((x - a.x) * dx + (y - a.y) * dy) / Math.max(dx * dx + dy * dy, 1e-9)));
        const distance = Math.hypot(a.x + s * dx - x, a.y + s * dy - y);
        if (distance < (nearest?.distance ?? PICK_RADIUS))
          nearest = { index: [c, k], point: addScaled(start, s, addScaled(end, -1, start)), distance };
      }
    return nearest;
  }

  /** Starts to drag the point at a pointer. Returns whether one is there.
   *  @param {PointerEvent} event */
  grabPoint(event) {
    if (!this.isActive || event.button !== 0) return false;
    const nearest = this.nearestPoint(this.panel.pointerPosition(event));
    this.selectedPoint = nearest && nearest.index;
    if (nearest) {
      this.pushUndo();
      /** @type {Element} */ (event.target).setPointerCapture(event.pointerId);
      this.dragPosition = { x: event.clientX, y: event.clientY, z: nearest.z };
    }
    this.panel.updateMarks();
    return nearest !== null;
  }

  /** Moves the dragged point with a pointer. A drag is undone as a whole, to the curves that were
   *  stored when it began. @param {PointerEvent} event */
  dragPoint(event) {
    if (!this.dragPosition || !this.selectedPoint) return;
    const { camera, placement } = this.panel;
    const { width, height } = this.panel.pointerPosition(event);
    const { x, y, z } = this.dragPosition;
    const offset = placement.vectorFromStage(
      camera.dragOffset(z, event.clientX - x, event.clientY - y, width, height));
    this.dragPosition = { x: event.clientX, y: event.clientY, z };
    const [c, k] = this.selectedPoint;
    this.curves = this.curves.map((curve, i) => (i !== c ? curve
      : curve.map((p, j) => (j === k ? addScaled(p, 1, offset) : p))));
    this.isEdited = true;
    this.panel.updateState();
  }

  /** Ends a drag. */
  releasePoint() { this.dragPosition = null; }

  /** Inserts a point in the segment at a pointer. @param {MouseEvent} event */
  insertPoint(event) {
    const nearest = this.nearestPointOnSegments(this.panel.pointerPosition(event));
    if (!nearest) return;
    const [c, k] = nearest.index;
    this.selectedPoint = [c, k + 1];
    this.edit(this.curves.map((curve, i) => (i === c ? curve.toSpliced(k + 1, 0, nearest.point) : curve)));
  }

  /** Undoes, redoes, or removes the selected point. @param {KeyboardEvent} event */
  handleKey(event) {
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
      event.preventDefault();
      if (event.shiftKey) this.redo();
      else this.undo();
    } else if ((event.key === "Delete" || event.key === "Backspace") && this.isActive && this.selectedPoint) {
      event.preventDefault();
      this.removePoint(this.selectedPoint);
    }
  }

  /** @param {PointIndex} index */
  removePoint([c, k]) {
    if (this.curves[c].length <= 3) return this.panel.showMessage("A curve has three points at least.");
    this.selectedPoint = null;
    this.edit(this.curves.map((curve, i) => (i === c ? curve.toSpliced(k, 1) : curve)));
  }

  /** Smooths all curves. */
  smooth() { this.edit(this.curves.map(smoothCurve)); }

  /** Replaces the curves; that can be undone. @param {Curves} curves */
  edit(curves) {
    this.pushUndo();
    this.setCurves(curves);
  }

  /** Stores the curves, so that their next change can be undone. */
  pushUndo() {
    this.undoStack.push(this.curves);
    this.redoStack.length = 0;
  }

  undo() { this.restoreCurves(this.undoStack, this.redoStack); }

  redo() { this.restoreCurves(this.redoStack, this.undoStack); }

  /** Takes curves from one stack, and stores the present ones on the other one.
   *  @param {Curves[]} source @param {Curves[]} target */
  restoreCurves(source, target) {
    const curves = source.pop();
    if (!curves) return;
    target.push(this.curves);
    this.selectedPoint = null;
    this.setCurves(curves);
  }

  /** @param {Curves} curves */
  setCurves(curves) {
    this.curves = curves;
    this.isEdited = true;
    this.panel.updateMarks();
    this.panel.updateState();
  }
}

/** A closed curve with each point moved halfway to the middle of its neighbors.
 *  @param {number[][]} curve */
function smoothCurve(curve) {
  const n = curve.length;
  return curve.map((p, k) => p.map((x, i) =>
    0.5 * x + 0.25 * (curve[(k + 1) % n][i] + curve[(k + n - 1) % n][i])));
}
