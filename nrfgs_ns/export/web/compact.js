// SPDX-License-Identifier: Apache-2.0
// Reads a compact file (docs/compact-format.md says where it is specified): container, xz streams, coded tables, splats. Runs in the worker.

const MAGIC = [0x89, 0x4e, 0x52, 0x46, 0x0d, 0x0a, 0x1a, 0x0a];
const VERSION = 2;
const BYTES = { uint8: 1, uint16: 2, uint32: 4, uint64: 8, float16: 2, float32: 4, int16: 2, int32: 4 };
const LARGEST_STREAM = 2 ** 31;

// What is said to a reader: a fault of the file, or what a device lacks.
class BadFile extends Error {}
class Lacking extends Error {}

// The scene in a file's bytes. `progress` is told the share that is done.
//   table    Float32Array [N, 16]: mean, logit of opacity; rotation (w, x, y, z); standard deviations, 0; base colour, 0
//   latents  Float32Array [V, rank filled up to a multiple of 4]; the first V of the N splats are view-dependent
//   weights  name -> {shape, values}
function readScene(bytes, progress) {
  const { header, streams } = readContainer(bytes, progress);
  if (header.format !== "nrfgs-compact" || header.head.name !== "nrf") {
    throw new BadFile("The scene is not a neural residual field.");
  }
  const count = { view: header.splats.view, diffuse: header.splats.diffuse };
  const rank = header.head.config.latent_dim;
  const scene = {
    header,
    count: count.view + count.diffuse,
    viewDependent: count.view,
    table: new Float32Array(16 * (count.view + count.diffuse)),
    latents: new Float32Array(4 * Math.ceil(rank / 4) * count.view),
    weights: {},
  };
  for (const [name, stream] of Object.entries(streams)) {
    if (name.startsWith("head.")) {
      const values = stream.dtype === "float32" ? new Float32Array(numbers(stream).buffer) : halves(numbers(stream));
      scene.weights[name.slice("head.".length)] = { shape: stream.shape, values };
    }
  }
  readTables(streams, scene, rank);
  return scene;
}

function readContainer(bytes, progress) {
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
  if (crc32(bytes.subarray(0, 24 + length)) !== view.getUint32(24 + length, true)) {
    throw new BadFile("The scene is damaged: the checksum of its header does not hold.");
  }
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(24, 24 + length)));
  const streams = {};
  let at = 28 + length;
  for (const { name, dtype, shape, bytes: size, crc32: sum, coding } of header.streams) {
    const body = bytes.subarray(at, at + size);
    at += size;
    if (body.length !== size || crc32(body) !== sum) {
      throw new BadFile(`The scene is damaged: the checksum of its stream ${name} does not hold.`);
    }
    const unpacked = BYTES[dtype] * shape.reduce((a, b) => a * b, 1);
    if (!(unpacked <= LARGEST_STREAM)) throw new BadFile(`The scene's stream ${name} is too large.`);
    streams[name] = { dtype, shape };
    if (coding === "rans") streams[name].columns = decodeTable(body, shape[0], shape[1]);
    else streams[name].planes = unxz(body, unpacked);
    progress(at / total);
  }
  return { header, streams };
}

// The tables: all splats in one order; the scene has the view-dependent ones first.
function readTables({ means, splats, latents }, scene, rank) {
  const n = scene.count, of = scene.viewDependent, { grids } = scene.header;
  const fits = ({ columns, shape } = {}, c, rows) => columns && shape[0] === c && shape[1] === rows;
  if (!fits(means, 2, n) || !fits(splats, 11, n) || !fits(latents, rank, of)) {
    throw new BadFile("The scene's tables do not fit its number of splats.");
  }
  const diffuse = splats.columns[0], place = new Uint32Array(n);
  let first = 0, last = of;
  for (let i = 0; i < n; i++) place[i] = diffuse[i] ? last++ : first++;
  if (first !== of) throw new BadFile("The scene's tables do not fit its number of splats.");
  readPlaces(means.columns[1], means.columns[0], grids.means, scene.table, place);
  const put = (column, { low, step }, c, offset, value) => {
    for (let i = 0; i < n; i++) scene.table[16 * place[i] + offset] = value(low[c] + step[c] * column[i]);
  };
  put(splats.columns[1], grids.opacities, 0, 3, (x) => x);
  for (let c = 0; c < 3; c++) {
    put(splats.columns[2 + c], grids.scales, c, 8 + c, Math.exp);
    put(splats.columns[5 + c], grids.colors, c, 12 + c, (x) => x);
  }
  const turns = splats.columns.slice(8), { low, step } = grids.turns;
  for (let i = 0; i < n; i++) {
    const [x, y, z] = turns.map((column, c) => low[c] + step[c] * column[i]);
    const w = Math.sqrt(Math.max(1 - (x * x + y * y + z * z), 1e-6)), norm = Math.sqrt(w * w + x * x + y * y + z * z);
    scene.table.set([w / norm, x / norm, y / norm, z / norm], 16 * place[i] + 4);
  }
  const width = 4 * Math.ceil(rank / 4);
  for (let r = 0; r < rank; r++) {
    const column = latents.columns[r], low = grids.latents.low[r], step = grids.latents.step[r];
    for (let i = 0; i < of; i++) scene.latents[width * i + r] = low + step * column[i];
  }
}

let crcTable = null;

function crc32(bytes) {
  if (!crcTable) {
    crcTable = new Uint32Array(256);
    for (let n = 0; n < 256; n++) {
      let c = n;
      for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
      crcTable[n] = c;
    }
  }
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = crcTable[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return (crc ^ -1) >>> 0;
}

// A stream's numbers: of one byte or two as they are, of four as Uint32Array.
function numbers({ dtype, planes }) {
  const size = BYTES[dtype], n = planes.length / size;
  if (size === 1) return planes;
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

// Running sums of 64-bit differences, given as lower and upper 32 bits, and the coordinates whose bits alternate in them.
// Splat i goes to row place[i] of the table.
function readPlaces(lowers, uppers, { low, step }, table, place) {
  let lower = 0, upper = 0;
  for (let i = 0; i < place.length; i++) {
    const sum = lower + lowers[i];
    const carry = sum >= 2 ** 32 ? 1 : 0;
    lower = sum >>> 0;
    upper = (upper + carry + uppers[i]) >>> 0;
    const middle = (lower >>> 30) | ((upper & 0x0fffffff) << 2);
    for (let a = 0; a < 3; a++) {
      const code = thirds(lower >>> a & 0x3fffffff >>> a) | (thirds(middle >>> a) << 10) | (((upper >>> (28 + a)) & 1) << 20);
      table[16 * place[i] + a] = low[a] + step[a] * code;
    }
  }
}

// ---- coded tables: rANS in lanes, as entropy.py's docstring has it. Whole numbers alone, so that every reader agrees.

const PRECISION = 14, LOWEST = 1 << 16, DIRECT = 32, TOKENS = 140, MOST_ACTIVITY = 4 * 16 * 139;

// The columns of a table [C, n]: Int32Array where they are signed, Uint32Array where they are not.
function decodeTable(body, C, n) {
  const broken = () => new BadFile("The scene is damaged: one of its tables cannot be decoded.");
  const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
  const count = view.getUint32(0, true), size = view.getUint32(4, true);
  if (count > 4096 * C || 8 + size > body.length) throw broken();
  const model = new Int32Array(numbers({ dtype: "int32", planes: unxz(body.subarray(8, 8 + size), 4 * count) }).buffer);
  let read = 0;
  const take = () => {
    if (read >= count) throw broken();
    return model[read++];
  };
  let lanes = 1;
  while (lanes < Math.min(1024, Math.ceil((C * n) / 2048))) lanes *= 2;
  const S = Math.ceil(n / lanes), state = new Uint32Array(lanes);
  let at = 8 + size;
  if (at + 4 * lanes > body.length) throw broken();
  for (let l = 0; l < lanes; l++, at += 4) state[l] = view.getUint32(at, true);
  const word = () => {
    at += 2;
    if (at > body.length) throw broken();
    return body[at - 2] | (body[at - 1] << 8);
  };

  const columns = [], zeros = new Int32Array(n);
  const tokens = [new Uint8Array(n), new Uint8Array(n), new Uint8Array(n)];  // of a column and the two to its left
  for (let c = 0; c < C; c++) {
    const signed = take() !== 0;
    const weights = Array.from({ length: 7 }, take), shares = Array.from({ length: 4 }, take);
    const thresholds = Array.from({ length: take() }, take);
    const frequencies = new Uint16Array((thresholds.length + 1) * TOKENS), starts = new Uint16Array(frequencies.length);
    const lookup = new Uint8Array((thresholds.length + 1) << PRECISION);
    for (let k = 0; k <= thresholds.length; k++) {
      const first = take(), used = take();
      let sum = 0;
      if (first < 0 || first + used > TOKENS) throw broken();
      for (let token = first; token < first + used; token++) {
        const frequency = take();
        if (frequency < 0 || sum + frequency > 1 << PRECISION) throw broken();
        frequencies[k * TOKENS + token] = frequency;
        starts[k * TOKENS + token] = sum;
        lookup.fill(token, (k << PRECISION) + sum, (k << PRECISION) + sum + frequency);
        sum += frequency;
      }
      if (sum !== 1 << PRECISION) throw broken();
    }
    const context = new Uint32Array(MOST_ACTIVITY + 1);  // its number times 2^PRECISION, by activity
    for (let a = 0, k = 0; a <= MOST_ACTIVITY; a++) {
      while (k < thresholds.length && thresholds[k] <= a) k++;
      context[a] = k << PRECISION;
    }
    if (shares.some((share) => share < 0 || share > 16)) throw broken();
    const [w0, w1, w2, w3, w4, w5, w6] = weights, [s1, s2, s3, s4] = shares;
    const own = tokens[c % 3], out = signed ? new Int32Array(n) : new Uint32Array(n);
    const left = c > 0 ? columns[c - 1] : zeros, left2 = c > 1 ? columns[c - 2] : zeros;
    const near = c > 0 ? tokens[(c + 2) % 3] : zeros, near2 = c > 1 ? tokens[(c + 1) % 3] : zeros;
    for (let t = 0; t < S; t++) {
      const active = Math.ceil((n - t) / S);
      // First all tokens of a step, then the low bits that they leave: words lie in this order.
      let most = 0;
      for (let l = 0, i = t; l < active; l++, i += S) {
        const activity = s1 * (t > 0 ? own[i - 1] : 0) + s2 * (t > 1 ? own[i - 2] : 0) + s3 * near[i] + s4 * near2[i];
        const k = context[activity], x = state[l], slot = x & ((1 << PRECISION) - 1), token = lookup[k + slot];
        const entry = (k >>> PRECISION) * TOKENS + token;
        const rest = frequencies[entry] * (x >>> PRECISION) + slot - starts[entry];
        if (rest < LOWEST) {
          state[l] = (rest << 16) | body[at] | (body[at + 1] << 8);
          at += 2;
        } else {
          state[l] = rest;
        }
        own[i] = out[i] = token;
        if (token > most) most = token;
      }
      if (at > body.length) throw broken();
      if (most >= DIRECT) {
        for (const shift of (most - DIRECT >> 2) + 3 > 16 ? [0, 16] : [0]) {
          for (let l = 0, i = t; l < active; l++, i += S) {
            const large = own[i] - DIRECT;
            if (large < 0) continue;
            const spare = (large >> 2) + 3, bits = Math.min(Math.max(spare - shift, 0), 16), scale = 2 ** bits;
            if (shift === 0) out[i] = (4 + (large & 3)) * 2 ** spare;
            let x = state[l];
            out[i] += (x % scale) * 2 ** shift;
            x = Math.floor(x / scale);
            state[l] = x < LOWEST ? x * LOWEST + word() : x;
          }
        }
      }
      if (!signed) continue;
      for (let l = 0, i = t; l < active; l++, i += S) {
        const u = out[i] >>> 0, b = t > 0 ? i - 1 : -1;
        const sum = w0 + 128 + w1 * (t > 0 ? out[i - 1] : 0) + w2 * (t > 1 ? out[i - 2] : 0) +
          w3 * left[i] + w4 * (b < 0 ? 0 : left[b]) + w5 * left2[i] + w6 * (b < 0 ? 0 : left2[b]);
        out[i] = Math.floor(sum / 256) + ((u >>> 1) ^ -(u & 1));
      }
    }
    columns.push(out);
  }
  if (at !== body.length || state.some((x) => x !== LOWEST) || read !== count) throw broken();
  return columns;
}

// ---- xz (https://tukaani.org/xz/xz-file-format.txt): blocks with the LZMA2 filter and no check, as the format has them.

function unxz(input, size) {
  if (size === 0 && input.length === 0) return new Uint8Array(0);
  const broken = () => new BadFile("The scene is damaged: one of its streams cannot be unpacked.");
  if (input.length < 32 || input[0] !== 0xfd || input[1] !== 0x37 || input[7] !== 0) throw broken();
  const output = new Uint8Array(size);
  let at = 12, filled = 0;
  while (input[at] !== 0) {  // 0 begins the index, which nothing here needs
    const flags = input[at + 1], end = at + 4 * (input[at] + 1);
    let p = at + 2;
    for (const bit of [0x40, 0x80]) if (flags & bit) while (input[p++] & 0x80);
    if (flags & 0x3f || input[p] !== 0x21 || input[p + 1] !== 1) throw broken();
    [at, filled] = lzma2(input, end, output, filled, broken);
    at += -at & 3;
  }
  if (filled !== size) throw broken();
  return output;
}

// Where LZMA's probabilities lie in one array.
const IS_MATCH = 0, IS_REP = 192, IS_REP0 = 204, IS_REP1 = 216, IS_REP2 = 228, IS_REP0_LONG = 240;
const SLOT = 432, SPECIAL = 688, ALIGN = 816, LENGTH = 832, REP_LENGTH = 1346, LITERAL = 1860;

// Unpacks LZMA2 chunks from input[at]; returns where they end, and how many bytes of `output` are filled.
function lzma2(input, at, output, filled, broken) {
  const coder = new Uint32Array(2);  // range, code: a typed array keeps them whole numbers
  let probs = new Uint16Array(0), lc = 0, lp = 0, pb = 0, state = 0, rep0 = 0, rep1 = 0, rep2 = 0, rep3 = 0, origin = 0;

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
      let match = output[filled - rep0 - 1], offset = 0x100;
      while (symbol < 0x100) {
        match <<= 1;
        const expected = match & offset, b = bit(base + offset + expected + symbol);
        symbol = (symbol << 1) | b;
        offset &= b ? expected : ~expected;
      }
    } else {
      // `bit` eight times, written out: most of a scene is literals, and this is where its time goes.
      let range = coder[0], code = coder[1];
      while (symbol < 0x100) {
        const p = probs[base + symbol], bound = (range >>> 11) * p;
        if (code < bound) {
          range = bound;
          probs[base + symbol] = p + ((2048 - p) >>> 5);
          symbol <<= 1;
        } else {
          range -= bound;
          code -= bound;
          probs[base + symbol] = p - (p >>> 5);
          symbol = (symbol << 1) | 1;
        }
        if (range < 0x1000000) {
          range = (range << 8) >>> 0;
          code = ((code << 8) | input[at++]) >>> 0;
        }
      }
      coder[0] = range;
      coder[1] = code;
    }
    output[filled++] = symbol;
    state = state < 4 ? 0 : state < 10 ? state - 3 : state - 6;
  }
  function copy(count, end) {
    if (rep0 >= filled - origin || filled + count > end) throw broken();
    for (let from = filled - rep0 - 1; count > 0; count--) output[filled++] = output[from++];
  }

  for (;;) {
    if (at >= input.length) throw broken();
    const control = input[at++];
    if (control === 0) return [at, filled];
    let count = ((input[at] << 8) | input[at + 1]) + 1;
    at += 2;
    if (control < 0x80) {
      if (control > 2 || filled + count > output.length) throw broken();
      if (control === 1) origin = filled;
      output.set(input.subarray(at, at + count), filled);
      at += count;
      filled += count;
      continue;
    }
    count += (control & 0x1f) << 16;
    const chunk = ((input[at] << 8) | input[at + 1]) + 1, reset = (control >> 5) & 3;
    at += 2;
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
      state = rep0 = rep1 = rep2 = rep3 = 0;
    }
    const chunkEnd = at + chunk, end = filled + count;
    if (probs.length === 0 || chunkEnd > input.length || end > output.length) throw broken();
    coder[0] = 0xffffffff;
    coder[1] = (input[at + 1] << 24) | (input[at + 2] << 16) | (input[at + 3] << 8) | input[at + 4];
    at += 5;
    while (filled < end) {
      const place = (filled - origin) & ((1 << pb) - 1);
      if (bit(IS_MATCH + (state << 4) + place) === 0) {
        literal();
      } else if (bit(IS_REP + state) === 0) {
        rep3 = rep2;
        rep2 = rep1;
        rep1 = rep0;
        const count = length(LENGTH, place);
        state = state < 7 ? 7 : 10;
        rep0 = distance(tree(SLOT + 64 * Math.min(count - 2, 3), 6));
        copy(count, end);
      } else {
        let again = true;
        if (bit(IS_REP0 + state) === 0) {
          again = bit(IS_REP0_LONG + (state << 4) + place) === 1;
        } else {
          let next = rep1;
          if (bit(IS_REP1 + state) === 1) {
            next = rep2;
            if (bit(IS_REP2 + state) === 1) {
              next = rep3;
              rep3 = rep2;
            }
            rep2 = rep1;
          }
          rep1 = rep0;
          rep0 = next;
        }
        const count = again ? length(REP_LENGTH, place) : 1;
        state = state < 7 ? (again ? 8 : 9) : 11;
        copy(count, end);
      }
    }
    at = chunkEnd;
  }
}
