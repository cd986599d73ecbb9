// The placement of the surfaces on the stage: a rotation, a scale and a translation.
// @ts-check

/** Maps points between the coordinates of the surfaces and the stage. */
export class Placement {
  /** @param {number[]} numbers the rotation by rows, the translation, and the scale */
  constructor(numbers) {
    this.rotation = numbers.slice(0, 9);
    this.translation = numbers.slice(9, 12);
    this.scale = numbers[12];
  }

  /** The point on the stage of a point in the coordinates of the surfaces. @param {number[]} p */
  toStage(p) {
    const { rotation: r, translation, scale } = this;
    return [0, 1, 2].map((k) =>
      scale * (r[3 * k] * p[0] + r[3 * k + 1] * p[1] + r[3 * k + 2] * p[2]) + translation[k]);
  }

  /** The point in the coordinates of the surfaces of a point on the stage. @param {number[]} p */
  fromStage(p) { return this.vectorFromStage(p.map((x, k) => x - this.translation[k])); }

  /** The vector in the coordinates of the surfaces of a vector on the stage. @param {number[]} d */
  vectorFromStage(d) {
    const { rotation: r, scale } = this;
    return [0, 1, 2].map((k) => (r[k] * d[0] + r[3 + k] * d[1] + r[6 + k] * d[2]) / scale);
  }
}
