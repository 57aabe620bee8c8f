// Two trained scenes side by side under one camera: Gaussians are projected, sorted and blended by
// WebGL2 as in xrgs.splat (EWA splatting). OpenCV axes: x right, y down, z forward. viser can't do
// this: its page shows one scene, and needs a policy that lets any script run.
const GAUSSIAN_SHADER = `#version 300 es
precision highp float;
uniform highp sampler2D gaussians;
uniform mat4 view;
uniform vec2 focal, center, size;
uniform float eps2d;
uniform bool compensate;
in uint index;
in vec2 corner;
out vec4 color;
out vec3 conic;
out vec2 offset;
vec4 texel(uint place) {
  int at = int(index * 4u + place);
  return texelFetch(gaussians, ivec2(at % 2048, at / 2048), 0);
}
void main() {
  vec4 mean = texel(0u), first = texel(1u), second = texel(2u);
  color = vec4(texel(3u).rgb, mean.w);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  vec3 t = (view * vec4(mean.xyz, 1.0)).xyz;
  if (t.z < 0.01) return;
  mat3 covariance = mat3(first.x, first.y, first.z, first.y, first.w, second.x, first.z, second.x, second.y);
  // As in gsplat, the slope at which the projection is linearised is clamped.
  vec2 low = -center / focal - 0.15 * size / focal, high = (size - center) / focal + 0.15 * size / focal;
  vec2 slope = clamp(t.xy / t.z, low, high);
  mat3 jacobian = mat3(focal.x / t.z, 0, 0, 0, focal.y / t.z, 0, -focal.x * slope.x / t.z, -focal.y * slope.y / t.z, 0);
  mat3 both = jacobian * mat3(view);
  mat3 projected = both * covariance * transpose(both);
  float xy = projected[1][0], xx = projected[0][0] + eps2d, yy = projected[1][1] + eps2d;
  float determinant = xx * yy - xy * xy;
  if (determinant <= 0.0) return;
  if (compensate) color.a *= sqrt(max(0.0, (projected[0][0] * projected[1][1] - xy * xy) / determinant));
  if (color.a < 1.0 / 255.0) return;
  conic = vec3(yy, -xy, xx) / determinant;
  offset = corner * sqrt(2.0 * log(color.a * 255.0)) * sqrt(vec2(xx, yy));
  vec2 pixel = focal * t.xy / t.z + center + offset;
  gl_Position = vec4(pixel.x / size.x * 2.0 - 1.0, 1.0 - pixel.y / size.y * 2.0, 0.0, 1.0);
}`;
const BLEND_SHADER = `#version 300 es
precision highp float;
in vec4 color;
in vec3 conic;
in vec2 offset;
out vec4 result;
void main() {
  float power = 0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) + conic.y * offset.x * offset.y;
  float alpha = min(0.99, color.a * exp(-power));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;
const LINE_SHADER = `#version 300 es
precision highp float;
uniform mat4 view;
uniform vec2 focal, center, size;
in vec3 position;
in vec3 tint;
out vec3 shade;
void main() {
  vec3 t = (view * vec4(position, 1.0)).xyz;
  shade = tint;
  vec2 pixel = 2.0 * (focal * t.xy + center * t.z) / size - t.z;
  gl_Position = vec4(pixel.x, -pixel.y, t.z - 0.02, t.z);
}`;
const TINT_SHADER = `#version 300 es
precision highp float;
in vec3 shade;
out vec4 result;
void main() { result = vec4(shade, 1.0); }`;
const TINTS = { HR: [1, 0.62, 0.25], LR: [0.34, 0.71, 0.91], test: [0.95, 0.95, 0.95] };
const FRUSTUM = 0.06; // depth of a drawn camera, over its distance from the origin
const WIDTH = 720; // of a canvas, px
const TEXTURE = 2048; // width of the texture, texels; a Gaussian takes four

// Undoes `quantise` of xrgs/viewer/trained.py, and computes the covariances.
function decode(model) {
  const bytes = Uint8Array.from(atob(model.data), (char) => char.charCodeAt(0));
  const numbers = new DataView(bytes.buffer);
  const [least, most] = model.log_scales;
  const rows = Math.ceil((model.count * 4) / TEXTURE);
  const texels = new Float32Array(Math.max(1, rows) * TEXTURE * 4);
  const means = new Float32Array(model.count * 3);
  for (let i = 0; i < model.count; i++) {
    const at = i * 16;
    for (let axis = 0; axis < 3; axis++) {
      const bounded = (numbers.getUint16((i * 3 + axis) * 2, true) / 65535) * 2 - 1;
      means[i * 3 + axis] = texels[at + axis] = bounded / Math.max(1 - Math.abs(bounded), 1e-5);
    }
    const rest = bytes.subarray(model.count * 6 + i * 11, model.count * 6 + i * 11 + 11);
    texels[at + 3] = rest[10] / 255;
    const scales = [0, 1, 2].map((axis) => Math.exp(least + (rest[axis] / 255) * (most - least)));
    texels.set(covariance(scales, [3, 4, 5, 6].map((place) => (rest[place] / 255) * 2 - 1)), at + 4);
    texels.set([rest[7] / 255, rest[8] / 255, rest[9] / 255], at + 12);
  }
  return { texels, rows: Math.max(1, rows), means, order: new Uint32Array(model.count) };
}

// The covariance R S S^T R^T of scales and a quaternion (w, x, y, z): xx, xy, xz, yy, yz, zz.
function covariance(scales, quaternion) {
  const norm = Math.hypot(...quaternion) || 1;
  const [w, x, y, z] = quaternion.map((value) => value / norm);
  const R = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  const entry = (i, j) => scales.reduce((sum, scale, k) => sum + R[i][k] * R[j][k] * scale * scale, 0);
  return [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
}

// Sorts Gaussians from far to near, the order of blending, by a counting sort.
function sortByDepth({ means, order }, view) {
  const count = order.length;
  const depths = new Float32Array(count);
  let least = Infinity;
  let most = -Infinity;
  for (let i = 0; i < count; i++) {
    const depth = view[8] * means[3 * i] + view[9] * means[3 * i + 1] + view[10] * means[3 * i + 2] + view[11];
    // By reciprocal depth, which sorts near Gaussians more finely.
    depths[i] = 1 / Math.max(depth, 0.01);
    least = Math.min(least, depths[i]);
    most = Math.max(most, depths[i]);
  }
  const scale = 65535 / (most - least || 1);
  const starts = new Uint32Array(65537);
  const keys = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    keys[i] = (depths[i] - least) * scale;
    starts[keys[i] + 1]++;
  }
  for (let i = 0; i < 65536; i++) starts[i + 1] += starts[i];
  for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

// One canvas: the Gaussians of a model, and the cameras as lines.
class Panel {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.gaussians = this.setUp(GAUSSIAN_SHADER, BLEND_SHADER, [["corner", 2, 0], ["index", 1, 1]]);
    this.lines = this.setUp(LINE_SHADER, TINT_SHADER, [["position", 3, 0], ["tint", 3, 0]]);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.gaussians.corner);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  }

  // Makes a program with a buffer for each attribute [name, numbers per vertex, divisor].
  setUp(vertex, fragment, attributes) {
    const { gl } = this;
    const made = { program: program(gl, vertex, fragment), array: gl.createVertexArray() };
    gl.bindVertexArray(made.array);
    for (const [name, numbers, divisor] of attributes) {
      const place = gl.getAttribLocation(made.program, name);
      made[name] = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, made[name]);
      gl.enableVertexAttribArray(place);
      if (divisor) gl.vertexAttribIPointer(place, numbers, gl.UNSIGNED_INT, 0, 0);
      else gl.vertexAttribPointer(place, numbers, gl.FLOAT, false, 0, 0);
      gl.vertexAttribDivisor(place, divisor);
    }
    return made;
  }

  load(model, cameras) {
    const { gl } = this;
    this.model = model;
    this.decoded = decode(model);
    const { texels, rows } = this.decoded;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXTURE, rows, 0, gl.RGBA, gl.FLOAT, texels);
    const points = [];
    const tints = [];
    for (const camera of cameras) {
      for (const point of frustum(camera)) {
        points.push(...point);
        tints.push(...TINTS[data.mixed || camera.kind === "test" ? camera.kind : "HR"]);
      }
    }
    this.lineCount = points.length / 3;
    for (const [buffer, values] of [[this.lines.position, points], [this.lines.tint, tints]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
    }
  }

  draw({ view, K, size }, withCameras) {
    const { gl, canvas, decoded } = this;
    canvas.width = WIDTH;
    canvas.height = Math.round((WIDTH * size[1]) / size[0]);
    const scale = WIDTH / size[0];
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    sortByDepth(decoded, view);
    const use = (of) => {
      gl.useProgram(of.program);
      gl.bindVertexArray(of.array);
      const at = (name) => gl.getUniformLocation(of.program, name);
      gl.uniformMatrix4fv(at("view"), true, [...view, 0, 0, 0, 1]);
      gl.uniform2f(at("focal"), K[0] * scale, K[1] * scale);
      gl.uniform2f(at("center"), K[2] * scale, K[3] * scale);
      gl.uniform2f(at("size"), canvas.width, canvas.height);
      return at;
    };
    const at = use(this.gaussians);
    // eps2d is in px^2 of the photographs.
    gl.uniform1f(at("eps2d"), this.model.eps2d * scale * scale);
    gl.uniform1i(at("compensate"), this.model.antialiased ? 1 : 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.gaussians.index);
    gl.bufferData(gl.ARRAY_BUFFER, decoded.order, gl.DYNAMIC_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, decoded.order.length);
    if (!withCameras) return;
    use(this.lines);
    gl.drawArrays(gl.LINES, 0, this.lineCount);
  }
}

// The eight edges of a camera, as pairs of points in the world.
function frustum({ viewmat: V, K, size }) {
  const place = cameraPosition(V);
  const depth = FRUSTUM * (Math.hypot(...place) || 1);
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
    const ray = [((u * size[0] - K[2]) / K[0]) * depth, ((v * size[1] - K[3]) / K[1]) * depth, depth];
    return [0, 1, 2].map((i) => place[i] + V[i] * ray[0] + V[4 + i] * ray[1] + V[8 + i] * ray[2]);
  });
  return corners.flatMap((corner, i) => [place, corner, corner, corners[(i + 1) % 4]]);
}

function cameraPosition(V) {
  return [0, 1, 2].map((i) => -(V[i] * V[3] + V[4 + i] * V[7] + V[8 + i] * V[11]));
}

// Turns a view by two angles (radians) around the point at `distance` in front of the camera.
function orbited(V, right, down, distance) {
  const [c, s, d, e] = [Math.cos(right), Math.sin(right), Math.cos(down), Math.sin(down)];
  const M = [c, 0, s, e * s, d, -e * c, -d * s, e, d * c];
  const column = (j) => [V[j], V[4 + j], V[8 + j] - (j === 3 ? distance : 0)];
  const turned = [...V];
  for (let j = 0; j < 4; j++) {
    const [x, y, z] = column(j);
    for (let i = 0; i < 3; i++) turned[4 * i + j] = M[3 * i] * x + M[3 * i + 1] * y + M[3 * i + 2] * z;
  }
  turned[11] += distance;
  return turned;
}

class Splats {
  constructor(body) {
    this.keys = distinct(data.models.map(runName));
    this.scene = element("select");
    this.look = element("select");
    // Two models side by side, or a single one.
    const places = data.single ? [0] : [0, 1];
    this.sides = places.map(() => element("select"));
    this.frusta = element("input", { type: "checkbox", checked: "" });
    const nearer = element("button", { type: "button" }, "Nearer");
    const farther = element("button", { type: "button" }, "Farther");
    const controls = element("div", { class: "controls" }, labelled("Scene", this.scene), ...this.sides.map((select, place) => labelled(["Left", "Right"][place], select)), labelled("From", this.look), labelled("Cameras", this.frusta), nearer, farther);
    const swatches = (data.mixed ? ["HR", "LR", "test"] : ["HR", "test"]).map((kind) => [kind.toLowerCase(), kindName(kind)]).map(([kind, text]) => element("span", {}, element("i", { class: `swatch ${kind}` }), `${text} camera`));
    this.captions = places.map(() => element("figcaption"));
    const canvases = places.map(() => element("canvas", { tabindex: "0", role: "img" }));
    const figures = canvases.map((canvas, place) => element("figure", {}, canvas, this.captions[place]));
    const note = element("p", { class: "note" }, `Drag or press the arrow keys to turn ${data.single ? "it, with Shift to shift it" : "both, with Shift to shift them"}; + and - or the wheel over a focused picture go nearer and farther. These are not the renders that are scored: only the Gaussians that show most in training views are kept, quantised to 8 and 16 bits, with their mean colour for all directions.`);
    body.append(controls, element("div", { class: "legend" }, ...swatches), element("div", { class: data.single ? "pair single" : "pair" }, ...figures), note);
    this.panels = canvases.map((canvas) => new Panel(canvas));
    fill(this.scene, this.keys.map((key) => [key, key]));
    this.scene.addEventListener("change", () => this.choose());
    this.look.addEventListener("change", () => this.lookFrom());
    this.sides.forEach((select) => select.addEventListener("change", () => this.load()));
    this.frusta.addEventListener("change", () => this.draw());
    nearer.addEventListener("click", () => this.move(0, 0, 0.85));
    farther.addEventListener("click", () => this.move(0, 0, 1 / 0.85));
    canvases.forEach((canvas) => this.listen(canvas));
    onFilter.push(() => this.follow());
    this.choose();
  }

  follow() {
    const key = this.keys.find((one) => data.models.some((model) => runName(model) === one && model.scene === filters.scene));
    if (key && key !== this.scene.value) {
      this.scene.value = key;
      this.choose();
    }
    const place = this.models.findIndex((model) => model.label === filters.label);
    if (place >= 0 && Number(this.sides[1].value) !== place) {
      this.sides[1].value = place;
      this.load();
    }
  }

  choose() {
    this.models = data.models.filter((model) => runName(model) === this.scene.value);
    this.cameras = data.cameras.find((run) => runName(run) === this.scene.value).cameras;
    const options = this.models.map((model, place) => [place, model.label]);
    this.sides.forEach((select, place) => fill(select, options, Math.min(place, options.length - 1)));
    fill(this.look, this.cameras.map((camera, place) => [place, `${kindName(camera.kind)} ${camera.name}`]));
    const test = this.cameras.findIndex((camera) => camera.kind === "test");
    this.look.value = Math.max(0, test);
    this.load();
  }

  load() {
    this.panels.forEach((panel, side) => {
      const model = this.models[Number(this.sides[side].value)];
      panel.load(model, this.cameras);
      const kept = `${model.count.toLocaleString("en")} of ${model.total.toLocaleString("en")} Gaussians, ${(100 * model.share).toFixed(1)} % of the blending weight`;
      this.captions[side].replaceChildren(...(data.single ? [] : [element("b", {}, model.label), " "]), kept);
      panel.canvas.setAttribute("aria-label", `3D view of ${model.label}: ${this.scene.value}. ${kept}. Arrow keys turn it.`);
    });
    if (this.camera) this.draw();
    else this.lookFrom();
  }

  lookFrom() {
    const { viewmat, K, size } = this.cameras[Number(this.look.value)];
    // The cameras of the normalised world look at its origin.
    this.distance = Math.hypot(...cameraPosition(viewmat)) || 1;
    this.camera = { view: viewmat, K, size };
    this.draw();
  }

  draw() {
    cancelAnimationFrame(this.waiting);
    this.waiting = requestAnimationFrame(() => {
      for (const panel of this.panels) panel.draw(this.camera, this.frusta.checked);
    });
  }

  turn(right, down) {
    this.camera = { ...this.camera, view: orbited(this.camera.view, right, down, this.distance) };
    this.draw();
  }

  // Shifts the scene by fractions of the distance, and multiplies the distance by a factor.
  move(right, down, factor) {
    const view = [...this.camera.view];
    view[3] += right * this.distance;
    view[7] += down * this.distance;
    view[11] += (factor - 1) * this.distance;
    this.distance *= factor;
    this.camera = { ...this.camera, view };
    this.draw();
  }

  listen(canvas) {
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      const share = 1 / canvas.clientWidth;
      const [x, y] = [event.movementX * share, event.movementY * share];
      if (event.shiftKey) this.move(x, y, 1);
      else this.turn(2 * x, -2 * y);
    });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      this.move(0, 0, Math.exp(event.deltaY / 1000));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      const zooms = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 };
      const move = moves[event.key];
      if (zooms[event.key]) this.move(0, 0, zooms[event.key]);
      else if (move && event.shiftKey) this.move(0.03 * move[0], 0.03 * move[1], 1);
      else if (move) this.turn(0.05 * move[0], -0.05 * move[1]);
      else return;
      event.preventDefault();
    });
  }
}

// Starts when the section is scrolled into sight, since it keeps the graphics processor busy.
function startSplats() {
  const body = document.getElementById("splats-body");
  if (!body) return;
  if (!data.models.length) {
    body.append(element("p", { class: "warning" }, "This page has no Gaussians; the end of the page says why."));
    return;
  }
  const observer = new IntersectionObserver(([entry]) => {
    if (!entry.isIntersecting) return;
    observer.disconnect();
    try {
      new Splats(body);
    } catch (error) {
      body.append(element("p", { class: "warning" }, `There is no 3D view: ${error.message}.`));
    }
  });
  observer.observe(body);
}
