// SPDX-License-Identifier: Apache-2.0
// Reads a compact file (docs/compact-format.md says where it is specified): container, xz streams, coded tables, splats. Runs in the worker.

const MAGIC = [0x89, 0x4e, 0x52, 0x46, 0x0d, 0x0a, 0x1a, 0x0a];
const VERSION = 3;
const bytesOf = (dtype) => dtype.match(/\d+/) / 8;
const CODINGS = new Map([
  ["xz", ["uint8", "uint16", "uint32", "uint64", "float16", "float32"]], ["rans", ["int16", "int32", "uint32"]],
]);
const LARGEST_RATIO = 32, SMALL = 2 ** 24;  // what a file may unpack to: times its size, and bytes that any file may
const LARGEST = 1e18;  // of an option, and of the unit of length
const TABLES = new Map([["means", ["uint32"]], ["splats", ["int16", "int32"]], ["latents", ["int16", "int32"]]]);
const WIDTHS = { means: 3, opacities: 1, scales: 3, colors: 3, turns: 3 };  // numbers of a splat in each grid
const SH_C0 = 0.28209479177387814, { imul } = Math;
const ARRAYS = { int16: Int16Array, int32: Int32Array, uint32: Uint32Array };
const WIDTH = 4096;  // texels of a texture's row
const PART = 2 ** 14;  // splats of the table at a time: whole rows

// The field's options, and what is assumed of one that a file leaves out.
const OPTIONS = {
  "latent_dim": 32, "num_bands": 3, "hidden_width": 64, "split_bands": true, "opacity_residual": true,
  "use_distance": true, "color_scale": 0.2, "opacity_scale": 0.2, "distance_eps": 0.01, "output_init": "zero",
  "opacity_bound": "straight-through", "implementation": "auto", "precision": "bf16"
};
const LIMITS = {
  latent_dim: [1, 1024], num_bands: [1, 16], hidden_width: [1, 4096], color_scale: [0, LARGEST],
  opacity_scale: [0, LARGEST], distance_eps: [Number.MIN_VALUE, LARGEST],
};
const CHOICES = {
  output_init: ["zero", "default"], opacity_bound: ["straight-through", "logit"],
  implementation: ["auto", "torch", "fused"], precision: ["fp32", "tf32", "bf16", "fp16"],
};

// What is said to a reader: a fault of the file, or what a device lacks.
class BadFile extends Error {}
class Lacking extends Error {}
const UNREADABLE = "The scene cannot be read: it is damaged, or needs more memory than this device has.";

function expect(right, what) {
  if (!right) throw new BadFile(`The scene is damaged: ${what}.`);
}
const isCount = (value) => Number.isInteger(value) && value >= 0;
const isNumber = (value, low, high) => typeof value === "number" && value >= low && value <= high;

// Whether a value is an object with these keys, and no others except the optional ones.
function hasKeys(value, keys, optional = []) {
  if (typeof value !== "object" || value === null || Array.isArray(value)) return false;
  const own = Object.keys(value);
  return keys.every((key) => own.includes(key)) && own.every((key) => keys.includes(key) || optional.includes(key));
}

// Reads a file's bytes; BadFile where docs/compact-format.md has a file refused. Yields one of these at a time:
//   {progress}                 the share that is done
//   {scene}                    {header, count, weights}; weights: name -> {shape, values}
//   {table: [first, rows]}     Float32Array, the table from splat `first` on, filled up to whole rows of a texture: mean,
//                              logit of opacity; rotation (w, x, y, z); standard deviations, 0; base colour, 0
//   {latents: [layer, codes]}  four numbers of each splat's latent, in steps of their grids, filled up likewise
// so that only a part of the scene lies in memory. `spare`: the last two's buffers, to be used again.
function* readScene(bytes, spare) {
  try {
    const { header, streams } = readContainer(bytes);
    checkHeader(header);
    yield* sceneOf(header, streams, spare);
  } catch (error) {
    if (error instanceof BadFile) throw error;
    throw new BadFile(UNREADABLE);
  }
}

// Fills in what a file may leave out.
function checkHeader(header) {
  const { head, render, grids, splats } = header;
  expect(hasKeys(header, ["format", "splats", "head", "render", "grids", "streams"]), "its header is of another kind");
  expect(hasKeys(head, ["name", "config", "scene_unit"]), "its header does not describe a field");
  expect(header.format === "nrfgs-compact" && head.name === "nrf", "it is not a neural residual field");
  expect(hasKeys(head.config, [], Object.keys(OPTIONS)), "its field has unknown options");
  head.config = { ...OPTIONS, ...head.config };
  for (const [name, value] of Object.entries(head.config)) {
    const [low, high] = LIMITS[name] ?? [];
    const whole = low === undefined || Number.isInteger(value) || !Number.isInteger(OPTIONS[name]);
    const right = low === undefined ? CHOICES[name]?.includes(value) ?? typeof value === "boolean" : isNumber(value, low, high);
    expect(right && whole, `its field's ${name} is out of range`);
  }
  expect(isNumber(head.scene_unit, 1 / LARGEST, LARGEST), "its unit of length is out of range");
  const drawn = hasKeys(render, ["rasterize_mode", "background"], ["near_plane"]) && ["classic", "antialiased"].includes(render.rasterize_mode);
  expect(drawn, "it does not say how it is drawn");
  const { background } = render;
  const color = Array.isArray(background) && background.length === 3 && background.every((value) => isNumber(value, 0, 1));
  expect(color, "its background is no colour");
  if ("near_plane" in render) expect(isNumber(render.near_plane, 0, LARGEST), "its near plane is out of range");
  render.near_plane ||= 0.01 * head.scene_unit;
  const widths = { ...WIDTHS, latents: head.config.latent_dim };
  expect(hasKeys(grids, Object.keys(widths)), "its grids are of another kind");
  for (const [name, width] of Object.entries(widths)) {
    expect(hasKeys(grids[name], ["low", "step"]), `the grid of its ${name} is of another kind`);
    for (const part of ["low", "step"]) {
      const row = grids[name][part];
      const right = Array.isArray(row) && row.length === width && row.every(Number.isFinite);
      expect(right, `the grid of its ${name} is of another kind`);
    }
    expect(grids[name].step.every((step) => step > 0), `the grid of its ${name} has steps that are not positive`);
  }
  expect(isCount(splats) && splats > 0, "it has no splats");
}

// The network's weights and their shapes.
function shapesOf(config) {
  const { latent_dim, num_bands, hidden_width, split_bands } = config;
  const shared = latent_dim + 3 + config.use_distance, low = 10, high = 6 * (num_bands - 1);
  const outputs = 3 + config.opacity_residual;
  const shapes = new Map();
  const branch = (name, inputs, units, out) => {
    const parts = { "0.weight": [units, inputs], "0.bias": [units], "2.weight": [out, units], "2.bias": [out] };
    for (const [part, shape] of Object.entries(parts)) shapes.set(`head.${name}.${part}`, shape);
  };
  if (split_bands) branch("low", shared + low, hidden_width, outputs);
  else branch("low", shared + low + high, 2 * hidden_width, outputs);
  if (split_bands && high > 0) branch("high", shared + high, hidden_width, 4);
  return shapes;
}

// Gives arrays' memory back at once: it is sent to nobody. With `transfer(0)` what came in a message would stay until
// the browser looks for garbage.
const { port1: nowhere, port2 } = new MessageChannel();
port2.close();
const free = (arrays) => nowhere.postMessage(0, arrays.map(({ buffer }) => buffer));

function* sceneOf(header, streams, spare) {
  const count = header.splats, { config } = header.head, rank = config.latent_dim, weights = {};
  const shapes = shapesOf(config).set("means", [2, count]).set("splats", [10, count]).set("latents", [rank, count]);
  expect(streams.size === shapes.size, "it has other streams than its field needs");
  for (const [name, shape] of shapes) {
    const stream = streams.get(name), table = TABLES.get(name);
    expect(stream && String(stream.shape) === String(shape), `its ${name} does not fit its field or its splats`);
    expect(stream.coding === (table ? "rans" : "xz"), `its ${name} is in another coding`);
    expect((table ?? ["float16", "float32"]).includes(stream.dtype), `its ${name} holds other numbers`);
  }
  for (const [name, stream] of streams) {
    if (TABLES.has(name)) continue;
    const values = stream.dtype === "float32" ? new Float32Array(numbers(stream).buffer) : halves(numbers(stream));
    expect(values.every(Number.isFinite), `its ${name} is not finite`);
    weights[name.slice("head.".length)] = { shape: stream.shape, values };
  }
  yield { scene: { header, count, weights } };
  const latents = streams.get("latents"), Codes = ARRAYS[latents.dtype];
  const size = 4 * WIDTH * Math.ceil(count / WIDTH);  // numbers of a layer
  const buffer = () => spare.pop() ?? new ArrayBuffer(Math.max(size * Codes.BYTES_PER_ELEMENT, 64 * PART));
  const parts = Array.from({ length: Math.ceil(count / PART) }, () => []);  // their columns
  let done = 0;
  for (const name of ["means", "splats"]) {
    for (const write of decodeTable(streams.get(name))) {
      parts.forEach((columns, k) => {
        const first = k * PART, end = Math.min(first + PART, count);
        columns.push(new ARRAYS[streams.get(name).dtype](end - first));
        write(columns.at(-1), -first, 1, first, end);
      });
      yield { progress: ++done / (12 + rank) };
    }
  }
  const place = { upper: 0, lower: 0 };
  for (const [k, columns] of parts.entries()) {
    expect(columns[0].every((upper) => upper < 2 ** 31), "its means are beyond 63 bits");
    const table = new Float32Array(buffer(), 0, 16384 * Math.ceil(columns[0].length / 1024));
    fillTable(table, header.grids, place, columns);
    free(columns);
    yield { table: [k * PART, table] };
  }
  const { low, step } = header.grids.latents;
  let r = 0, codes;
  for (const write of decodeTable(latents)) {
    if (r % 4 === 0) codes = new Codes(buffer(), 0, size);
    const ends = write(codes, r % 4, 4).map((code) => Math.fround(low[r] + step[r] * code));
    expect(ends.every(Number.isFinite), "its latents are not finite");
    if (++r % 4 === 0 || r === rank) yield { latents: [(r - 1) >> 2, codes] };
    yield { progress: (12 + r) / (12 + rank) };
  }
}

// The header, and name -> {coding, dtype, shape, body}, with checksums that hold.
function readContainer(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 28 || MAGIC.some((byte, i) => bytes[i] !== byte)) {
    throw new BadFile("The page does not hold a scene of nrfgs, or only a part of one.");
  }
  const version = view.getUint32(8, true);
  if (version !== VERSION) throw new BadFile("The scene is of another version than this page reads.");
  const length = view.getUint32(12, true), total = Number(view.getBigUint64(16, true));
  if (total !== bytes.length || 28 + length > total) {
    throw new BadFile(`The scene has ${bytes.length} bytes instead of ${total}: the page is cut short.`);
  }
  expect(crc32(bytes.subarray(0, 24 + length)) === view.getUint32(24 + length, true), "the checksum of its header does not hold");
  let header = null;
  try {
    header = JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes.subarray(24, 24 + length)));
  } catch {
    expect(false, "its header is no JSON");
  }
  expect(Array.isArray(header?.streams), "its header is of another kind");
  const streams = new Map();
  let at = 28 + length, unpacked = 0;
  for (const entry of header.streams) {
    const fits = hasKeys(entry, ["name", "coding", "dtype", "shape", "bytes", "crc32"]) && typeof entry.name === "string";
    expect(fits && CODINGS.get(entry.coding)?.includes(entry.dtype), "one of its streams is of another kind");
    const { name, dtype, shape, bytes: size, coding } = entry;
    expect(Array.isArray(shape) && shape.every(isCount) && isCount(size), `its stream ${name} has no size`);
    expect(!streams.has(name), `it has two streams ${name}`);
    unpacked += bytesOf(dtype) * shape.reduce((a, b) => a * Math.max(b, 1), 1);
    expect(unpacked <= Math.max(LARGEST_RATIO * total, SMALL), `its stream ${name} is too large`);
    const body = bytes.slice(at, at + size);
    at += size;
    expect(body.length === size && crc32(body) === entry.crc32, `the checksum of its stream ${name} does not hold`);
    streams.set(name, { coding, dtype, shape, body });
  }
  expect(at === total, "it goes on after its last stream");
  free([bytes]);
  return { header, streams };
}

// Rows of the table of splats whose columns are given; `place` as in readPlaces.
function fillTable(table, grids, place, [uppers, lowers, ...splats]) {
  const n = lowers.length, { low, step } = grids.turns;
  table.fill(0);
  readPlaces(place, lowers, uppers, grids.means, table);
  // `scaled`: of a value that Python keeps otherwise, and that must be finite in float32.
  const put = (column, { low, step }, c, offset, scaled = false) => {
    for (let i = 0; i < n; i++) {
      const value = low[c] + step[c] * column[i];
      expect(Number.isFinite(Math.fround(scaled ? (value - 0.5) / SH_C0 : value)), "its splats are not finite");
      table[16 * i + offset] = value;
    }
  };
  put(splats[0], grids.opacities, 0, 3);
  for (let c = 0; c < 3; c++) {
    put(splats[1 + c], grids.scales, c, 8 + c);
    put(splats[4 + c], grids.colors, c, 12 + c, true);
  }
  for (let i = 0; i < n; i++) {
    const at = 16 * i;
    const x = low[0] + step[0] * splats[7][i], y = low[1] + step[1] * splats[8][i], z = low[2] + step[2] * splats[9][i];
    const w = Math.sqrt(Math.max(1 - (x * x + y * y + z * z), 1e-6)), norm = Math.sqrt(w * w + x * x + y * y + z * z);
    table[at + 4] = w / norm;
    table[at + 5] = x / norm;
    table[at + 6] = y / norm;
    table[at + 7] = z / norm;
    let sum = 0;  // finite if all are: their squares fit into float64
    for (let c = 0; c < 8; c++) sum += table[at + c] ** 2;
    expect(Number.isFinite(sum), "its splats are not finite");
    for (let c = 8; c < 11; c++) table[at + c] = Math.exp(table[at + c]);
  }
}

// By a byte: what it does to a checksum with no, one, two and three bytes behind it.
const CRC = new Int32Array(4 * 256);
for (let n = 0; n < 256; n++) {
  for (let k = 0, c = n; k < 32; k++) {
    c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
    CRC[256 * (k >> 3) + n] = c;
  }
}

function crc32(bytes) {
  const words = bytes.length & ~3;
  let crc = -1, i = 0;
  for (; i < words; i += 4) {
    crc ^= bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16) | (bytes[i + 3] << 24);
    crc = CRC[768 + (crc & 255)] ^ CRC[512 + ((crc >>> 8) & 255)] ^ CRC[256 + ((crc >>> 16) & 255)] ^ CRC[crc >>> 24];
  }
  for (; i < bytes.length; i++) crc = CRC[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return (crc ^ -1) >>> 0;
}

// The numbers of a stream of "xz": of two bytes as Uint16Array, of four as Uint32Array.
function numbers({ dtype, shape, body }) {
  const size = bytesOf(dtype), n = shape.reduce((a, b) => a * b, 1), planes = unxz(body, size * n);
  const out = size === 2 ? new Uint16Array(n) : new Uint32Array(n);
  for (let k = 0; k < size; k++) for (let i = 0; i < n; i++) out[i] |= planes[k * n + i] << (8 * k);
  return out;
}

function halves(codes) {
  return Float32Array.from(codes, (code) => {
    const sign = code & 0x8000 ? -1 : 1, exponent = (code >> 10) & 31, fraction = code & 1023;
    if (exponent === 0) return sign * fraction * 2 ** -24;
    return exponent === 31 ? NaN : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  });
}

// Every third bit of 30, pressed together.
function thirds(x) {
  x &= 0x09249249;
  x = (x ^ (x >>> 2)) & 0x030c30c3;
  x = (x ^ (x >>> 4)) & 0x0300f00f;
  x = (x ^ (x >>> 8)) & 0x030000ff;
  return (x ^ (x >>> 16)) & 0x3ff;
}

// Running sums, on top of `place`, of 64-bit differences, given as lower and upper 32 bits, and the coordinates whose
// bits alternate in them.
function readPlaces(place, lowers, uppers, { low, step }, table) {
  let { lower, upper } = place;
  for (let i = 0; i < lowers.length; i++) {
    const sum = lower + lowers[i];
    const carry = sum >= 2 ** 32 ? 1 : 0;
    lower = sum >>> 0;
    upper = (upper + carry + uppers[i]) >>> 0;
    const middle = (lower >>> 30) | ((upper & 0x0fffffff) << 2);
    for (let a = 0; a < 3; a++) {
      const code = thirds(lower >>> a & 0x3fffffff >>> a) | (thirds(middle >>> a) << 10) | (((upper >>> (28 + a)) & 1) << 20);
      table[16 * i + a] = low[a] + step[a] * code;
    }
  }
  Object.assign(place, { lower, upper });
}

// ---- coded tables: rANS in lanes, as entropy.py's docstring has it. Whole numbers alone, so that every reader agrees.

const PRECISION = 14, MASK = (1 << PRECISION) - 1, LOWEST = 1 << 16, DIRECT = 32, TOKENS = 140, MOST_ACTIVITY = 4 * 16 * 139;
const MOST_CONTEXTS = 16, MOST_MODEL = 13 + MOST_CONTEXTS * (3 + TOKENS), LARGEST_WEIGHT = 1 << 16;

// Decodes a table; yields for each column write(out, first, stride), which puts the number of row i at first + i stride of
// an array, and returns the least and the largest of a signed column; or so only the rows `from` to `to`.
function* decodeTable({ body, shape, dtype }) {
  const hold = (right) => expect(right, "one of its tables cannot be decoded");
  hold(shape.length === 2 && shape[0] <= 1024 && body.length >= 8);
  const [C, n] = shape, view = new DataView(body.buffer, body.byteOffset, body.byteLength);
  const count = view.getUint32(0, true), size = view.getUint32(4, true);
  hold(count <= MOST_MODEL * C && 8 + size <= body.length);
  const model = new Int32Array(numbers({ dtype: "uint32", shape: [count], body: body.subarray(8, 8 + size) }).buffer);
  let read = 0;
  const take = () => {
    hold(read < count);
    return model[read++];
  };
  let lanes = 1;
  while (lanes < Math.min(1024, Math.ceil((C * n) / 2048))) lanes *= 2;
  const S = Math.ceil(n / lanes), state = new Int32Array(lanes), words = new Uint16Array(2 ** 15);
  let at = 8 + size;
  hold(at + 4 * lanes <= body.length && (body.length - at) % 2 === 0);
  for (let l = 0; l < lanes; l++, at += 4) state[l] = view.getInt32(at, true);
  hold(state.every((x) => x >>> 16 > 0));
  // `words`: the next ones, from the w-th on, with zeros behind the last. A step takes up to three for each lane.
  const coder = { state, words, w: words.length, most: 0 }, raw = new Uint8Array(words.buffer);
  at -= raw.length;

  // Of a column and two to its left, in the order of decoding: row l S + t at (2 + t) lanes + l.
  const columns = [0, 1, 2].map(() => new ARRAYS[dtype]((2 + S) * lanes)), fresh = new Int32Array(lanes);
  const tokens = columns.map((column) => new Uint8Array(column.length));
  const chances = new Int32Array(MOST_CONTEXTS << 8);  // by context and token: its frequency, and 14 bits of its start
  const lookup = new Uint8Array(MOST_CONTEXTS << PRECISION), context = new Uint8Array(MOST_ACTIVITY + 1);
  for (let c = 0; c < C; c++) {
    const signed = take() !== 0;
    const weights = Array.from({ length: 7 }, take), shares = Array.from({ length: 4 }, take);
    const contexts = take();
    hold(contexts >= 0 && contexts < MOST_CONTEXTS && weights.every((w) => Math.abs(w) <= LARGEST_WEIGHT));
    const thresholds = Array.from({ length: contexts }, take);
    hold(thresholds.every((value, k) => k === 0 || value > thresholds[k - 1]));
    for (let k = 0; k <= contexts; k++) {
      const first = take(), used = take();
      let sum = 0;
      hold(first >= 0 && used > 0 && first + used <= TOKENS);
      for (let token = first; token < first + used; token++) {
        const frequency = take();
        hold(frequency >= 0 && sum + frequency <= 1 << PRECISION);
        chances[(k << 8) + token] = (frequency << PRECISION) | sum;
        lookup.fill(token, (k << PRECISION) + sum, (k << PRECISION) + sum + frequency);
        sum += frequency;
      }
      hold(sum === 1 << PRECISION);
    }
    for (let a = 0, k = 0; a <= MOST_ACTIVITY; a++) {
      while (k < contexts && thresholds[k] <= a) k++;
      context[a] = k;
    }
    hold(shares.every((share) => share >= 0 && share <= 16));
    const [own, left, left2] = [0, 2, 1].map((k) => columns[(c + k) % 3]);
    const [said, near, near2] = [0, 2, 1].map((k) => tokens[(c + k) % 3]);
    const small = dtype === "int16" && signed && weights.reduce((sum, w) => sum + Math.abs(w), 0) < 2 ** 16;
    const step = small ? predictSmall : predict;
    weights[0] += 128;  // to round
    for (let t = 0; t < S; t++) {
      const first = (2 + t) * lanes, active = Math.ceil((n - t) / S);
      if (coder.w + 3 * lanes > words.length) {
        at += 2 * coder.w;
        raw.fill(0);
        raw.set(body.subarray(at, at + raw.length));
        coder.w = 0;
      }
      // First all tokens of a step, then the low bits that they leave: words lie in this order.
      takeTokens(coder, first, active, lanes, shares, context, lookup, chances, fresh, said, near, near2);
      if (coder.most >= DIRECT && takeBits(coder, first, active, fresh, said, 0)) takeBits(coder, first, active, fresh, said, 16);
      hold(step(weights, fresh, own, left, left2, first, active, lanes, signed));
    }
    yield (out, first, stride, from = 0, to = n) => {
      let least = own[2 * lanes], most = least;
      for (let t = 0; t < S; t += 64) {  // as many neighbours in memory at once
        for (let l = Math.floor(from / S); l * S < to; l++) {
          const source = 2 * lanes + l, target = first + stride * l * S;
          for (let k = Math.max(t, from - l * S), end = Math.min(t + 64, S, to - l * S); k < end; k++) {
            const value = own[source + k * lanes];
            out[target + stride * k] = value;
            if (value < least) least = value;
            if (value > most) most = value;
          }
        }
      }
      return [least, most];
    };
  }
  hold(at + 2 * coder.w === body.length && state.every((x) => x === LOWEST) && read === count);
  free([...columns, ...tokens, body]);
}

// The tokens of a step; coder.most: no less than the largest.
function takeTokens(coder, first, active, lanes, [s1, s2, s3, s4], context, lookup, chances, fresh, said, near, near2) {
  const { state, words } = coder;
  let { w } = coder, most = 0;
  for (let l = 0, j = first; l < active; l++, j++) {
    const activity = imul(s1, said[j - lanes]) + imul(s2, said[j - 2 * lanes]) + imul(s3, near[j]) + imul(s4, near2[j]);
    const k = context[activity], x = state[l], slot = x & MASK;
    const token = lookup[(k << PRECISION) + slot];
    const chance = chances[(k << 8) + token];
    const rest = (imul(chance >>> PRECISION, x >>> PRECISION) + slot - (chance & MASK)) | 0;
    const short = ((rest >>> 16) - 1) >>> 31;  // 1 if it is below 2^16: without a branch, which nobody could predict
    state[l] = (rest << (short << 4)) | (words[w] & -short);
    w += short;
    said[j] = fresh[l] = token;
    most |= token;
  }
  Object.assign(coder, { w, most });
}

// The low bits, from the bit `shift` on, that large tokens of a step leave; whether there are more.
function takeBits(coder, first, active, fresh, said, shift) {
  const { state, words } = coder;
  let { w } = coder, more = false;
  for (let l = 0, j = first; l < active; l++, j++) {
    const large = said[j] - DIRECT;
    if (large < 0) continue;
    const spare = (large >> 2) + 3, bits = Math.min(Math.max(spare - shift, 0), 16), x = state[l], rest = x >>> bits;
    const short = ((rest >>> 16) - 1) >>> 31;
    fresh[l] = (shift ? fresh[l] : (4 + (large & 3)) << spare) + ((x & ((1 << bits) - 1)) << shift);
    state[l] = (rest << (short << 4)) | (words[w] & -short);
    w += short;
    if (spare > 16) more = true;
  }
  coder.w = w;
  return more;
}

// Numbers of a step from what was read and from their neighbours; whether all are in their type's range.
function predict([w0, w1, w2, w3, w4, w5, w6], fresh, own, left, left2, first, active, lanes, signed) {
  for (let l = 0, j = first; l < active; l++, j++) {
    const b = j - lanes, u = fresh[l];
    const sum = w0 + w1 * own[b] + w2 * own[b - lanes] + w3 * left[j] + w4 * left[b] + w5 * left2[j] + w6 * left2[b];
    const x = signed ? Math.floor(sum / 256) + ((u >>> 1) ^ -(u & 1)) : u >>> 0;
    own[j] = x;
    if (own[j] !== x) return false;
  }
  return true;
}

// The same where 32 bits hold every sum, which takes half of the time.
function predictSmall([w0, w1, w2, w3, w4, w5, w6], fresh, own, left, left2, first, active, lanes) {
  for (let l = 0, j = first; l < active; l++, j++) {
    const b = j - lanes, u = fresh[l];
    const sum = w0 + imul(w1, own[b]) + imul(w2, own[b - lanes]) + imul(w3, left[j]) + imul(w4, left[b]) +
      imul(w5, left2[j]) + imul(w6, left2[b]);
    const x = ((sum >> 8) + ((u >>> 1) ^ -(u & 1))) | 0;
    own[j] = x;
    if (own[j] !== x) return false;
  }
  return true;
}

// ---- xz (https://tukaani.org/xz/xz-file-format.txt): one block of LZMA2 or none, without sizes and checks.

const LARGEST_DICTIONARY = 31;  // as the header has it: 192 MB
const XZ_HEAD = [0xfd, 0x37, 0x7a, 0x58, 0x5a, 0, 0, 0, 0xff, 0x12, 0xd9, 0x41], ONE_BLOCK = [2, 0, 0x21, 1];

function unxz(input, size) {
  if (size === 0 && input.length === 0) return new Uint8Array(0);
  const broken = () => new BadFile("The scene is damaged: one of its streams cannot be unpacked.");
  const need = (at, bytes) => {
    if (bytes.some((byte, i) => input[at + i] !== byte)) throw broken();
    return at + bytes.length;
  };
  const word = (value) => [0, 8, 16, 24].map((shift) => (value >>> shift) & 255);
  const summed = (bytes) => [...bytes, ...word(crc32(bytes))];
  const output = new Uint8Array(size), index = [0, 0];
  let at = need(0, XZ_HEAD), filled = 0;
  if (input[at] !== 0) {
    const properties = input[at + 4];
    need(at, summed([...ONE_BLOCK, properties, 0, 0, 0]));
    if (!(properties <= LARGEST_DICTIONARY)) throw broken();
    const dictionary = Math.max(2 ** 12, (2 | (properties & 1)) * 2 ** ((properties >> 1) + 11));
    [at, filled] = lzma2(input, at + 12, output, dictionary, broken);
    index[1] = 1;
    for (let value of [at - XZ_HEAD.length, filled]) {  // sizes, seven bits in a byte
      for (; value > 127; value = value >>> 7) index.push((value & 127) | 128);
      index.push(value);
    }
    at = need(at, Array(-at & 3).fill(0));
  }
  while (index.length & 3) index.push(0);
  at = need(at, summed(index));
  const foot = [...word(index.length / 4), 0, 0];
  at = need(at, [...word(crc32(foot)), ...foot, 0x59, 0x5a]);
  if (filled !== size || at !== input.length) throw broken();
  return output;
}

// Where LZMA's probabilities lie in one array.
const IS_MATCH = 0, IS_REP = 192, IS_REP0 = 204, IS_REP1 = 216, IS_REP2 = 228, IS_REP0_LONG = 240;
const SLOT = 432, SPECIAL = 688, ALIGN = 816, LENGTH = 832, REP_LENGTH = 1346, LITERAL = 1860;

// Unpacks LZMA2 chunks from input[at]; returns where they end, and how many bytes of `output` are filled.
function lzma2(input, at, output, dictionary, broken) {
  const coder = new Uint32Array(2);  // range, code: a typed array keeps them whole numbers
  let probs = new Uint16Array(0), lc = 0, lp = 0, pb = 0, state = 0, reps = [0, 0, 0, 0];  // the last distances
  let filled = 0, origin = 0;  // bytes of the output, and where what may be repeated begins
  let needed = 3;  // what the next chunk must reset at least: 3 all, 2 the properties, 0 nothing

  function bit(index) {
    const p = probs[index], bound = (coder[0] >>> 11) * p;
    let value;
    if (coder[1] < bound) {
      coder[0] = bound;
      probs[index] = p + ((2048 - p) >>> 5);
      value = 0;
    } else {
      coder[0] -= bound;
      coder[1] -= bound;
      probs[index] = p - (p >>> 5);
      value = 1;
    }
    if (coder[0] < 0x1000000) normalize();
    return value;
  }
  function normalize() {
    coder[0] <<= 8;
    coder[1] = (coder[1] << 8) | input[at++];
  }
  function tree(base, bits) {
    let m = 1;
    for (let k = 0; k < bits; k++) m = (m << 1) | bit(base + m);
    return m - (1 << bits);
  }
  function reversed(base, bits) {
    let m = 1, value = 0;
    for (let k = 0; k < bits; k++) {
      const b = bit(base + m);
      m = (m << 1) | b;
      value |= b << k;
    }
    return value;
  }
  function length(base, place) {
    if (bit(base) === 0) return 2 + tree(base + 2 + 8 * place, 3);
    if (bit(base + 1) === 0) return 10 + tree(base + 130 + 8 * place, 3);
    return 18 + tree(base + 258, 8);
  }
  function distance(slot) {
    if (slot < 4) return slot;
    const bits = (slot >> 1) - 1;
    const high = ((2 | (slot & 1)) << bits) >>> 0;
    if (slot < 14) return high + reversed(SPECIAL + high - slot, bits);
    let direct = 0;
    for (let k = 4; k < bits; k++) {
      coder[0] >>>= 1;
      const one = coder[1] >= coder[0] ? 1 : 0;
      if (one) coder[1] -= coder[0];
      direct = direct * 2 + one;
      if (coder[0] < 0x1000000) normalize();
    }
    return high + direct * 16 + reversed(ALIGN, 4);
  }
  function literal() {
    const place = filled - origin;
    const before = place > 0 ? output[filled - 1] : 0;
    const base = LITERAL + 0x300 * (((place & ((1 << lp) - 1)) << lc) + (before >> (8 - lc)));
    let symbol = 1;
    if (state >= 7) {
      let match = output[filled - reps[0] - 1], offset = 0x100;
      while (symbol < 0x100) {
        match <<= 1;
        const expected = match & offset, b = bit(base + offset + expected + symbol);
        symbol = (symbol << 1) | b;
        offset &= b ? expected : ~expected;
      }
    } else {
      while (symbol < 0x100) symbol = (symbol << 1) | bit(base + symbol);
    }
    output[filled++] = symbol;
    state = state < 4 ? 0 : state < 10 ? state - 3 : state - 6;
  }
  function copy(count, end) {
    if (reps[0] >= Math.min(filled - origin, dictionary) || filled + count > end) throw broken();
    for (let from = filled - reps[0] - 1; count > 0; count--) output[filled++] = output[from++];
  }

  for (;;) {
    if (at >= input.length) throw broken();
    const control = input[at++];
    if (control === 0) return [at, filled];
    let count = ((input[at] << 8) | input[at + 1]) + 1;
    at += 2;
    if (control < 0x80) {
      if (control > 2 || (control === 2 && needed === 3)) throw broken();
      if (at + count > input.length || filled + count > output.length) throw broken();
      if (control === 1) [origin, needed] = [filled, 2];
      output.set(input.subarray(at, at + count), filled);
      at += count;
      filled += count;
      continue;
    }
    count += (control & 0x1f) << 16;
    const chunk = ((input[at] << 8) | input[at + 1]) + 1, reset = (control >> 5) & 3;
    at += 2;
    if (reset < needed) throw broken();
    needed = 0;
    if (reset === 3) origin = filled;
    if (reset >= 2) {
      const properties = input[at++];
      pb = Math.floor(properties / 45);
      lp = Math.floor((properties % 45) / 9);
      lc = properties % 9;
      if (pb > 4 || lc + lp > 4) throw broken();
      probs = new Uint16Array(LITERAL + (0x300 << (lc + lp)));
    }
    if (reset >= 1) {
      probs.fill(1024);
      [state, reps] = [0, [0, 0, 0, 0]];
    }
    const chunkEnd = at + chunk, end = filled + count;
    if (chunkEnd > input.length || end > output.length || input[at] !== 0) throw broken();
    coder[0] = 0xffffffff;
    coder[1] = (input[at + 1] << 24) | (input[at + 2] << 16) | (input[at + 3] << 8) | input[at + 4];
    at += 5;
    while (filled < end) {
      const place = (filled - origin) & ((1 << pb) - 1);
      if (bit(IS_MATCH + (state << 4) + place) === 0) {
        literal();
      } else if (bit(IS_REP + state) === 0) {
        const count = length(LENGTH, place);
        state = state < 7 ? 7 : 10;
        reps = [distance(tree(SLOT + 64 * Math.min(count - 2, 3), 6)), ...reps.slice(0, 3)];
        copy(count, end);
      } else {
        let again = true;
        if (bit(IS_REP0 + state) === 0) {
          again = bit(IS_REP0_LONG + (state << 4) + place) === 1;
        } else {
          const k = bit(IS_REP1 + state) === 0 ? 1 : 2 + bit(IS_REP2 + state);
          reps.unshift(...reps.splice(k, 1));
        }
        const count = again ? length(REP_LENGTH, place) : 1;
        state = state < 7 ? (again ? 8 : 9) : 11;
        copy(count, end);
      }
    }
    if (at !== chunkEnd || coder[1] !== 0) throw broken();
  }
}
