// SPDX-License-Identifier: Apache-2.0
// Cameras and ways between them. A camera is {eye, axes, distance, lens}: where it is, its axes as rows (right, down,
// forwards), how far in front the point lies that it turns around, and, in units of its image's height, focal lengths,
// principal point and the image's width.

const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const minus = (a, b) => plus(a, b, -1);
const norm = (a) => Math.hypot(...a);
const unit = (a) => a.map((value) => value / norm(a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const targetOf = ({ eye, axes, distance }) => plus(eye, axes[2], distance);

function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), across = cross(axis, vector), along = dot(axis, vector) * (1 - c);
  return vector.map((value, k) => c * value + s * across[k] + along * axis[k]);
}

// Axes that look along `forward`, whose right is as near to a given one as can be.
function facing(forward, right) {
  const ahead = unit(forward), side = unit(plus(right, ahead, -dot(right, ahead)));
  return [side, cross(ahead, side), ahead];
}

// Camera to world (x right, y up, z backwards), column by column: three.js's matrixWorld.elements.
const matrixOf = ({ eye, axes: [right, down, ahead] }) =>
  [...right, 0, ...down.map((v) => -v), 0, ...ahead.map((v) => -v), 0, ...eye, 1];

function poseOf(matrix) {
  const column = (c, sign) => [0, 1, 2].map((row) => sign * matrix[4 * c + row]);
  return { eye: column(3, 1), axes: [column(0, 1), column(1, -1), column(2, -1)] };
}

// The lens on a canvas: the whole image, unless it would fill less than 60% of the canvas one way, or show more than 90
// degrees: what lies around a photograph was seen less, if at all.
function lensOn([fx, fy, cx, cy, w], width, height) {
  const whole = Math.min(width / w, height), filling = Math.max(width / w, height);
  const s = Math.max(whole, 0.6 * filling, Math.min(filling, (0.5 * Math.max(width, height)) / fx));
  return [s * fx, s * fy, s * cx + (width - s * w) / 2, s * cy + (height - s) / 2];
}

// A unit quaternion (w, x, y, z) of axes; axesOf is the way back.
function quaternionOf([x, y, z]) {
  const a = z[1] - y[2], b = x[2] - z[0], c = y[0] - x[1], d = x[1] + y[0], e = x[2] + z[0], f = y[2] + z[1];
  const rows = [  // the quaternion times each of its numbers: the largest is exact
    [1 + x[0] + y[1] + z[2], a, b, c], [a, 1 + x[0] - y[1] - z[2], d, e],
    [b, d, 1 - x[0] + y[1] - z[2], f], [c, e, f, 1 - x[0] - y[1] + z[2]],
  ];
  return unit(rows.reduce((best, row, k) => (row[k] > best[0] ? [row[k], row] : best), [-1])[1]);
}

const STEPS = 24;  // of a stretch between two cameras, by which its length is measured

// A smooth way through cameras: {at, seconds}, where at(share) is a camera, the first for 0 and the last for 1.
//   seconds  it takes; null: `scale` (a distance in the scene) takes 2.5 seconds, a turn of 60 degrees as well
//   timed    stretches take equal times, as they were recorded; otherwise the speed is the same all the way
function wayThrough(cameras, scale, seconds = null, timed = false) {
  const last = cameras.length - 1;
  const long = (points) => points.slice(1).reduce((sum, point, k) => sum + norm(minus(point, points[k])), 0);
  // Cameras that look at the same things go around them, others straight on.
  const around = long(cameras.map(targetOf)) < long(cameras.map(({ eye }) => eye));
  let turn = null;
  const keys = cameras.map((camera) => {
    const next = quaternionOf(camera.axes);
    turn = turn && dot(turn, next) < 0 ? next.map((v) => -v) : next;
    return [...turn, Math.log(camera.distance), ...(around ? targetOf(camera) : camera.eye), ...camera.lens];
  });
  const between = (place) => {
    const i = Math.max(0, Math.min(last - 1, Math.floor(place))), t = place - i, key = (k) => keys[Math.max(0, Math.min(last, k))];
    const weights = [(t * (2 - t) - 1) * t, (3 * t - 5) * t * t + 2, ((4 - 3 * t) * t + 1) * t, (t - 1) * t * t];  // Catmull-Rom
    const mixed = keys[0].map((_, n) => 0.5 * weights.reduce((sum, weight, k) => sum + weight * key(i + k - 1)[n], 0));
    const axes = axesOf(unit(mixed.slice(0, 4))), distance = Math.exp(mixed[4]), point = mixed.slice(5, 8);
    return { eye: around ? plus(point, axes[2], -distance) : point, axes, distance, lens: mixed.slice(8) };
  };
  const lengths = [0];
  for (let k = 1, was = between(0); k <= STEPS * last; k++) {
    const now = between(k / STEPS);
    lengths.push(lengths[k - 1] + norm(minus(now.eye, was.eye)) / scale + norm(minus(now.axes[2], was.axes[2])));
    was = now;
  }
  const whole = lengths.at(-1);
  seconds ??= Math.max(1, 2.5 * whole);
  const ramp = Math.min(0.5, 1 / seconds);  // a second to get up to speed, one to stop
  const at = (share) => {
    if (share <= 0 || share >= 1) return cameras[share <= 0 ? 0 : last];
    if (timed) return between(share * last);
    const late = Math.min(share, 1 - share);
    const eased = late < ramp ? (late * late) / (2 * ramp * (1 - ramp)) : (late - ramp / 2) / (1 - ramp);
    const length = whole * (share < 0.5 ? eased : 1 - eased);
    const k = Math.max(1, lengths.findIndex((value) => value >= length));
    return between((k - 1 + (length - lengths[k - 1]) / (lengths[k] - lengths[k - 1] || 1)) / STEPS);
  };
  return { at, seconds };
}
