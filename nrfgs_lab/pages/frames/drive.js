// SPDX-License-Identifier: Apache-2.0
// How frames.py drives each viewer. All have: ready(), when the scene can be drawn; to(k), which asks for camera k in
// the next frame; pictures(), how many have been drawn; finish(), until the GPU has drawn what it was told;
// passed(), a promise of the same; sorted(), until the order is the camera's; single(k), seconds of one picture until the GPU is done; size().
(() => {
  const until = (condition, limit = 60000) => new Promise((done, fail) => {
    const start = performance.now();
    const look = () => (condition() ? done() : performance.now() - start > limit ? fail(new Error("waited in vain")) : setTimeout(look, 10));
    look();
  });
  // Returns once the GPU has done all; of the canvas itself: what a library left bound may be unreadable, and not waited for.
  const pixel = (gl) => {
    const bound = gl.getParameter(gl.READ_FRAMEBUFFER_BINDING), buffer = gl.getParameter(gl.PIXEL_PACK_BUFFER_BINDING);
    if (gl.isContextLost()) throw new Error("the context is lost");
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, bound);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
  };
  const sized = (canvas) => [canvas.width, canvas.height];
  const rendererOf = (gl) => gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);

  // A promise of the GPU's having done what it has been told so far, which lets the page go on.
  const passed = (gl) => new Promise((done, fail) => {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), { port1, port2 } = new MessageChannel();
    gl.flush();
    port1.onmessage = () => {
      if (gl.isContextLost()) fail(new Error("the context is lost"));
      else if (gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED) {
        gl.deleteSync(fence);
        port1.close();
        done();
      } else port2.postMessage(0);
    };
    port2.postMessage(0);
  });

  let painted = 0;
  const P = () => internals.painter();  // frames.py opens the page's module to this
  const page = {
    async ready() {
      await until(() => window.nrfgs);
      await nrfgs.ready;
      const inner = P().draw.bind(P());
      P().draw = (...given) => { painted++; return inner(...given); };
      internals.fix();  // quality: all of the field, the whole resolution, in every frame
      this.eyes = (await (await fetch("cameras.json")).json()).ours;
      await nrfgs.finished();
      this.finish();
    },
    to(k) { nrfgs.setCamera({ position: this.eyes[k], target: [0, 0, 0] }); },
    pictures: () => painted,
    finish: () => pixel(P().gl),
    passed: () => passed(P().gl),
    sorted: () => nrfgs.finished(),
    async single() { return (await nrfgs.measure(1)).seconds_per_picture; },  // turns the camera itself, by as much
    size: () => sized(P().canvas),
    renderer: () => rendererOf(P().gl),
    more: () => internals.state(),
    picture: () => nrfgs.picture(),
  };
  const base = {
    ...page,
    async ready() {
      await page.ready.call(this);
      const show = document.getElementById("show");
      show.value = "base";
      show.dispatchEvent(new Event("change"));
      await nrfgs.finished();
    },
  };
  const auto = {  // the page as visitors have it
    ...page,
    async ready() {
      await page.ready.call(this);
      internals.free();
    },
  };

  let rendered = 0;
  const supersplat = {
    async ready() {
      await until(() => window.captureFrame && window.app);
      // "frameend" comes with each pass of the loop, rendered or not: only what renders is a picture.
      const inner = app.render.bind(app);
      app.render = (...given) => { rendered++; return inner(...given); };
      await scrubTo(0);
      await this.finish();
    },
    to(k) { scrubTo(k); },
    pictures: () => rendered,
    finish: () => (app.graphicsDevice.gl ? pixel(app.graphicsDevice.gl) : app.graphicsDevice.wgpu.queue.onSubmittedWorkDone()),
    passed: () => (app.graphicsDevice.gl ? passed(app.graphicsDevice.gl) : app.graphicsDevice.wgpu.queue.onSubmittedWorkDone()),
    async sorted() {  // then it draws once more, and has nothing to do
      const start = performance.now();
      let before = rendered, since = start;
      await until(() => {
        if (rendered !== before) [before, since] = [rendered, performance.now()];
        return performance.now() - since > 500 || performance.now() - start > 5000;
      });
    },
    async single(k) {
      let start;
      app.once("framerender", () => (start = performance.now()));
      await scrubTo(k);
      await this.finish();
      return (performance.now() - start) / 1000;
    },
    size: () => sized(app.graphicsDevice.canvas),
    renderer: () => (app.graphicsDevice.gl ? rendererOf(app.graphicsDevice.gl)
      : "WebGPU " + JSON.stringify({ ...(({ vendor, architecture, device, description }) => ({ vendor, architecture, device, description }))(app.graphicsDevice.gpuAdapter?.info ?? {}) })),
    more: () => ({ device: app.graphicsDevice.deviceType }),
    picture: () => new Promise((done) => {
      app.renderNextFrame = true;
      app.once("frameend", () => done(app.graphicsDevice.canvas.toDataURL()));
    }),
  };
  let drawn = 0;
  const spark = {
    async ready() {
      await until(() => window.spark);
      draw(0);
      await this.sorted();
      draw(0);
      this.finish();
    },
    to(k) { draw(k); drawn++; },
    pictures: () => drawn,
    finish: () => pixel(gl),
    passed: () => passed(gl),
    sorted: () => until(() => !window.spark.sorting && !window.spark.sortDirty),
    single(k) {
      const start = performance.now();
      draw(k);
      pixel(gl);
      return (performance.now() - start) / 1000;
    },
    size: () => sized(gl.canvas),
    renderer: () => rendererOf(gl),
    more: () => ({}),
    picture() {
      draw(0);
      return gl.canvas.toDataURL();
    },
  };

  // Without vsync a browser's frames run ahead of the GPU without bound. So for all who ask for frames, the viewer's own
  // loop and `run`: none is given before the GPU is done with the last but one.
  const real = window.requestAnimationFrame.bind(window), asking = new Map(), flight = [];
  let asked = 0, waiting = false, viewer = null;
  const give = (now) => {
    waiting = false;
    const all = [...asking.keys()];
    for (const id of all) {
      const callback = asking.get(id);
      asking.delete(id);
      try {
        callback?.(now);
      } catch (error) {
        reportError(error);
      }
    }
    if (viewer) flight.push(viewer.passed());
  };
  window.requestAnimationFrame = (callback) => {
    asking.set(++asked, callback);
    if (!waiting) {
      waiting = true;
      if (flight.length > 1) flight.shift().then(() => real(give));
      else real(give);
    }
    return asked;
  };
  window.cancelAnimationFrame = (id) => void asking.delete(id);

  const CAMERAS = 159;
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];
  window.bench = {
    // Milliseconds from the navigation's start until the first complete picture is drawn.
    async open(name) {
      const asked = { page, base, auto, supersplat, webgpu: supersplat, spark }[name];
      await asked.ready();
      const opened = performance.now();
      viewer = asked;
      return { open_ms: Math.round(opened), size: viewer.size(), renderer: viewer.renderer(), visible: document.visibilityState };
    },
    // The camera goes on in each frame; frames in a second over `count` of them, the GPU's work for the last one included.
    async run(warm, count, limit) {
      const go = (count, limit) => new Promise((done, fail) => {
        const times = [], start = performance.now();
        const tick = () => {
          try {
            times.push(performance.now());
            if (times.length > count || performance.now() - start > 1000 * limit) return done(times);
            viewer.to((k = (k + 1) % CAMERAS));
            requestAnimationFrame(tick);
          } catch (error) {
            fail(error);
          }
        };
        requestAnimationFrame(tick);
      });
      let k = 0;
      await go(warm, 0.3 * limit);
      await viewer.finish();
      const before = viewer.pictures(), start = performance.now(), times = await go(count, limit), asked = performance.now();
      await viewer.finish();
      const end = performance.now(), frames = times.length - 1, steps = times.slice(1).map((time, i) => time - times[i]);
      return {
        frames, pictures: viewer.pictures() - before, seconds: (end - start) / 1000, fps: (1000 * frames) / (end - start),
        interval_ms: median(steps), last_ms: end - asked, longest_ms: Math.max(...steps), ...viewer.more(),
      };
    },
    // Seconds of single pictures, the GPU done after each; sorting is waited for, off the clock, every tenth.
    async singles(count, limit) {
      const seconds = [], start = performance.now();
      for (let k = 1; k <= count && performance.now() - start < limit * 1000; k++) {
        seconds.push(await viewer.single(k));
        if (k % 10 === 0) await viewer.sorted();
      }
      const rest = seconds.length > 3 ? seconds.slice(2) : seconds;  // the first compile
      return { pictures: rest.length, median_ms: 1000 * median(rest), least_ms: 1000 * Math.min(...rest), most_ms: 1000 * Math.max(...rest) };
    },
    async picture() {
      viewer.to(0);
      await frame(); await frame();
      await viewer.sorted();
      return viewer.picture();
    },
  };
})();
