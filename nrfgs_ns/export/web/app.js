// SPDX-License-Identifier: Apache-2.0
// The page: reads the scene, moves the camera, keeps the picture up to date, and listens to people.

const byId = (id) => document.getElementById(id);
const about = JSON.parse(byId("about").textContent);
const canvas = byId("scene");

function fail(error) {
  const told = error instanceof BadFile || error instanceof Lacking;
  const message = told ? error.message : `Something went wrong: ${error?.message ?? error}.`;
  const hint = error instanceof BadFile ? " Load the page again, or ask for it again where it came from." : "";
  byId("loading").hidden = true;
  byId("failed").hidden = false;
  byId("failed").textContent = message + hint;
  refuse(error);
}
window.addEventListener("error", (event) => fail(event.error ?? event.message));
window.addEventListener("unhandledrejection", (event) => fail(event.reason));

let begin, refuse;
const ready = new Promise((resolve, reject) => ([begin, refuse] = [resolve, reject]));
ready.catch(() => {});  // the page tells

// ---- the camera: where it is, its axes as rows (right, down, forwards), and how far in front what it turns around is

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const minus = (a, b) => plus(a, b, -1);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), across = cross(axis, vector), along = dot(axis, vector) * (1 - c);
  return vector.map((value, k) => c * value + s * across[k] + along * axis[k]);
}

const photographs = about.photographs.map(({ pose, distance, ...photograph }) => {
  const column = (c, sign) => [0, 4, 8].map((row) => sign * pose[row + c]);
  return { ...photograph, camera: { eye: column(3, 1), axes: [column(0, 1), column(1, -1), column(2, -1)], distance } };
});

const state = {
  camera: photographs[about.start].camera,
  photograph: about.start,  // whose lens it has
  show: "full",
  gain: 1,
  frozen: null,  // where splats are seen from, if that is not where the camera is
  drag: "orbit",
  marks: false,
};

// The lens on a canvas of this size: the whole photograph, unless that would show more than 90 degrees.
function lensFor({ lens: [fx, fy, cx, cy], size: [w, h] }, width, height) {
  const whole = Math.min(width / w, height / h), filling = Math.max(width / w, height / h);
  const s = Math.max(whole, Math.min(filling, (0.5 * Math.max(width, height)) / fx));
  return [s * fx, s * fy, s * cx + (width - s * w) / 2, s * cy + (height - s * h) / 2];
}

function seenBy({ eye, axes }, scale = 1) {
  const size = [canvas.width, canvas.height].map((side) => Math.max(1, Math.round(scale * side)));
  const view = axes.flatMap((axis) => [...axis, -dot(axis, eye)]);
  return { view, lens: lensFor(photographs[state.photograph], ...size), size };
}

function move(change) {
  state.camera = { ...state.camera, ...change };
  wake();
}

function turn(right, down) {
  const { eye, axes, distance } = state.camera;
  const around = state.drag === "orbit" ? plus(eye, axes[2], distance) : eye;
  const sign = state.drag === "orbit" ? 1 : -1;
  const steep = Math.asin(Math.max(-1, Math.min(1, dot(axes[2], about.up))));
  const tilt = Math.max(-1.5, Math.min(1.5, steep - sign * down)) - steep;
  const all = [minus(eye, around), ...axes].map((v) => turned(turned(v, axes[0], tilt), about.up, -sign * right));
  const forward = unit(all[3]), side = unit(minus(all[1], forward.map((x) => x * dot(all[1], forward))));
  move({ eye: plus(around, all[0]), axes: [side, cross(forward, side), forward] });
}

function pan(right, down) {
  const { eye, axes, distance } = state.camera;
  move({ eye: plus(plus(eye, axes[0], -right * distance), axes[1], -down * distance) });
}

function zoom(factor) {
  const { eye, axes, distance } = state.camera;
  const next = Math.max(distance * factor, about.nearest);
  move({ eye: plus(eye, axes[2], distance - next), distance: next });
}

function fly(right, up, forward) {
  const { eye, axes } = state.camera;
  move({ eye: plus(plus(plus(eye, axes[0], right), axes[1], -up), axes[2], forward) });
}

let journey = null;
const still = matchMedia("(prefers-reduced-motion: reduce)");

function visit(index, at_once = false) {
  state.photograph = index;
  byId("photograph").value = index;
  const { camera, name } = photographs[index];
  byId("said").textContent = `Photograph ${index + 1} of ${photographs.length}: ${name}`;
  if (at_once || still.matches) {
    journey = null;
    move(camera);
  } else {
    journey = { from: state.camera, to: camera, start: performance.now() };
    wake();
  }
}

function travel(now) {
  const share = Math.min(1, (now - journey.start) / 700), t = share * share * (3 - 2 * share);
  const { from, to } = journey;
  if (share === 1) {
    journey = null;
    move(to);
    return;
  }
  const mixed = (a, b) => a.map((value, k) => value + t * (b[k] - value));
  // Axes are mixed and made square again; halfway between opposite views any way round will do.
  const forward = unit(plus(mixed(from.axes[2], to.axes[2]), to.axes[0], 1e-4));
  const side = mixed(from.axes[0], to.axes[0]);
  const right = unit(plus(minus(side, forward.map((x) => x * dot(side, forward))), cross(forward, about.up), 1e-4));
  const distance = from.distance + t * (to.distance - from.distance);
  move({ eye: mixed(from.eye, to.eye), axes: [right, cross(forward, right), forward], distance });
}

// ---- pictures: what must be done for the next, and how much of it fits into a frame

let painter = null, reader = null;
let drawnFor = null;          // camera, size and settings of the last picture
let sorting = false, sortedFor = null;
let fieldFor = null, row = 0, rowsLeft = 0;
let share = Infinity;         // rows of the field in a frame, while it moves
let scale = 1;                // resolution while it moves, of the whole
let stale = true, scheduled = false, movedAt = -Infinity, lastFrame = null, pace = 16;
const waiting = [];           // who waits for the picture to be finished

function wake() {
  if (painter && !scheduled) {
    scheduled = true;
    requestAnimationFrame(frame);
  }
}

function frame(now) {
  scheduled = false;
  const before = state.camera;
  if (journey) travel(now);
  flyByKeys(now);
  fit();
  if (state.camera !== before || state.camera !== drawnFor?.camera) movedAt = now;
  const moving = now - movedAt < 200 && drawnFor !== null;
  if (moving && lastFrame !== null) keepPace(now - lastFrame);
  lastFrame = moving ? now : null;

  const size = `${canvas.width} ${canvas.height} ${state.photograph}`;
  if (!sorting && (sortedFor?.camera !== state.camera || sortedFor.size !== size)) {
    sorting = true;
    sortedFor = { camera: state.camera, size };
    const { view, lens, size: pixels } = seenBy(state.camera);
    reader.post({ camera: { view, lens, size: pixels, near: painter.near } });
  }
  if (measuring) return;

  const asked = JSON.stringify([state.frozen ?? [state.camera, size], state.show, state.gain]);
  if (asked !== fieldFor) {
    fieldFor = asked;
    rowsLeft = painter.rows;
  }
  if (rowsLeft > 0) {
    const center = state.frozen ?? state.camera.eye;
    const task = {
      center,
      camera: state.frozen ? null : seenBy(state.camera),
      mode: state.show === "base" ? "full" : state.show,
      gain: state.show === "base" ? 0 : state.gain,
    };
    for (let left = Math.min(rowsLeft, moving ? Math.max(1, Math.round(share)) : painter.rows); left > 0; ) {
      const rows = Math.min(left, painter.rows - row);
      painter.evaluate(task, row, rows);
      row = (row + rows) % painter.rows;
      left -= rows;
      rowsLeft -= rows;
    }
    stale = true;
  }

  const resolution = moving ? scale : 1;
  if (sortedOnce) {
    if (stale || drawnFor?.camera !== state.camera || drawnFor.size !== size || drawnFor.resolution !== resolution) {
      paint(resolution);
      drawnFor = { camera: state.camera, size, resolution };
      stale = false;
      canvas.classList.add("there");
    }
  }
  const done = finished();
  if (done) for (const resolve of waiting.splice(0)) resolve();
  if (moving || journey || rowsLeft > 0 || held.size > 0 || stale || (drawnFor && drawnFor.resolution !== 1)) wake();
}

function paint(resolution) {
  painter.draw(seenBy(state.camera, resolution), state.show.endsWith("residual") ? "grey" : "full");
  drawMarks();
}

let sortedOnce = false;

let measuring = false, sortTook = 0;

function sorted({ rows, seconds }) {
  sortTook = seconds;
  painter.setOrder(rows);
  sorting = false;
  sortedOnce = stale = true;
  wake();
}

// Whether the canvas shows what was asked for, in full.
function finished() {
  const size = `${canvas.width} ${canvas.height} ${state.photograph}`;
  return (
    painter && sortedOnce && !sorting && !journey && !picking && rowsLeft === 0 && !stale && drawnFor?.resolution === 1 &&
    drawnFor.camera === state.camera && sortedFor.camera === state.camera && sortedFor.size === size
  );
}

// Slow frames: first the field is spread over several, then pictures get smaller. Fast ones: the other way round.
function keepPace(took) {
  pace += 0.2 * (Math.min(took, 500) - pace);
  const all = painter.rows;
  if (pace > 40) {
    if (share > all / 8) share = Math.max(all / 8, 0.8 * Math.min(share, all));
    else scale = Math.max(0.4, 0.9 * scale);
  } else if (pace < 24) {
    if (scale < 1) scale = Math.min(1, 1.05 * scale);
    else share = Math.min(all, 1.1 * share);
  }
}

function fit() {
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
}

// ---- where photographs were taken

function onScreen(point) {
  const { view, lens, size } = seenBy(state.camera);
  const p = [0, 4, 8].map((r) => dot(view.slice(r, r + 3), point) + view[r + 3]);
  if (p[2] < painter.near) return null;
  return [(lens[0] * p[0]) / p[2] + lens[2], (lens[1] * p[1]) / p[2] + lens[3]].map(
    (value, k) => (value * [canvas.clientWidth, canvas.clientHeight][k]) / size[k],
  );
}

function drawMarks() {
  const marks = byId("marks");
  if (!state.marks && marks.width === 0) return;
  marks.width = state.marks ? canvas.clientWidth : 0;  // also clears
  marks.height = state.marks ? canvas.clientHeight : 0;
  if (!state.marks) return;
  const pen = marks.getContext("2d");
  for (const { camera } of photographs) {
    const at = onScreen(camera.eye);
    if (!at) continue;
    pen.beginPath();
    pen.arc(...at, 5, 0, 2 * Math.PI);
    pen.fillStyle = "#ffd369cc";
    pen.fill();
    pen.strokeStyle = "#000";
    pen.stroke();
  }
}

// The photograph whose mark is under the pointer, if any.
function markAt(x, y) {
  let best = null, nearest = 12;
  photographs.forEach(({ camera }, index) => {
    const at = onScreen(camera.eye), away = at ? Math.hypot(at[0] - x, at[1] - y) : Infinity;
    if (away < nearest) [best, nearest] = [index, away];
  });
  return best;
}

// ---- people

const pointers = new Map();

canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  canvas.focus({ preventScroll: true });
  pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, path: 0, button: event.button });
  journey = null;
});
canvas.addEventListener("pointermove", (event) => {
  const pointer = pointers.get(event.pointerId);
  if (!pointer) return;
  const dx = event.clientX - pointer.x, dy = event.clientY - pointer.y;
  const unitLength = 1 / Math.min(canvas.clientWidth, canvas.clientHeight);
  if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, value]) => value);
    const apart = (p) => Math.hypot(p.x - other.x, p.y - other.y);
    const was = apart(pointer);
    pan(0.5 * dx * unitLength, 0.5 * dy * unitLength);
    if (was > 0) zoom(was / Math.max(apart({ x: event.clientX, y: event.clientY }), 1));
  } else if (pointer.button !== 0 || event.shiftKey) {
    pan(dx * unitLength, dy * unitLength);
  } else {
    turn(3 * dx * unitLength, 3 * dy * unitLength);
  }
  Object.assign(pointer, { x: event.clientX, y: event.clientY, path: pointer.path + Math.hypot(dx, dy) });
});
for (const kind of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(kind, (event) => {
    const pointer = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    if (kind === "pointerup" && pointer?.path < 4 && state.marks) {
      const index = markAt(event.clientX, event.clientY);
      if (index !== null) visit(index);
    }
  });
}
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 16 : 1;
  zoom(Math.exp(Math.max(-1, Math.min(1, 0.0015 * lines * event.deltaY))));
}, { passive: false });
canvas.addEventListener("dblclick", (event) => {
  if (!painter || picking) return;
  const { lens, size } = seenBy(state.camera);
  const [x, y] = [event.clientX / canvas.clientWidth, event.clientY / canvas.clientHeight].map((v, k) => v * size[k]);
  const { eye, axes } = state.camera;
  const right = (x - lens[2]) / lens[0], down = (y - lens[3]) / lens[1];
  picking = { eye, direction: unit(plus(plus(axes[2], axes[0], right), axes[1], down)), spread: 3 / lens[0] };
  reader.post({ pick: picking });
});

let picking = null;

// Look at what was double-clicked, and turn around it from now on.
function picked(along) {
  const { eye, direction } = picking, { axes } = state.camera;
  picking = null;
  wake();
  if (along === null) return;
  const side = unit(minus(axes[0], direction.map((value) => value * dot(axes[0], direction))));
  const to = { eye, axes: [side, cross(direction, side), direction], distance: along };
  journey = { from: state.camera, to, start: performance.now() - (still.matches ? 700 : 0) };
}
canvas.addEventListener("webglcontextlost", () => fail(new Lacking("The graphics device has gone away. Load the page again.")));

const held = new Set();  // keys that fly
let flewAt = null;

function flyByKeys(now) {
  if (held.size === 0) {
    flewAt = null;
    return;
  }
  const step = about.speed * Math.min(0.1, flewAt === null ? 0.016 : (now - flewAt) / 1000);
  flewAt = now;
  const sign = (one, other) => (held.has(one) ? step : 0) - (held.has(other) ? step : 0);
  fly(sign("d", "a"), sign("e", "q"), sign("w", "s"));
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const step = (by) => visit((state.photograph + by + photographs.length) % photographs.length);
  const actions = {
    ArrowLeft: () => turn(0.08, 0), ArrowRight: () => turn(-0.08, 0), ArrowUp: () => turn(0, 0.08),
    ArrowDown: () => turn(0, -0.08), "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
    "[": () => step(-1), "]": () => step(1), Home: () => visit(about.start),
    f: () => byId("freeze").click(), h: () => byId("toggle").click(),
  };
  if ("wasdqe".includes(key)) {
    held.add(key);
    wake();
  } else if (actions[key]) {
    event.preventDefault();
    actions[key]();
  }
});
document.addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));
window.addEventListener("blur", () => held.clear());
window.addEventListener("resize", wake);

const legends = {
  full: "The picture as trained, with the residual times the gain.",
  base: "What does not depend on the view.",
  residual: "Grey: no change of colour. Otherwise the change times the gain, times 4.",
  "opacity residual": "Grey: no change. Orange: more opaque, blue: less; times the gain, times 4.",
};

function listen() {
  const on = (id, kind, act) => byId(id).addEventListener(kind, (event) => {
    act(event.target);
    wake();
  });
  byId("panel").addEventListener("submit", (event) => event.preventDefault());
  on("show", "change", ({ value }) => {
    state.show = value;
    byId("legend").textContent = legends[value];
  });
  on("gain", "input", ({ value }) => {
    state.gain = Number(value);
    byId("gain-value").textContent = value;
  });
  on("freeze", "change", ({ checked }) => (state.frozen = checked ? state.camera.eye : null));
  on("drag", "change", ({ value }) => (state.drag = value));
  on("mark", "change", ({ checked }) => {
    state.marks = checked;
    stale = true;
  });
  on("photograph", "change", ({ value }) => visit(Number(value)));
  on("previous", "click", () => visit((state.photograph + photographs.length - 1) % photographs.length));
  on("next", "click", () => visit((state.photograph + 1) % photographs.length));
  on("home", "click", () => visit(about.start));
  on("save", "click", () => {
    const link = document.createElement("a");
    link.href = picture();
    link.download = "picture.png";
    link.click();
  });
  on("full-screen", "click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  });
  on("embed", "click", () => {
    const code = byId("embed-code"), address = location.protocol.startsWith("http") ? location.href : "https://...";
    const text = document.createElement("i");
    text.textContent = document.title;
    const title = text.innerHTML.replaceAll('"', "&quot;");
    code.hidden = !code.hidden;
    code.value = `<iframe src="${address.split("#")[0]}" title="${title}" width="800" height="500" style="border:0" ` +
      `allow="fullscreen" loading="lazy"></iframe>`;
    code.select();
  });
  byId("toggle").addEventListener("click", () => {
    const open = (byId("panel").hidden = !byId("panel").hidden);
    byId("toggle").setAttribute("aria-expanded", String(!open));
  });
  byId("photograph").append(...photographs.map(({ name }, index) => new Option(`${index + 1}. ${name}`, index)));
  byId("photograph").value = state.photograph;
  byId("legend").textContent = legends.full;
  if (innerWidth > 700 && window === window.top) byId("toggle").click();
}

// ---- the scene

function tell(text, progress) {
  byId("stage").textContent = text;
  byId("progress").value = progress;
}

// The bytes of the compact file: in this page, or beside it.
async function packedBytes() {
  const packed = byId("packed");
  if (!packed) throw new BadFile("The page is cut short: its scene is not in it.");
  const text = packed.textContent.trim();
  if (text.endsWith(".nrf")) return fetched(text);
  packed.textContent = "";
  try {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes;
  } catch {
    throw new BadFile("The page is damaged or cut short: its scene cannot be read.");
  }
}

async function fetched(name) {
  const answer = await fetch(name).catch(() => null);
  if (!answer?.ok) {
    throw new BadFile(`${name} cannot be loaded. It must lie beside this page on a web server; a page of one file needs none.`);
  }
  const total = Number(answer.headers.get("content-length")), parts = [];
  let size = 0;
  for (const stream = answer.body.getReader(); ; ) {
    const { done, value } = await stream.read();
    if (done) break;
    parts.push(value);
    size += value.length;
    if (total) tell("Loading", Math.min(1, size / total));
  }
  const bytes = new Uint8Array(size);
  for (let at = 0; parts.length; ) {
    bytes.set(parts[0], at);
    at += parts.shift().length;
  }
  return bytes;
}

// Reads and sorts in a worker, or here where there is none.
function startReader() {
  const handlers = {
    progress: (value) => tell("Unpacking", value),
    failed: (message) => fail(new BadFile(message)),
    sorted,
    picked,
  };
  const receive = (message) => {
    for (const [name, value] of Object.entries(message)) handlers[name](value);
  };
  let post;
  try {
    const code = new Blob([byId("reader").textContent], { type: "text/javascript" });
    const worker = new Worker(URL.createObjectURL(code));
    worker.onmessage = ({ data }) => receive(data);
    worker.onerror = (event) => fail(new BadFile(`The scene cannot be read (${event.message}).`));
    post = (message, transfer) => worker.postMessage(message, transfer);
  } catch {
    const handle = answer((message) => setTimeout(() => receive(message)));
    post = (message) => setTimeout(() => handle(message));
  }
  return {
    post,
    read: (bytes) => new Promise((resolve) => {
      handlers.scene = resolve;
      post({ read: bytes.buffer }, [bytes.buffer]);
    }),
  };
}

// What the canvas shows, as the address of a PNG.
function picture() {
  paint(1);
  return canvas.toDataURL("image/png");
}

// For pages that embed this one, and for tests.
window.nrfgs = {
  ready,
  picture,
  finished: () => new Promise((resolve) => {
    waiting.push(resolve);
    wake();
  }),
  visit: (index) => visit(index, true),
  // Seconds for a picture while the camera goes around: the field of all that is seen, projection, blending, on the
  // GPU until they are done. Splats are sorted beside that, in the worker: the last sorting's seconds.
  async measure(count) {
    await ready;
    measuring = true;
    let seconds = 0;
    for (let i = 0; i < count; i++) {
      turn(0.02, 0);
      const camera = seenBy(state.camera), start = performance.now();
      painter.evaluate({ center: state.camera.eye, camera, mode: "full", gain: 1 }, 0, painter.rows);
      paint(1);
      painter.finish();
      seconds += (performance.now() - start) / 1000;
      await new Promise((resolve) => requestAnimationFrame(resolve));
    }
    measuring = false;
    fieldFor = null;
    wake();
    const info = painter.gl.getExtension("WEBGL_debug_renderer_info");
    return {
      seconds_per_picture: seconds / count,
      seconds_to_sort: sortTook,
      size: [canvas.width, canvas.height],
      splats: painter.count,
      renderer: painter.gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : painter.gl.RENDERER),
      browser: navigator.userAgent,
    };
  },
};

async function main() {
  reader = startReader();
  const scene = await reader.read(await packedBytes());
  tell("Preparing", 1);
  fit();
  painter = new Painter(canvas, scene);
  byId("count").textContent = `${scene.count.toLocaleString("en")} splats, ${scene.viewDependent.toLocaleString("en")} view-dependent`;
  listen();
  const asked = /photograph=(\d+)/.exec(location.hash);
  if (asked && photographs[asked[1] - 1]) visit(asked[1] - 1, true);
  wake();
  await window.nrfgs.finished();
  byId("loading").hidden = true;
  byId("poster").hidden = true;
  begin();
}

main().catch(fail);
