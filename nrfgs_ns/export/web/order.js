// SPDX-License-Identifier: Apache-2.0
// Which splats a camera may see, far ones first. Runs in the worker.

const MARGIN = 0.15;  // of the picture, around it: the camera goes on moving while the splats are sorted
const SIGMAS = 3.4;   // beyond sqrt(2 ln 255) = 3.33 standard deviations even an opaque splat is not drawn

// The planes that bound what a camera sees, with a margin, in world coordinates with unit normals that point inwards:
// near, left, right, top, bottom, four numbers each. A splat whose mean is more than its reach behind one is not drawn:
// the projection, too, takes a splat's shape no further out than the margin.
//   view  rows of the world-to-camera matrix [3, 4] (x right, y down, z forwards)
//   lens  focal lengths and principal point, pixels; size: of the picture, pixels
function planesOf({ view, lens: [fx, fy, cx, cy], size: [width, height] }, near) {
  const [x, y, z] = [0, 4, 8].map((start) => Array.from(view.slice(start, start + 4)));
  const side = (across, sign, pixels, length, focal) => {
    const slope = (pixels + MARGIN * length) / focal, norm = Math.hypot(1, slope);
    return across.map((value, k) => (sign * value + slope * z[k]) / norm);
  };
  return Float32Array.from([
    ...[z[0], z[1], z[2], z[3] - near],
    ...side(x, 1, cx, width, fx), ...side(x, -1, width - cx, width, fx),
    ...side(y, 1, cy, height, fy), ...side(y, -1, height - cy, height, fy),
  ]);
}

// The axes, as rows, of a unit quaternion.
function axesOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

class Order {
  // n splats. spare: buffers of 8 n bytes or more, for sorting, if there are any.
  constructor(n, spare) {
    Object.assign(this, { count: n, spare, keys: null });
    this.means = new Float32Array(3 * n);
    this.reach = new Float32Array(n);  // radius of a ball outside which a splat is not drawn
    // For rays, in bytes: the quaternion (w, x, y, z), scales as shares of the largest, and the opacity.
    this.shapes = new Uint8Array(8 * n);
  }

  // Takes rows of the table of `readScene`, from splat `first` on.
  add(first, table) {
    const { means, reach, shapes } = this;
    for (let i = first, at = 0; at < table.length && i < this.count; i++, at += 16) {
      const largest = Math.max(table[at + 8], table[at + 9], table[at + 10]);
      for (let a = 0; a < 3; a++) means[3 * i + a] = table[at + a];
      reach[i] = SIGMAS * largest;
      for (let k = 0; k < 4; k++) shapes[8 * i + k] = Math.round(128 + 127 * table[at + 4 + k]);
      for (let k = 0; k < 3; k++) shapes[8 * i + 4 + k] = Math.max(1, Math.round((255 * table[at + 8 + k]) / largest));
      shapes[8 * i + 7] = Math.round(255 / (1 + Math.exp(-table[at + 3])));
    }
  }

  // Rows of the table, far to near; of equally deep splats the later first: gsplat draws the earlier in front.
  sorted({ view, lens, size, near }) {
    if (!this.keys) {
      [this.keys, this.rows] = [0, 1].map(() => {
        const n = this.count, buffer = this.spare.pop() ?? new ArrayBuffer(8 * n);
        return [new Uint32Array(buffer, 0, n), new Uint32Array(buffer, 4 * n, n)];
      });
      this.depths = new Float32Array(this.keys[0].buffer);
    }
    const { means, reach, depths } = this;
    const planes = planesOf({ view, lens, size }, near);
    let m = 0;
    const rows = this.rows[0];
    for (let i = 0; i < this.count; i++) {
      const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2], r = reach[i];
      const depth = Math.fround(view[8] * x + view[9] * y + view[10] * z + view[11]);
      if (!(depth >= near)) continue;
      let seen = true;
      for (let k = 4; k < 20 && seen; k += 4) {
        seen = planes[k] * x + planes[k + 1] * y + planes[k + 2] * z + planes[k + 3] > -r;
      }
      if (!seen) continue;
      depths[m] = depth;  // the bits of a positive float sort like the float
      rows[m++] = i;
    }
    this._radix(m);
    return this.rows[0].slice(0, m).reverse();
  }

  // How far along a ray (a unit direction) half of the light has been stopped; null if it goes through.
  along({ eye, direction }) {
    const { means, reach, shapes } = this, hits = [];
    for (let i = 0; i < this.count; i++) {
      const x = means[3 * i] - eye[0], y = means[3 * i + 1] - eye[1], z = means[3 * i + 2] - eye[2];
      const far = x * direction[0] + y * direction[1] + z * direction[2];
      if (far <= 0 || x * x + y * y + z * z - far * far > reach[i] * reach[i]) continue;
      // Where the ray passes nearest to the mean, in standard deviations along the splat's own axes: the columns of
      // axesOf, or the rows for the inverse quaternion.
      const axes = axesOf([128 - shapes[8 * i], ...[1, 2, 3].map((k) => shapes[8 * i + k] - 128)].map((q) => q / 127));
      let oo = 0, od = 0, dd = 0;
      for (let k = 0; k < 3; k++) {
        const [a, b, c] = axes[k], deviation = (shapes[8 * i + 4 + k] / 255) * (reach[i] / SIGMAS);
        const o = (a * x + b * y + c * z) / deviation, d = (a * direction[0] + b * direction[1] + c * direction[2]) / deviation;
        oo += o * o;
        od += o * d;
        dd += d * d;
      }
      const alpha = (shapes[8 * i + 7] / 255) * Math.exp(0.5 * ((od * od) / dd - oo));
      if (od > 0 && alpha >= 1 / 255) hits.push([od / dd, alpha]);
    }
    let left = 1;
    for (const [depth, alpha] of hits.sort((a, b) => a[0] - b[0])) if ((left *= 1 - alpha) < 0.5) return depth;
    return null;
  }

  // Stable sort of the first m keys with their rows, by four bytes; the result is back in the first of each pair.
  _radix(m) {
    const { keys, rows } = this;
    const counts = new Uint32Array(4 * 256);
    for (let i = 0; i < m; i++) {
      const key = keys[0][i];
      for (let b = 0; b < 4; b++) counts[256 * b + ((key >>> (8 * b)) & 255)]++;
    }
    for (let b = 0; b < 4; b++) {
      const from = b & 1, to = 1 - from, shift = 8 * b;
      const starts = new Uint32Array(256);
      for (let v = 1; v < 256; v++) starts[v] = starts[v - 1] + counts[256 * b + v - 1];
      const [k0, r0, k1, r1] = [keys[from], rows[from], keys[to], rows[to]];
      for (let i = 0; i < m; i++) {
        const place = starts[(k0[i] >>> shift) & 255]++;
        k1[place] = k0[i];
        r1[place] = r0[i];
      }
    }
  }
}

const MOST_SENT = 2;  // parts of a scene that are on their way to the painter

// What the worker answers: {read} with a file's bytes, answered by all that `readScene` yields and {read}, and with a
// buffer that comes back as {spent}; then any number of {camera} and {pick}.
function answer(post) {
  let order = null, reading = null, sent = 0;
  const spare = [];
  const go = () => {
    while (reading && sent < MOST_SENT) {
      const { value: part = { read: true } } = reading.next(), [, values] = part.table ?? part.latents ?? [];
      if (part.scene) order = new Order(part.scene.count, spare);
      if (part.table) order.add(...part.table);
      if (part.read) reading = null;
      if (values) sent++;
      post(part, values ? [values.buffer] : []);
    }
  };
  return ({ read, spent, camera, pick }) => {
    try {
      if (read || spent) {
        if (read) reading = readScene(read, spare);
        else [sent] = [sent - 1, spare.push(spent)];
        go();
      } else if (pick) {
        post({ picked: order.along(pick) });
      } else {
        const rows = order.sorted(camera);
        post({ sorted: { rows, along: order.along(camera) } }, [rows.buffer]);
      }
    } catch (error) {
      reading = null;
      if (!(error instanceof BadFile)) console.error(error);
      post({ failed: error instanceof BadFile ? error.message : UNREADABLE });
    }
  };
}

if (typeof WorkerGlobalScope !== "undefined") {
  const handle = answer((message, transfer) => self.postMessage(message, transfer));
  self.onmessage = (event) => handle(event.data);
}
