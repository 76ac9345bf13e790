// SPDX-License-Identifier: Apache-2.0
// The page: reads the scene, moves the camera, and keeps the picture up to date.

const byId = (id) => document.getElementById(id);
const about = JSON.parse(byId("about").textContent);
const canvas = byId("scene");

function fail(error) {
  const told = error instanceof BadFile || error instanceof Lacking;
  const message = told ? error.message : "Something went wrong, and the page cannot go on. Load it again; the browser's console has the details.";
  if (!told) console.error(error);
  const hint = error instanceof BadFile ? " Load the page again, or ask for it again where it came from." : "";
  byId("loading").hidden = true;
  Object.assign(byId("failed"), { hidden: false, textContent: message + hint });
  refuse(error);
  emit("failed", { message });
}
addEventListener("error", (event) => fail(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => fail(event.reason));

let begin, refuse;
const ready = new Promise((resolve, reject) => ([begin, refuse] = [resolve, reject]));
ready.catch(() => {});  // the page tells

// ---- the camera

const photographs = about.photographs.map(({ name, pose, distance, lens: [fx, fy, cx, cy], size: [w, h] }) => {
  const matrix = [0, 1, 2, 3].flatMap((column) => [0, 4, 8].map((row) => pose[row + column]).concat(column === 3 ? 1 : 0));
  return { name, camera: { ...poseOf(matrix), distance, lens: [fx / h, fy / h, cx / h, cy / h, w / h] } };
});
const typical = photographs.map(({ camera }) => camera.distance).sort((a, b) => a - b)[photographs.length >> 1];
const CLOSEST = 0.1;  // of the typical distance to the subject: nearer to a surface the hand does not bring the camera
const FARTHEST = 0.8;  // of it, from the nearest photograph: what lies beyond, nobody has seen
const state = {
  camera: photographs[about.start].camera,
  photograph: about.start,  // the last one visited
  show: "full",
  gain: 1,
  frozen: null,  // where splats are seen from, if that is not where the camera is
  drag: "orbit",
  marks: false,
};

function seenBy({ eye, axes, lens }, scale = 1) {
  const size = [canvas.width, canvas.height].map((side) => Math.max(1, Math.round(scale * side)));
  return { view: axes.flatMap((axis) => [...axis, -dot(axis, eye)]), lens: lensOn(lens, ...size), size };
}

function move(change) {
  state.camera = { ...state.camera, ...change };
  wake();
}

const strays = (eye) => Math.min(...photographs.map(({ camera }) => norm(minus(eye, camera.eye)))) - FARTHEST * typical;

// Go as far as is allowed of the way: make(share) is the change. Scripts and links may lead further out than hands do.
function go(make) {
  const most = Math.max(strays(state.camera.eye), 1e-9 * typical);
  for (let share = 1; share > 0.05; share /= 2) {
    const change = make(share);
    if (strays(change.eye) <= most) {
      move(change);
      return true;
    }
  }
  return false;
}

let surface = null;  // {point, axis}: where the last sorted camera's middle ray ends

// How far the camera may go forwards.
function room() {
  const { eye, axes } = state.camera;
  if (!surface || dot(surface.axis, axes[2]) < 0.95) return Infinity;
  return Math.max(0, dot(minus(surface.point, eye), axes[2]) - CLOSEST * typical);
}

function turn(right, down, orbit = state.drag === "orbit") {
  const turnedBy = (right, down) => {
    const { eye, axes, distance } = state.camera;
    const around = orbit ? plus(eye, axes[2], distance) : eye;
    const sign = orbit ? 1 : -1;
    const steep = Math.asin(Math.max(-1, Math.min(1, dot(axes[2], about.up))));
    const tilt = Math.max(-1.5, Math.min(1.5, steep - sign * down)) - steep;
    const all = [minus(eye, around), ...axes].map((v) => turned(turned(v, axes[0], tilt), about.up, -sign * right));
    return { eye: plus(around, all[0]), axes: facing(all[3], all[1]) };
  };
  const moved = right === 0 || go((share) => turnedBy(share * right, 0));
  return (down === 0 || go((share) => turnedBy(0, share * down))) && moved;
}

function pan(right, down) {
  const { distance } = state.camera;
  fly(-right * distance, down * distance, 0);
}

function zoom(factor) {
  const { eye, axes, distance } = state.camera;
  const next = Math.max(distance * factor, Math.min(distance, CLOSEST * typical), distance - room());
  go((share) => {
    const step = share * (distance - next);
    return { eye: plus(eye, axes[2], step), distance: distance - step };
  });
}

function fly(right, up, forward) {
  const { eye, axes } = state.camera, ahead = Math.min(forward, room());
  const step = plus(plus(axes[0].map((v) => v * right), axes[1], -up), axes[2], ahead);
  go((share) => ({ eye: plus(eye, step, share) }));
}

// ---- what moves by itself: {way, start, done, again}, and which way the camera turns, or 0

let journey = null, turning = 0, turnedAt = 0;
const still = matchMedia("(prefers-reduced-motion: reduce)");

function stop() {
  journey?.done(false);
  journey = null;
  turning = 0;
  playing(null);
}

// A promise of whether the camera gets there.
function follow(way, again = false) {
  journey?.done(false);
  return new Promise((done) => {
    journey = { way, start: performance.now(), done, again };
    wake();
  });
}

function flyTo(camera, seconds = 0.7) {
  stop();
  if (seconds > 0 && !still.matches) return follow(wayThrough([state.camera, camera], typical, seconds));
  move(camera);
  return Promise.resolve(true);
}

function visit(index, seconds) {
  state.photograph = index;
  byId("photograph").value = index;
  say(`Photograph ${index + 1} of ${photographs.length}: ${photographs[index].name}`);
  return flyTo(photographs[index].camera, seconds);
}

async function play(what) {
  stop();
  if (what === "rotation") {
    playing(what);
    turning = 1;
    turnedAt = performance.now();
    wake();
    return;
  }
  const { views, seconds = null, loop = false } = about.tour;
  const cameras = views.map((view) => (typeof view === "number" ? photographs[view].camera : cameraOf(view)));
  playing(what);
  if (await follow(wayThrough([state.camera, cameras[0]], typical, 0.7))) {
    if (await follow(wayThrough(cameras, typical, seconds, seconds !== null), loop)) playing(null);
  }
}

function travel(now) {
  if (turning) {
    if (!turn((turning * 2 * Math.PI * Math.min(100, now - turnedAt)) / 60000, 0, true)) turning = -turning;
    turnedAt = now;
  }
  if (!journey) return;
  const { way, start, done, again } = journey, share = (now - start) / (1000 * way.seconds);
  move(way.at(share));
  if (share < 1) return;
  if (again) {
    journey.start = now;
  } else {
    journey = null;
    done(true);
  }
}

// ---- pictures: what must be done for the next, and how much of it fits into a frame

let painter = null, reader = null;
let drawnFor = null;          // camera, size and settings of the last picture
let sorting = false, sortedFor = null, sortedOnce = false;
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
  travel(now);
  flyByKeys(now);
  fit();
  if (state.camera !== before || state.camera !== drawnFor?.camera) movedAt = now;
  tellMoved();
  const moving = now - movedAt < 200 && drawnFor !== null;
  if (moving && lastFrame !== null) keepPace(now - lastFrame);
  lastFrame = moving ? now : null;

  const size = `${canvas.width} ${canvas.height}`;
  if (!sorting && (sortedFor?.camera !== state.camera || sortedFor.size !== size)) {
    sorting = true;
    sortedFor = { camera: state.camera, size };
    const { view, lens, size: pixels } = seenBy(state.camera);
    const { eye, axes } = state.camera;
    reader.post({ camera: { view, lens, size: pixels, near: painter.near, eye, direction: axes[2] } });
  }

  const asked = JSON.stringify([state.frozen ?? [state.camera, size], state.show, state.gain]);
  if (asked !== fieldFor) {
    fieldFor = asked;
    rowsLeft = painter.rows;
  }
  if (rowsLeft > 0) {
    const task = {
      center: state.frozen ?? state.camera.eye,
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
  if (moving || journey || turning || rowsLeft > 0 || held.size > 0 || stale || (drawnFor && drawnFor.resolution !== 1)) wake();
}

function paint(resolution) {
  painter.draw(seenBy(state.camera, resolution), state.show.endsWith("residual") ? "grey" : "full");
  drawMarks();
  placeNotes();
}

function sorted({ rows, along }) {
  painter.setOrder(rows);
  const { eye, axes } = sortedFor.camera;
  surface = along === null ? null : { point: plus(eye, axes[2], along), axis: axes[2] };
  sorting = false;
  sortedOnce = stale = true;
  wake();
}

// Whether the canvas shows what was asked for, in full.
function finished() {
  const size = `${canvas.width} ${canvas.height}`;
  return (
    painter && sortedOnce && !sorting && !journey && !turning && !picking && rowsLeft === 0 && !stale &&
    drawnFor?.resolution === 1 && drawnFor.camera === state.camera && sortedFor.camera === state.camera && sortedFor.size === size
  );
}

// What the canvas shows, as the address of a PNG.
function picture() {
  paint(1);
  return canvas.toDataURL();
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

let picking = null;

// The point of the scene that is seen at a place of the canvas, CSS pixels; null for none, and while another is sought.
async function pick(left, top) {
  if (picking) return null;
  const { lens, size } = seenBy(state.camera), { eye, axes } = state.camera;
  const [x, y] = [left / canvas.clientWidth, top / canvas.clientHeight].map((v, k) => v * size[k]);
  const direction = unit(plus(plus(axes[2], axes[0], (x - lens[2]) / lens[0]), axes[1], (y - lens[3]) / lens[1]));
  reader.post({ pick: { eye, direction } });
  const along = await new Promise((resolve) => (picking = resolve));
  picking = null;
  wake();
  return along === null ? null : plus(eye, direction, along);
}

// Where a point is seen, CSS pixels; null behind the camera.
function onScreen(point) {
  const { view, lens, size } = seenBy(state.camera);
  const p = [0, 4, 8].map((r) => dot(view.slice(r, r + 3), point) + view[r + 3]);
  if (p[2] < painter.near) return null;
  return [(lens[0] * p[0]) / p[2] + lens[2], (lens[1] * p[1]) / p[2] + lens[3]].map(
    (value, k) => (value * [canvas.clientWidth, canvas.clientHeight][k]) / size[k],
  );
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
  if (packed.textContent.endsWith(".nrf")) return fetched(packed.textContent);
  const parts = document.querySelectorAll('[type="text/plain"]');
  let letters = 0, at = 0;
  for (const part of parts) letters += part.textContent.length;
  const bytes = new Uint8Array(Math.ceil(0.75 * letters));
  try {
    for (const part of parts) {
      const text = part.textContent, rest = bytes.subarray(at);
      part.textContent = "";
      if (rest.setFromBase64) at += rest.setFromBase64(text).written;
      else for (const letter of atob(text)) bytes[at++] = letter.charCodeAt(0);
    }
  } catch {
    throw new BadFile("The page is damaged or cut short: its scene cannot be read.");
  }
  return bytes.subarray(0, at);
}

// XMLHttpRequest gives all of the bytes at once, where a stream of `fetch` leaves parts lying in memory.
function fetched(name) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.responseType = "arraybuffer";
    request.onprogress = ({ lengthComputable, loaded, total }) => lengthComputable && tell("Loading", loaded / total);
    request.onloadend = () => {
      if (request.status === 200) resolve(new Uint8Array(request.response));
      else reject(new BadFile(`${name} cannot be loaded. It must lie beside this page on a web server; a page of one file needs none.`));
    };
    request.open("GET", name);
    request.send();
  });
}

// Reads and sorts in a worker, or here where there is none.
function startReader() {
  const handlers = {
    progress: (value) => tell("Unpacking", value),
    failed: (message) => fail(new BadFile(message)),
    sorted,
    picked: (along) => picking(along),
  };
  const receive = (message) => {
    try {
      for (const [name, value] of Object.entries(message)) handlers[name](value);
    } catch (error) {
      fail(error);
    }
  };
  let post;
  try {
    const code = new Blob([byId("reader").textContent], { type: "text/javascript" });
    const worker = new Worker(URL.createObjectURL(code));
    worker.onmessage = ({ data }) => receive(data);
    worker.onerror = () => fail(new BadFile(UNREADABLE));  // the browser's console has the error
    post = (message, transfer) => worker.postMessage(message, transfer);
  } catch {
    const handle = answer((message) => setTimeout(() => receive(message)));
    post = (message) => setTimeout(() => handle(message));
  }
  return {
    post,
    // A promise of what draws the scene.
    read: (bytes) => new Promise((resolve) => {
      let made = null;
      const take = (set) => ([place, values]) => {
        made?.[set](place, values);
        post({ spent: values.buffer }, [values.buffer]);
      };
      Object.assign(handlers, {
        scene: (scene) => (made = new Painter(canvas, scene)),
        table: take("setTable"),
        latents: take("setLatents"),
        read: () => made && resolve(made.complete()),
      });
      post({ read: bytes }, [bytes.buffer]);
    }),
  };
}

async function main() {
  offer();
  reader = startReader();
  painter = await reader.read(await packedBytes());
  tell("Preparing", 1);
  fit();
  byId("count").textContent = `${painter.count.toLocaleString("en")} splats.`;
  listen();
  const asked = readAddress();
  wake();
  await window.nrfgs.finished();
  byId("loading").hidden = true;
  byId("poster").hidden = true;
  byId("bar").hidden = false;
  begin();
  if (!asked && !still.matches && (about.tour || about.rotate)) play(about.tour ? "tour" : "rotation");
}

main().catch(fail);
