// SPDX-License-Identifier: Apache-2.0
// How viewers.py drives each viewer: `ready` for the scene; `draw` camera k, seconds; `sorted` for it; its `picture`.
(() => {
  const until = (condition) => new Promise((done) => {
    const look = () => (condition() ? done() : setTimeout(look, 20));
    look();
  });
  // Seconds from a start until the GPU has done what it was told.
  const since = (start, gl) => {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return (performance.now() - start) / 1000;
  };

  const page = {
    ready: () => nrfgs.ready.then(() => true),
    draw: async () => (await nrfgs.measure(1)).seconds_per_picture,  // turns the camera itself
    async sorted() {
      await nrfgs.finished();
      since(0, document.getElementById("scene").getContext("webgl2"));  // its last picture is drawn, too
    },
    picture: () => nrfgs.picture(),
  };
  const base = {
    ...page,
    async ready() {
      await nrfgs.ready;
      const show = document.getElementById("show");
      show.value = "base";
      show.dispatchEvent(new Event("change"));
    },
  };
  const supersplat = {
    ready: () => until(() => window.captureFrame),
    async draw(k) {
      let start;
      app.once("framerender", () => (start = performance.now()));
      await scrubTo(k);
      return since(start, app.graphicsDevice.gl);
    },
    async sorted() {  // then it draws once more, and has nothing to do
      let drawn = performance.now();
      const note = () => { if (app.renderNextFrame) drawn = performance.now(); };
      app.on("framerender", note);
      await until(() => performance.now() - drawn > 3000);
      app.off("framerender", note);
    },
    picture: () => new Promise((done) => {
      app.renderNextFrame = true;
      app.once("frameend", () => done(app.graphicsDevice.canvas.toDataURL()));
    }),
  };
  const spark = {
    ready: () => until(() => window.spark),
    draw(k) {
      const start = performance.now();
      draw(k);
      return since(start, gl);
    },
    sorted: () => until(() => !window.spark.sorting && !window.spark.sortDirty),
    picture(k) {
      draw(k);
      return gl.canvas.toDataURL();
    },
  };
  window.viewers = { page, base, supersplat, spark };
})();
