// SPDX-License-Identifier: Apache-2.0
// Splats into a picture, with gsplat's rules: a blur of 0.3 square pixels, opacity at most 0.999 and nothing below
// 1/255, each splat in the 16-pixel tiles that the square of three standard deviations meets. Projection as in
// nrfgs_ns/rasterizer/torch_cpu/projection.py.

// Splats in an instance: what draws instances one by one, as renderers without a GPU do, is slow with one splat in each.
const BATCH = 1024;

const SPLAT_VERTEX = `${HEAD}
uniform sampler2D table;
uniform usampler2D looks, order;
uniform int drawn;
uniform mat4 view;       // world to camera: x right, y down, z forwards
uniform vec4 lens;       // focal lengths and principal point, pixels
uniform vec2 size;       // of the picture, pixels
uniform float near;
uniform bool antialiased;
flat out vec4 look;      // colour, opacity
flat out vec3 conic;
flat out vec2 mean;      // pixels, from the top left
flat out vec4 tiles;     // left, top, right, bottom of the tiles that may be touched

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, until there is something to draw
  int k = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  if (k >= drawn) return;
  int i = int(texelFetch(order, ivec2(k % ${WIDTH}, k / ${WIDTH}), 0).r);
  ivec2 at = ${texel(TABLE_TEXELS)};
  look = uintBitsToFloat(texelFetch(looks, ivec2(i % ${PER_ROW(TABLE_TEXELS)}, i / ${PER_ROW(TABLE_TEXELS)}), 0));
  vec4 q = texelFetch(table, at + ivec2(1, 0), 0);
  vec3 scale = texelFetch(table, at + ivec2(2, 0), 0).xyz;
  vec3 p = (view * vec4(texelFetch(table, at, 0).xyz, 1.0)).xyz;
  if (!(p.z >= near)) return;

  vec2 slope = p.xy / p.z;
  mean = lens.xy * slope + lens.zw;
  vec2 margin = 0.15 * size / lens.xy;
  vec2 held = clamp(slope, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 axes = mat3(view) * mat3(
    scale.x * vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
    scale.y * vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
    scale.z * vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)));
  vec3 right = vec3(axes[0].x, axes[1].x, axes[2].x), down = vec3(axes[0].y, axes[1].y, axes[2].y);
  vec3 ahead = vec3(axes[0].z, axes[1].z, axes[2].z);
  vec3 a0 = (lens.x / p.z) * (right - held.x * ahead), a1 = (lens.y / p.z) * (down - held.y * ahead);
  float xx = dot(a0, a0), xy = dot(a0, a1), yy = dot(a1, a1);
  vec3 normal = cross(a0, a1);
  float det = dot(normal, normal), blurred = det + 0.3 * (xx + yy) + 0.09;
  xx += 0.3;
  yy += 0.3;
  float spread = length(vec2(0.5 * (xx - yy), xy)), middle = 0.5 * (xx + yy);
  float radius = ceil(3.0 * sqrt(middle + max(spread, ${Math.sqrt(0.1)})));
  if (any(lessThanEqual(mean + radius, vec2(0.0))) || any(greaterThanEqual(mean - radius, size))) return;
  if (antialiased) look.a *= sqrt(det / blurred);
  if (!(look.a >= 1.0 / 255.0)) return;
  conic = vec3(yy, -xy, xx) / blurred;
  tiles = vec4(floor(mean / 16.0 - radius / 16.0), ceil(mean / 16.0 + radius / 16.0)) * 16.0;

  // The ellipse of 1/255: half axes, a hundredth of a pixel wider than needed.
  float longest = middle + spread;
  vec2 axis = xx >= yy ? vec2(longest - yy, xy) : vec2(xy, longest - xx);
  axis = spread > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  vec2 half_axes = sqrt(2.0 * log(255.0 * look.a) * vec2(longest, blurred / longest)) + 0.01;
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
  vec2 pixel = mean + corner.x * half_axes.x * axis + corner.y * half_axes.y * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel / size - 1.0, 0.0, 1.0) * vec4(1.0, -1.0, 1.0, 1.0);
}
`;

const SPLAT_FRAGMENT = `${HEAD}
uniform vec2 size;
flat in vec4 look;
flat in vec3 conic;
flat in vec2 mean;
flat in vec4 tiles;
out vec4 blended;
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  if (any(lessThan(pixel, tiles.xy)) || any(greaterThan(pixel, tiles.zw))) discard;
  vec2 d = mean - pixel;
  float sigma = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
  float alpha = min(0.999, look.a * exp(-sigma));
  if (sigma < 0.0 || alpha < 1.0 / 255.0) discard;
  blended = vec4(look.rgb * alpha, alpha);
}
`;

const WHOLE_VERTEX = `${HEAD}
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
`;

const SHOW_FRAGMENT = `${HEAD}
uniform sampler2D picture;
uniform vec2 size;
out vec4 color;
void main() {
  color = vec4(clamp(texture(picture, gl_FragCoord.xy / size).rgb, 0.0, 1.0), 1.0);
}
`;

const LARGEST_KEPT = 2 ** 28;  // bytes for what is kept of the first layers: beyond, it is computed for each view
const GREY = [0.5, 0.5, 0.5];

class Painter {
  // canvas: to draw on. scene: as `readScene` tells it; then come setTable, setLatents and, after all of these, complete.
  constructor(canvas, scene) {
    const gl = (this.gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance",
    }));
    if (!gl) throw new Lacking("The scene is drawn with WebGL 2, which this browser does not offer here. Turn on graphics acceleration in its settings, update it, or open the page in a current Chrome, Edge, Firefox or Safari.");
    const wide = ["float", "half_float"].map((kind) => gl.getExtension(`EXT_color_buffer_${kind}`));
    const { header, count } = scene, { background, near_plane: near } = header.render;
    Object.assign(this, { canvas, header, count, background, near });
    this.exact = wide.some(Boolean);  // else pictures are blended in 8 bits
    this.plan = plan(header.head.config, scene.weights);
    this.rows = Math.ceil(count / PER_ROW(TABLE_TEXELS));
    if (gl.getParameter(gl.MAX_TEXTURE_SIZE) < Math.max(WIDTH, this.rows)) {
      throw new Lacking(`This device's textures are too small for ${count.toLocaleString()} splats.`);
    }

    this.table = this._texture(gl.RGBA32F, WIDTH, this.rows);
    this.looks = this._texture(gl.RGBA32UI, PER_ROW(TABLE_TEXELS), this.rows);
    this.looksTarget = this._target(this.looks);
    this._startField(scene);
    this._buildSplats();
    this.show = this._program(WHOLE_VERTEX, SHOW_FRAGMENT);
    this.drawn = 0;
    this.target = null;
  }

  setTable(first, values) {
    const { gl } = this, y = first / PER_ROW(TABLE_TEXELS);
    gl.bindTexture(gl.TEXTURE_2D, this.table);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, WIDTH, values.length / (4 * WIDTH), gl.RGBA, gl.FLOAT, values);
    this._settle();
  }

  setLatents(layer, codes) {
    const { gl } = this, format = [gl.RGBA_INTEGER, codes.BYTES_PER_ELEMENT === 2 ? gl.SHORT : gl.INT];
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.latents);
    for (let y = 0; y < this.height; y += 32) {
      const rows = Math.min(32, this.height - y);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, y, layer, WIDTH, rows, 1, ...format, codes, 4 * WIDTH * y);
      this._settle();
    }
  }

  // Computes what is kept of the first layers, once all is there; returns itself.
  complete() {
    const { gl, plan, own, keep } = this;
    if (keep) {
      const buffer = gl.createFramebuffer(), places = [0, 1, 2, 3].map((k) => gl.COLOR_ATTACHMENT0 + k);
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.drawBuffers(places);
      gl.disable(gl.BLEND);
      gl.viewport(0, 0, WIDTH, this.height);
      this._bind(keep, { table: this.table, latents: this.latents });
      for (let layer = 0; layer < plan.layers; layer += 4) {
        places.forEach((place, k) => gl.framebufferTextureLayer(gl.FRAMEBUFFER, place, this.kept, 0, layer + k));
        this._check();
        gl.uniform4fv(keep.at("own"), own.values, 4 * own.width * layer, 16 * own.width);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
      }
      gl.deleteFramebuffer(buffer);
      gl.deleteProgram(keep.program);
      gl.deleteTexture(this.latents);
    }
    this._settle();
    return this;
  }

  // Waits until the GPU's process has taken what it was sent, and the page has its memory again.
  _settle() {
    const { gl } = this;
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Lacking("This device's graphics memory is too small for the scene.");
  }

  _startField(scene) {
    const { gl, plan } = this, short = scene.header.streams.find(({ name }) => name === "latents").dtype === "int16";
    const view = viewWeights(plan, scene.weights), room = gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE);
    if (view.byteLength > room) throw new Lacking(`This device's shaders have no room for ${view.length} weights.`);
    const own = (this.own = ownWeights(plan, scene.weights, scene.header.grids.latents));
    const height = (this.height = Math.ceil(scene.count / WIDTH));
    this.latents = this._texture(short ? gl.RGBA16I : gl.RGBA32I, WIDTH, height, plan.latentTexels);
    const fits = this.exact && 8 * WIDTH * height * plan.layers <= LARGEST_KEPT &&
      plan.layers <= gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS) &&
      4 * own.width <= gl.getParameter(gl.MAX_FRAGMENT_UNIFORM_VECTORS);
    if (fits) {
      this.kept = this._texture(gl.RGBA16F, WIDTH, height, plan.layers);
      this.keep = this._program(WHOLE_VERTEX, keepShader(plan, own.width));
    } else {
      this.ownTexture = this._texture(gl.RGBA32F, own.width, plan.layers);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, own.width, plan.layers, gl.RGBA, gl.FLOAT, own.values);
    }
    this.look = this._program(WHOLE_VERTEX, lookShader(plan, scene.header, scene.count, fits));
    const block = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, block);
    gl.bufferData(gl.UNIFORM_BUFFER, view, gl.STATIC_DRAW);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, block);
    gl.uniformBlockBinding(this.look.program, gl.getUniformBlockIndex(this.look.program, "Weights"), 0);
  }

  _buildSplats() {
    const { gl } = this;
    this.splats = this._program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.order = this._texture(gl.R32UI, WIDTH, Math.floor(this.count / WIDTH) + 1);
    const corners = new Uint16Array(6 * BATCH).map((_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  // The rows to draw, far to near.
  setOrder(rows) {
    const { gl } = this;
    const whole = Math.floor((this.drawn = rows.length) / WIDTH), format = [gl.RED_INTEGER, gl.UNSIGNED_INT, rows];
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, whole, ...format, 0);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rows.length % WIDTH, 1, ...format, whole * WIDTH);
  }

  // Evaluate the field for rows [first, first + rows) of the texture.
  //   center  from where splats are seen; camera: what is seen of them, or null for all
  //   mode    "full", "residual", "opacity residual"; gain: factor of the residuals
  evaluate({ center, camera, mode, gain }, first, rows) {
    const { gl, look } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.looksTarget);
    gl.useProgram(look.program);
    gl.disable(gl.BLEND);
    gl.viewport(0, 0, PER_ROW(TABLE_TEXELS), this.rows);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, PER_ROW(TABLE_TEXELS), rows);
    const extra = this.kept ? { kept: this.kept } : { latents: this.latents, ownWeights: this.ownTexture };
    this._bind(look, { table: this.table, ...extra });
    gl.uniform3fv(look.at("center"), center);
    gl.uniform1f(look.at("gain"), gain);
    gl.uniform1i(look.at("mode"), ["full", "residual", "opacity residual"].indexOf(mode));
    gl.uniform1i(look.at("only_seen"), camera ? 1 : 0);
    if (camera) gl.uniform4fv(look.at("planes"), planesOf(camera, this.near));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Draw onto the canvas. camera: {view, lens, size}, size that of the picture, which is stretched over the canvas.
  draw({ view, lens, size }, mode) {
    const { gl, splats, show, canvas } = this;
    const [width, height] = size;
    this._resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...(mode === "full" ? this.background : GREY), 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats.program);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this._bind(splats, { table: this.table, looks: this.looks, order: this.order });
    gl.uniformMatrix4fv(splats.at("view"), true, [...view, 0, 0, 0, 1]);
    gl.uniform4fv(splats.at("lens"), lens);
    gl.uniform2f(splats.at("size"), width, height);
    gl.uniform1f(splats.at("near"), this.near);
    gl.uniform1i(splats.at("antialiased"), this.header.render.rasterize_mode === "antialiased" ? 1 : 0);
    gl.uniform1i(splats.at("drawn"), this.drawn);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.drawn / BATCH));
    gl.disable(gl.BLEND);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.useProgram(show.program);
    this._bind(show, { picture: this.target.texture });
    gl.uniform2f(show.at("size"), canvas.width, canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  _resize(width, height) {
    const { gl } = this;
    if (this.target && this.target.width === width && this.target.height === height) return;
    if (this.target) {
      gl.deleteFramebuffer(this.target.buffer);
      gl.deleteTexture(this.target.texture);
    }
    const texture = this._texture(this.exact ? gl.RGBA16F : gl.RGBA8, width, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    this.target = { width, height, texture, buffer: this._target(texture) };
  }

  // A texture; with layers, an array of them.
  _texture(format, width, height, layers = 0) {
    const { gl } = this, texture = gl.createTexture(), kind = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D;
    gl.bindTexture(kind, texture);
    if (layers) gl.texStorage3D(kind, 1, format, width, height, layers);
    else gl.texStorage2D(kind, 1, format, width, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, side, gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, side, gl.CLAMP_TO_EDGE);
    return texture;
  }

  _target(texture) {
    const { gl } = this;
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this._check();
    return buffer;
  }

  _check() {
    const { gl } = this;
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) {
      throw new Lacking("This device cannot draw into the textures that the scene needs.");
    }
  }

  _program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const said = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader)).join("\n");
      console.error(said, gl.getProgramInfoLog(program));
      throw new Lacking("This device's graphics driver cannot run what draws the scene. Update it, or open the page in another browser.");
    }
    const places = {};
    return { program, at: (name) => (places[name] ??= gl.getUniformLocation(program, name)) };
  }

  _bind(program, textures) {
    const { gl } = this;
    gl.useProgram(program.program);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(name === "kept" || name === "latents" ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, texture);
      gl.uniform1i(program.at(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0);
  }
}
