// SPDX-License-Identifier: Apache-2.0
// The neural residual field (nrfgs_ns/appearance/nrf.py) in two shaders. `keep` computes, once, what a splat's own
// numbers (latent, base colour, base opacity) contribute to the first layers; `look` adds what the view contributes,
// and the second layers.

const GROUP = 4;  // hidden units in a texel

// How the network is cut into groups of four hidden units: inputs by name, and the numbers that each group reads.
function plan(config, weights) {
  const bands = (first, end) => {
    const names = [];
    for (let k = first; k < end; k++) {
      for (const wave of ["sin", "cos"]) for (const axis of "xyz") names.push(`${wave}${k}.${axis}`);
    }
    return names;
  };
  const own = Array.from({ length: config.latent_dim }, (_, i) => `z${i}`).concat("c.r", "c.g", "c.b");
  const far = config.use_distance ? ["far"] : [];
  const low = [...own, ...far, "opacity", "d.x", "d.y", "d.z", ...bands(0, config.split_bands ? 1 : config.num_bands)];
  const branches = [{ name: "low", inputs: low }];
  if (config.split_bands && config.num_bands > 1) {
    branches.push({ name: "high", inputs: [...own, ...far, ...bands(1, config.num_bands)] });
  }
  let first = 0;
  for (const branch of branches) {
    branch.units = weights[`${branch.name}.0.weight`].shape[0];
    branch.first = first;
    branch.groups = Math.ceil(branch.units / GROUP);
    branch.view = branch.inputs.filter((name) => !isOwn(name));
    first += branch.groups;
  }
  return { config, branches, layers: GROUP * Math.ceil(first / GROUP), latentTexels: Math.ceil(config.latent_dim / 4) };
}

function isOwn(name) {
  return name.startsWith("z") || name.startsWith("c.") || name === "opacity";
}

// First layers of a splat's own numbers: for each group a row of texels, bias, colour (3), opacity, latent, which is in
// steps of its grids; each texel holds the weights of four hidden units.
function ownWeights(plan, weights, { low, step }) {
  const width = 5 + 4 * plan.latentTexels, out = new Float32Array(4 * width * plan.layers);
  const columns = ["bias", "c.r", "c.g", "c.b", "opacity"];
  for (let i = 0; i < 4 * plan.latentTexels; i++) columns.push(`z${i}`);
  for (const branch of plan.branches) {
    const layer = weights[`${branch.name}.0.weight`], bias = weights[`${branch.name}.0.bias`];
    for (let unit = 0; unit < branch.units; unit++) {
      const row = branch.first + (unit >> 2);
      columns.forEach((name, column) => {
        const input = branch.inputs.indexOf(name);
        const weight = input < 0 ? 0 : layer.values[unit * branch.inputs.length + input];
        out[4 * (row * width + column) + (unit & 3)] = weight * (step[column - 5] ?? 1);
      });
      const add = (sum, value, r) => sum + value * layer.values[unit * branch.inputs.length + r];
      out[4 * row * width + (unit & 3)] = low.reduce(add, bias.values[unit]);
    }
  }
  return { width, values: out };
}

// What `look` reads, as vectors of four: for each group one vector for each input of the view (four hidden units), then
// one for each of the four hidden units (four outputs); last the output biases of each branch.
function viewWeights(plan, weights) {
  const out = [];
  for (const branch of plan.branches) {
    const layer = weights[`${branch.name}.0.weight`], second = weights[`${branch.name}.2.weight`];
    for (let group = 0; group < branch.groups; group++) {
      const units = [0, 1, 2, 3].map((k) => 4 * group + k);
      for (const name of branch.view) {
        const input = branch.inputs.indexOf(name);
        for (const unit of units) out.push(unit < branch.units ? layer.values[unit * branch.inputs.length + input] : 0);
      }
      for (const unit of units) {
        for (let o = 0; o < 4; o++) {
          out.push(unit < branch.units && o < second.shape[0] ? second.values[o * branch.units + unit] : 0);
        }
      }
    }
  }
  for (const branch of plan.branches) {
    const bias = weights[`${branch.name}.2.bias`];
    for (let o = 0; o < 4; o++) out.push(o < bias.shape[0] ? bias.values[o] : 0);
  }
  return Float32Array.from(out);
}

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;
precision highp isampler2DArray;
`;

// Where splat i's texels are, in a texture with `${each}` texels for a splat.
const texel = (each) => `ivec2((i % ${PER_ROW(each)}) * ${each}, i / ${PER_ROW(each)})`;
const PER_ROW = (each) => Math.floor(WIDTH / each);
const TABLE_TEXELS = 4;

// What the splat's own numbers contribute to hidden units 4 j .. 4 j + 3.
function ownPart(plan) {
  return `
uniform isampler2DArray latents;
uniform sampler2D ownWeights;
vec4 ownPart(int i, int j, vec4 color, float opacity) {
  vec4 h = texelFetch(ownWeights, ivec2(0, j), 0);
  for (int k = 0; k < 3; k++) h += texelFetch(ownWeights, ivec2(1 + k, j), 0) * color[k];
  h += texelFetch(ownWeights, ivec2(4, j), 0) * opacity;
  for (int l = 0; l < ${plan.latentTexels}; l++) {
    vec4 z = vec4(texelFetch(latents, ivec3(${texel(1)}, l), 0));
    for (int k = 0; k < 4; k++) h += texelFetch(ownWeights, ivec2(5 + 4 * l + k, j), 0) * z[k];
  }
  return h;
}
`;
}

// Four groups at once, `own` their weights.
function keepShader(plan, width) {
  const each = (code) => [0, 1, 2, 3].map((k) => code.replaceAll("#", k).replaceAll("@", k * width)).join("\n");
  return `${HEAD}
uniform sampler2D table;
uniform isampler2DArray latents;
uniform vec4 own[${GROUP * width}];
${each("layout(location = #) out vec4 kept#;")}
void main() {
  int i = int(gl_FragCoord.y) * ${WIDTH} + int(gl_FragCoord.x);
  ivec2 at = ${texel(TABLE_TEXELS)};
  vec4 color = texelFetch(table, at + ivec2(3, 0), 0);
  color.a = 1.0 / (1.0 + exp(-texelFetch(table, at, 0).w));
${each("  vec4 h# = own[@] + mat4(own[@ + 1], own[@ + 2], own[@ + 3], own[@ + 4]) * color;")}
  vec4 z;
${Array.from({ length: plan.latentTexels }, (_, l) => `  z = vec4(texelFetch(latents, ivec3(${texel(1)}, ${l}), 0));
${each(`  h# += mat4(own[@ + ${5 + 4 * l}], own[@ + ${6 + 4 * l}], own[@ + ${7 + 4 * l}], own[@ + ${8 + 4 * l}]) * z;`)}`).join("\n")}
${each("  kept# = h#;")}
}
`;
}

// Colours and opacities of all splats. `kept` says whether `keep` has run, or its part is computed here each time.
function lookShader(plan, header, count, kept) {
  const { config } = plan;
  const number = (x) => (Number.isInteger(x) ? x.toFixed(1) : String(x));
  let offset = 0;
  const branch = ({ name, first, groups, view }, result) => {
    const size = view.length + 4;
    const code = `
    for (int j = 0; j < ${groups}; j++) {
      int o = ${offset} + ${size} * j;
      vec4 h = ${kept ? `texelFetch(kept, ivec3(at, ${first} + j), 0)` : `ownPart(i, ${first} + j, color, base.a)`};
${view.map((input, k) => `      h += w[o + ${k}] * ${input};`).join("\n")}
      h = max(h, 0.0);
      ${result} += mat4(w[o + ${view.length}], w[o + ${view.length + 1}], w[o + ${view.length + 2}], w[o + ${view.length + 3}]) * h;
    }`;
    offset += groups * size;
    return code;
  };
  const [low, high] = plan.branches;
  const size = plan.branches.reduce((sum, { groups, view }) => sum + groups * (view.length + 4) + 1, 0);
  const sum = size - plan.branches.length;
  let waves = "";
  for (let k = 0; k < config.num_bands; k++) {
    const turn = number(Math.PI * 2 ** k);
    waves += `    vec3 sin${k} = sin(${turn} * d), cos${k} = cos(${turn} * d);\n`;
  }
  const bounds = {
    "logit": "1.0 / (1.0 + exp(-(logit + 4.0 * change)))",
    "straight-through": "clamp(base.a + change, 0.0, 1.0)",
  };
  return `${HEAD}
uniform sampler2D table;
${kept ? "uniform sampler2DArray kept;" : ownPart(plan)}
layout(std140) uniform Weights { vec4 w[${size}]; };
uniform vec3 center;
uniform float gain;
uniform int mode;        // 0 full, 1 residual, 2 opacity residual
uniform bool only_seen;  // leave out what the camera does not see
uniform vec4 planes[5];  // see planesOf
out uvec4 look;

void main() {
  int i = int(gl_FragCoord.y) * ${PER_ROW(TABLE_TEXELS)} + int(gl_FragCoord.x);
  if (i >= ${count}) discard;
  ivec2 own = ${texel(TABLE_TEXELS)};
  vec4 place = texelFetch(table, own, 0);
  if (only_seen) {
    vec3 scale = texelFetch(table, own + ivec2(2, 0), 0).xyz;
    float reach = ${number(SIGMAS)} * max(scale.x, max(scale.y, scale.z));
    for (int k = 0; k < 5; k++) if (dot(planes[k].xyz, place.xyz) + planes[k].w < -reach) discard;
  }
  float logit = place.w;
  vec4 color = texelFetch(table, own + ivec2(3, 0), 0);
  vec4 base = vec4(max(color.rgb, 0.0), 1.0 / (1.0 + exp(-logit)));
  vec4 residual = vec4(0.0);  // of the colour before it is cut off at black, and of the opacity
  vec4 seen = base;
  if (gain > 0.0) {
    vec3 v = center - place.xyz;
    float r = max(length(v), ${number(config.distance_eps * header.head.scene_unit)});
    vec3 d = v / r;
    float far = log(r / ${number(header.head.scene_unit)});
${waves}    vec4 low = w[${sum}], high = ${high ? `w[${sum + 1}]` : "vec4(0.0)"};
${kept ? `    ivec2 at = ${texel(1)};` : ""}${branch(low, "low")}${high ? branch(high, "high") : ""}
    vec3 turned = low.rgb${high ? " + high.rgb / (1.0 + exp(-high.a))" : ""};
    residual.rgb = ${number(config.color_scale)} * tanh(clamp(turned, -15.0, 15.0));
    seen.rgb = max(color.rgb + residual.rgb, 0.0);
${config.opacity_residual ? `    float change = ${number(config.opacity_scale)} * tanh(clamp(low.a, -15.0, 15.0));
    seen.a = ${bounds[config.opacity_bound]};
    residual.a = seen.a - base.a;` : ""}
    if (gain != 1.0) {
      seen.rgb = max(base.rgb + gain * (seen.rgb - base.rgb), 0.0);
      seen.a = clamp(base.a + gain * residual.a, 0.0, 1.0);
    }
  }
  if (mode == 1) seen.rgb = 0.5 + AMPLIFICATION * gain * residual.rgb;
  if (mode == 2) seen.rgb = 0.5 + AMPLIFICATION * gain * residual.a * vec3(1.0, 0.0, -1.0);
  look = floatBitsToUint(seen);
}
`.replaceAll("AMPLIFICATION", "4.0");
}
