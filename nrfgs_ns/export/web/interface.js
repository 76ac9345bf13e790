// SPDX-License-Identifier: Apache-2.0
// The page's address and its interface for other pages (docs/web-interface.md); tests use it as well.

const VERSION_OF_INTERFACE = 1;
const listeners = { ready: new Set(), moved: new Set(), failed: new Set() };
let told = null;  // the camera of the last "moved"

function emit(kind, detail) {
  for (const listener of listeners[kind]) {
    try {
      listener(detail);
    } catch (error) {
      console.error(error);  // the listener's own
    }
  }
}

function tellMoved() {
  if (told === state.camera) return;
  told = state.camera;
  if (listeners.moved.size) emit("moved", given(told));
}

// A camera as other pages are given it.
function given(camera) {
  const [, fy] = lensOn(camera.lens, canvas.width, canvas.height);
  const fov = (360 / Math.PI) * Math.atan(canvas.height / 2 / fy);
  return { position: camera.eye, target: targetOf(camera), up: camera.axes[1].map((v) => -v), fov };
}

// A camera as other pages, links and files give it; a TypeError says what is wrong with it.
function cameraOf(asked) {
  if (typeof asked !== "object" || asked === null) throw new TypeError("A camera is an object with a position and a target, or with a matrix.");
  const numbers = (name, length) => {
    const values = Array.from(asked[name] ?? []);
    if (values.length === length && values.every(Number.isFinite)) return values;
    throw new TypeError(`camera.${name} must be ${length} finite numbers.`);
  };
  let camera;
  if (asked.matrix) {
    if (asked.position || asked.target) throw new TypeError("A camera has a matrix, or a position and a target, not both.");
    camera = { ...poseOf(numbers("matrix", 16)), distance: typical };
    const [right, down, ahead] = camera.axes, skew = minus(cross(right, down), ahead);
    if (norm(skew) > 1e-3 || Math.abs(norm(right) - 1) > 1e-3 || Math.abs(norm(down) - 1) > 1e-3) {
      throw new TypeError("camera.matrix must be a rotation and a position, without a scale or a mirror image.");
    }
  } else {
    const eye = numbers("position", 3), there = minus(numbers("target", 3), eye), distance = norm(there);
    if (!(distance > 0)) throw new TypeError("camera.target must differ from camera.position.");
    const up = asked.up ? numbers("up", 3) : about.up, side = cross(there, up);
    camera = { eye, axes: facing(there, norm(side) > 1e-6 * distance * norm(up) ? side : state.camera.axes[0]), distance };
  }
  const { fov, aspect = canvas.width / canvas.height } = asked;
  // As it was given out, it means the lens that the camera has, which may be off centre.
  if (fov === undefined || Math.abs(fov - given(state.camera).fov) < 1e-9) return { ...camera, lens: state.camera.lens };
  if (!(fov > 0 && fov < 180)) throw new TypeError("camera.fov must lie between 0 and 180 degrees.");
  if (!(aspect > 0 && aspect < Infinity)) throw new TypeError("camera.aspect must be a positive number.");
  const focal = 0.5 / Math.tan((fov * Math.PI) / 360);
  return { ...camera, lens: [focal, focal, aspect / 2, 0.5, aspect] };
}

// ---- the address: #photograph=3, or &camera= with position, target and up; the photograph's lens, or &fov=

function addressOf(camera) {
  const { position, target, up, fov } = given(camera), short = (value) => Number(value.toPrecision(7));
  const lens = camera.lens === photographs[state.photograph].camera.lens ? "" : `&fov=${short(fov)}`;
  return `${location.href.split("#")[0]}#photograph=${state.photograph + 1}&camera=${[...position, ...target, ...up].map(short)}${lens}`;
}

// Whether the address asks for a view; one that cannot be read is none.
function readAddress() {
  const asked = new URLSearchParams(location.hash.slice(1)), index = Number(asked.get("photograph")) - 1;
  const known = index in photographs;
  if (known) visit(index, 0);
  if (!asked.has("camera")) return known;
  const values = asked.get("camera").split(",").map(Number), fov = asked.has("fov") ? { fov: Number(asked.get("fov")) } : {};
  try {
    move(cameraOf({ position: values.slice(0, 3), target: values.slice(3, 6), up: values.slice(6), ...fov }));
    return true;
  } catch {
    say("The link names no view that can be shown.", true);
    return known;
  }
}

// ---- for other pages

function offer() {
  const photograph = (index) => {
    if (photographs[index]) return index;
    throw new RangeError(`There is no photograph ${index}: they are 0 to ${photographs.length - 1}.`);
  };
  const calls = {  // also by message
    getCamera: () => given(state.camera),
    getMatrix: () => matrixOf(state.camera),
    setCamera: (camera) => void flyTo(cameraOf(camera), 0),
    flyTo: (camera, seconds) => flyTo(cameraOf(camera), seconds),
    photographs: () => photographs.map(({ name, camera }) => ({ name, matrix: matrixOf(camera), ...given(camera) })),
    visit: (index, seconds = 0) => visit(photograph(index), seconds),
    play(what) {
      if (what === "rotation" || (what === "tour" && about.tour)) play(what);
      else throw new RangeError(`There is no ${what} to play.`);
    },
    stop,
    getNotes: () => structuredClone(notes),
    setNotes(list) {
      for (const { text, position, camera } of list) {
        if (typeof text !== "string") throw new TypeError("A note's text must be a string.");
        cameraOf({ position, target: plus(position ?? [], [1, 0, 0]) });
        if (camera) cameraOf(camera);
      }
      setNotes(structuredClone(list));
    },
    finished: () => new Promise((resolve) => {
      waiting.push(resolve);
      wake();
    }),
  };
  const on = (kind, listener) => {
    if (!listeners[kind]) throw new RangeError(`There is no event "${kind}".`);
    listeners[kind].add(listener);
    return () => void listeners[kind].delete(listener);
  };
  window.nrfgs = { version: VERSION_OF_INTERFACE, ready, on, ...calls, picture };

  // The page around this one, whoever made it, may move the camera. It is not given pictures: another site's page must
  // not read what a browser shows only because its reader may see it.
  const tell = (origin) => (message) =>
    parent.postMessage({ nrfgs: VERSION_OF_INTERFACE, ...message }, origin === "null" ? "*" : origin);
  let heard = false;
  addEventListener("message", async ({ data, source, origin }) => {
    if (source !== parent || source === window || data?.nrfgs !== VERSION_OF_INTERFACE) return;
    const answer = tell(origin);
    try {
      await ready;
      if (!heard) on("moved", (camera) => answer({ event: "moved", camera }));
      heard = true;
      if (!Object.hasOwn(calls, data.call)) throw new RangeError(`There is no call "${data.call}".`);
      answer({ id: data.id, result: await calls[data.call](...(data.args ?? [])) });
    } catch (error) {
      answer({ id: data.id, error: error.message });
    }
  });
  addEventListener("hashchange", readAddress);
  ready.then(() => emit("ready"), () => {});
  if (parent !== window) {
    on("ready", () => tell("*")({ event: "ready" }));
    on("failed", ({ message }) => tell("*")({ event: "failed", message }));
  }
}
