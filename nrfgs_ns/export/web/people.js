// SPDX-License-Identifier: Apache-2.0
// What people do and see besides the scene: pointers, keys, the panel, marks of photographs, notes.

let noteViews = [];  // {box, button, text} for each note of `notes`
let notes = [], stored = [];  // {text, position, camera}; cameras of a tour that is being made
let placing = false;          // the next point that is pressed gets a note
let quiet = 0;
const modes = document.body.classList;

// For screen readers; seen: for everybody, for a few seconds.
function say(text, seen = false) {
  const { classList } = Object.assign(byId("said"), { textContent: text });
  classList.toggle("seen", seen);
  clearTimeout(quiet);
  if (seen) quiet = setTimeout(() => classList.remove("seen"), 5000);
}

// ---- where photographs were taken

function marksInView() {
  return photographs.map(({ camera }, index) => ({ index, at: onScreen(camera.eye) })).filter(({ at }) =>
    at && at[0] >= 0 && at[1] >= 0 && at[0] <= canvas.clientWidth && at[1] <= canvas.clientHeight);
}

function drawMarks() {
  const marks = byId("marks");
  if (!state.marks && marks.width === 0) return;
  marks.width = state.marks ? canvas.clientWidth : 0;  // also clears
  marks.height = state.marks ? canvas.clientHeight : 0;
  if (!state.marks) return;
  const pen = marks.getContext("2d"), inView = marksInView();
  for (const { at } of inView) {
    pen.beginPath();
    pen.arc(...at, 6, 0, 2 * Math.PI);
    pen.fillStyle = "#ffd369cc";
    pen.fill();
    pen.strokeStyle = "#000";
    pen.stroke();
  }
  byId("mark-said").textContent = inView.length
    ? `${inView.length} of ${photographs.length} places ${inView.length > 1 ? "are" : "is"} in this view. Press a dot to go there.`
    : `None of the ${photographs.length} places is in this view: they are beside or behind you. Move back or turn.`;
}

// The photograph whose mark is under the pointer, if any.
function markAt(x, y) {
  const near = marksInView().map(({ index, at }) => ({ index, away: Math.hypot(at[0] - x, at[1] - y) }));
  const best = near.reduce((a, b) => (b.away < a.away ? b : a), { index: null, away: 22 });
  return best.index;
}

// ---- notes

function setNotes(list) {
  notes = list;
  byId("notes").replaceChildren();
  byId("note-list").replaceChildren();
  noteViews = notes.map((note, index) => {
    const add = (parent, tag, values) => {
      const element = Object.assign(document.createElement(tag), values);
      parent.append(element);
      return element;
    };
    const box = add(byId("notes"), "div", { className: "note", hidden: true });
    const button = add(box, "button", { type: "button", textContent: index + 1, ariaLabel: `Note ${index + 1}`, ariaExpanded: "false" });
    const text = add(box, "p", { textContent: note.text, hidden: true });
    button.addEventListener("click", () => {
      const open = text.hidden;
      for (const other of noteViews) {
        other.text.hidden = !(open && other.text === text);
        other.button.ariaExpanded = String(!other.text.hidden);
      }
      if (open && note.camera) flyTo(cameraOf(note.camera));
    });
    const line = add(byId("note-list"), "div", { className: "row" });
    const input = add(line, "input", { value: note.text, ariaLabel: `Text of note ${index + 1}`, maxLength: 500 });
    input.addEventListener("input", () => (note.text = text.textContent = input.value));
    add(line, "button", { type: "button", textContent: "Remove", ariaLabel: `Remove note ${index + 1}` }).addEventListener("click", () =>
      setNotes(notes.filter((other) => other !== note)));
    return { box, button, text };
  });
  byId("save-notes").disabled = notes.length === 0;
  stale = true;
  wake();
}

function placeNotes() {
  noteViews.forEach(({ box }, index) => {
    const at = onScreen(notes[index].position);
    box.hidden = !at;
    if (at) box.style.transform = `translate(${at[0]}px, ${at[1]}px)`;
    box.classList.toggle("left", Boolean(at) && at[0] > canvas.clientWidth / 2);
  });
}

async function placeNote(x, y) {
  placing = false;
  modes.remove("placing");
  const position = await pick(x, y);
  if (!position) return say("There is nothing at that place. Add the note again.", true);
  setNotes([...notes, { text: "", position, camera: given(state.camera) }]);
  say("Write the note's text.");
  open("share");
  byId("for-author").open = true;
  byId("note-list").lastChild.firstChild.focus();
}

// ---- the panel

function open(name) {
  byId("panel").hidden = name === null;
  for (const tab of document.querySelectorAll("#bar [aria-controls]")) {
    const part = tab.getAttribute("aria-controls");
    tab.setAttribute("aria-expanded", part === name);
    byId(part).hidden = part !== name;
  }
}

function playing(what) {
  byId("tour").textContent = what === "tour" ? "Stop tour" : "Tour";
  byId("tour").setAttribute("aria-pressed", what === "tour");
  byId("rotate").checked = what === "rotation";
}

async function copy(field) {
  field.select();
  const copied = await navigator.clipboard?.writeText(field.value).then(() => true, () => false);
  say(copied || document.execCommand("copy") ? "Copied." : "Select the text and copy it.", true);
}

function save(href, download) {
  Object.assign(document.createElement("a"), { href, download }).click();
}

const saveJson = (name, value) =>
  save(`data:application/json,${encodeURIComponent(JSON.stringify(value, null, 1) + "\n")}`, name);

const legends = {
  full: "The picture as trained, with the residual times the gain.",
  base: "What does not depend on the view.",
  residual: "Grey: no change of colour. Otherwise the change times the gain, times 4.",
  "opacity residual": "Grey: no change. Orange: more opaque, blue: less; times the gain, times 4.",
};

function listenToPanel() {
  const on = (id, kind, act) => byId(id).addEventListener(kind, (event) => {
    act(event.target);
    wake();
  });
  const online = location.protocol.startsWith("http");
  const step = (by) => visit((state.photograph + by + photographs.length) % photographs.length);
  byId("panel").addEventListener("submit", (event) => event.preventDefault());
  for (const tab of document.querySelectorAll("#bar [aria-controls]")) {
    tab.addEventListener("click", () => open(tab.ariaExpanded === "true" ? null : tab.getAttribute("aria-controls")));
  }
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
  on("rotate", "change", ({ checked }) => (checked ? play("rotation") : stop()));
  on("tour", "click", ({ ariaPressed }) => (ariaPressed === "true" ? stop() : play("tour")));
  on("mark", "change", ({ checked }) => {
    state.marks = checked;
    stale = true;
    byId("mark-said").hidden = !checked;
  });
  on("photograph", "change", ({ value }) => visit(Number(value)));
  on("previous", "click", () => step(-1));
  on("next", "click", () => step(1));
  on("home", "click", () => visit(about.start));
  on("save", "click", () => save(picture(), "picture.png"));
  on("full-screen", "click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch(() => say("This browser shows no full screen here.", true));
  });
  on("copy-link", "click", () => {
    byId("link").hidden = false;
    byId("link").value = addressOf(state.camera);
    copy(byId("link"));
  });
  on("embed", "click", () => {
    const code = byId("embed-code"), text = document.createElement("i");
    text.textContent = document.title;
    code.value = `<iframe src="${online ? addressOf(state.camera).replaceAll("&", "&amp;") : "https://..."}" ` +
      `title="${text.innerHTML.replaceAll('"', "&quot;")}" width="800" height="500" style="border:0" ` +
      `allow="fullscreen; clipboard-write" loading="lazy"></iframe>`;
    byId("embedding").hidden = false;
    copy(code);
  });
  on("add-note", "click", () => {
    placing = true;
    modes.add("placing");
    if (sheet.matches) open(null);
    say("Press the place of the scene that the note is about.", true);
  });
  on("save-notes", "click", () => saveJson("notes.json", { notes }));
  on("add-view", "click", () => {
    stored.push(given(state.camera));
    byId("save-tour").disabled = stored.length < 2;
    say(stored.length === 1 ? "1 view is kept. A tour needs two." : `${stored.length} views are kept.`, true);
  });
  on("save-tour", "click", () => saveJson("tour.json", { tour: stored }));
  byId("tour").hidden = !about.tour;
  byId("full-screen").hidden = !document.fullscreenEnabled;
  byId("where").textContent = online ? "" : "This page is a file on your device: put it on a web host first, and links will work for everybody.";
  byId("to-host").textContent = byId("packed").textContent.trim().endsWith(".nrf")
    ? "Host index.html and scene.nrf in one folder of any web server, and paste this into your page:"
    : "Host this one HTML file on any web server, and paste this into your page:";
  byId("photograph").append(...photographs.map(({ name }, index) => new Option(`${index + 1}. ${name}`, index)));
  byId("photograph").value = state.photograph;
  byId("legend").textContent = legends.full;
  setNotes(about.notes ?? []);
}

// ---- pointers and keys

const pointers = new Map();
const held = new Set();  // keys that fly
const sheet = matchMedia("(max-width: 600px)");  // where the panel covers the scene
let flewAt = null;

function listen() {
  const on = canvas.addEventListener.bind(canvas);
  listenToPanel();
  for (const kind of ["pointerdown", "wheel", "keydown"]) {
    addEventListener(kind, ({ target }) => {
      if (!target.closest?.("[data-plays]")) stop();
      modes.toggle("pointing", kind !== "keydown");  // no frame around what a mouse drags
    }, { capture: true, passive: true });
  }
  on("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, path: 0, button: event.button });
  });
  on("pointermove", (event) => {
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
    on(kind, (event) => {
      const pointer = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      if (kind !== "pointerup" || !(pointer?.path < 4)) return;
      const index = state.marks ? markAt(event.clientX, event.clientY) : null;
      if (placing) placeNote(event.clientX, event.clientY);
      else if (index !== null) visit(index);
      else if (sheet.matches) open(null);
    });
  }
  on("contextmenu", (event) => event.preventDefault());
  on("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    zoom(Math.exp(Math.max(-1, Math.min(1, 0.0015 * lines * event.deltaY))));
  }, { passive: false });
  // Look at what was double-clicked, and turn around it from now on.
  on("dblclick", async (event) => {
    const point = await pick(event.clientX, event.clientY);
    if (!point) return;
    const { eye, axes } = state.camera, there = minus(point, eye);
    flyTo({ ...state.camera, axes: facing(there, axes[0]), distance: norm(there) });
  });
  on("webglcontextlost", () => fail(new Lacking("The graphics device has gone away. Load the page again.")));
  document.addEventListener("keydown", pressed);
  document.addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));
  addEventListener("blur", () => held.clear());
  addEventListener("resize", wake);
}

function flyByKeys(now) {
  if (held.size === 0) {
    flewAt = null;
    return;
  }
  const step = 0.5 * typical * Math.min(0.1, flewAt === null ? 0.016 : (now - flewAt) / 1000);
  flewAt = now;
  const sign = (one, other) => (held.has(one) ? step : 0) - (held.has(other) ? step : 0);
  fly(sign("d", "a"), sign("e", "q"), sign("w", "s"));
}

function pressed(event) {
  if (event.key === "Escape") {
    const tab = document.querySelector("#bar [aria-expanded=true]");
    open(null);
    tab?.focus();
    placing = false;
    modes.remove("placing");
  }
  if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const actions = {
    ArrowLeft: () => turn(0.08, 0), ArrowRight: () => turn(-0.08, 0), ArrowUp: () => turn(0, 0.08),
    ArrowDown: () => turn(0, -0.08), "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
    "[": () => byId("previous").click(), "]": () => byId("next").click(), Home: () => visit(about.start),
    f: () => byId("freeze").click(), h: () => modes.toggle("bare"),
  };
  if ("wasdqe".includes(key)) {
    held.add(key);
    wake();
  } else if (actions[key]) {
    event.preventDefault();
    actions[key]();
  }
}
