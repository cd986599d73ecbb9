// The check of a device: hits that it computes for rays with known answers, compared with the
// answers of Dr.Jit. The criteria, and how they were measured, are those of `harnack.tracer.hits`.
// @ts-check

import { dot } from "./camera.js";

/** @import {Surface} from "./renderer.js" */
/** @typedef {{differingStatus: number, unexplainedMisses: number, distanceErrors: number[],
 *             normalErrors: number[], evaluations: number, evaluationDifference: number}} Comparison */

const STATUS = { MISS: 0, HIT: 1, OUT_OF_STEPS: 2 };
// A ray is grazing if the cosine of its angle with the normal is less than this.
const GRAZING_COSINE = 0.1;
// Differences that other roundings explain: the fraction of rays with another status, the error of
// distances relative to the tolerance, the error of normals, and of the number of evaluations.
const MAX_STATUS_FRACTION = 1e-3;
const MAX_DISTANCE_ERROR = 0.1;
const MAX_NORMAL_ERROR = 2e-4;
const MAX_EVALUATION_ERROR = 0.03;

/** The difference between the hits of a device and those of Dr.Jit, in words; empty if they agree.
 *  All arrays hold 32-bit words.
 *  @param {Surface} surface @param {number} count the number of rays
 *  @param {Uint32Array} rays the lanes of the kernel @param {Uint32Array} expected Dr.Jit's results
 *  @param {Uint32Array} computed the results of the device */
export function describeDisagreement(surface, count, rays, expected, computed) {
  const comparison = compareHits(surface, count, rays, expected, computed);
  const { differingStatus, unexplainedMisses, distanceErrors, normalErrors } = comparison;
  const { evaluations, evaluationDifference } = comparison;
  if (unexplainedMisses || differingStatus > MAX_STATUS_FRACTION * count)
    return `${differingStatus} of ${count} rays end otherwise`;
  if (distanceErrors.filter((error) => error > 2).length > MAX_STATUS_FRACTION * count)
    return "hits lie off the surface";
  if (quantile(distanceErrors, 0.9) > MAX_DISTANCE_ERROR)
    return "hits lie elsewhere, if within the tolerance";
  // NaN is an error, too.
  if (!(quantile(normalErrors, 0.9) <= MAX_NORMAL_ERROR)) return "normals differ";
  if (evaluationDifference > MAX_EVALUATION_ERROR * (evaluations + count) + 2)
    return "rays take another number of evaluations";
  return "";
}

/** Counts and errors of the hits of all rays; the parameters are those of describeDisagreement.
 *  @param {Surface} surface @param {number} count @param {Uint32Array} rays
 *  @param {Uint32Array} expected @param {Uint32Array} computed @returns {Comparison} */
function compareHits(surface, count, rays, expected, computed) {
  const { results, tolerance, lanes } = surface;
  const [rayFloats, expectedFloats, computedFloats] =
    [rays, expected, computed].map((words) => new Float32Array(words.buffer));
  /** @type {Comparison} */
  const comparison = { differingStatus: 0, unexplainedMisses: 0, distanceErrors: [],
    normalErrors: [], evaluations: 0, evaluationDifference: 0 };
  for (let k = 0; k < count; k++) {
    const [status, expectedStatus] = [computed[results[0] * count + k], expected[k]];
    const [evaluations, expectedEvaluations] = [computed[results[5] * count + k], expected[5 * count + k]];
    comparison.evaluations += expectedEvaluations;
    comparison.evaluationDifference += Math.abs(evaluations - expectedEvaluations);
    const direction = [3, 4, 5].map((value) => rayFloats[lanes.indexOf(value) * count + k]);
    const normal = [2, 3, 4].map((result) => expectedFloats[result * count + k]);
    const cosine = Math.abs(dot(direction, normal));
    if (status !== expectedStatus) {
      comparison.differingStatus++;
      const isExplained = Math.max(status, expectedStatus) === STATUS.OUT_OF_STEPS || cosine < GRAZING_COSINE;
      if (!isExplained && expectedStatus === STATUS.HIT) comparison.unexplainedMisses++;
    }
    if (status !== STATUS.HIT || expectedStatus !== STATUS.HIT) continue;
    const [t, expectedT] = [computedFloats[results[1] * count + k], expectedFloats[count + k]];
    // The distance from the surface, less what rounding of t explains.
    const distance = Math.abs(t - expectedT) * Math.max(cosine, GRAZING_COSINE) - 8e-6 * (1 + expectedT);
    comparison.distanceErrors.push(Number.isNaN(distance) ? Infinity : distance / tolerance);
    if (cosine >= GRAZING_COSINE)
      comparison.normalErrors.push(Math.hypot(...[2, 3, 4].map((result, axis) =>
        computedFloats[results[result] * count + k] - normal[axis])));
  }
  return comparison;
}

/** A quantile of numbers, which it sorts; NaN if one of them is.
 *  @param {number[]} numbers @param {number} fraction */
function quantile(numbers, fraction) {
  if (numbers.some(Number.isNaN)) return NaN;
  return numbers.sort((a, b) => a - b)[Math.floor(fraction * (numbers.length - 1))] ?? 0;
}
