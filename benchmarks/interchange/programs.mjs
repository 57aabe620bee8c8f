// As programs.py, for programs of npm: `node programs.mjs read|write PROGRAM FILE OUT`, run in the
// folder with node_modules. For @adobe/spz a last word names the axes to read to, such as RDF.
import { execFileSync } from "node:child_process";
import { readFileSync, writeFileSync } from "node:fs";
import { basename, extname, resolve } from "node:path";
import { pathToFileURL } from "node:url";

const inModules = (path) => resolve("node_modules", path);
const load = (path) => import(pathToFileURL(path));
const logistic = (value) => 1 / (1 + Math.exp(-value));
const rows = (values, width) =>
  Array.from({ length: values.length / width }, (_, i) => Array.from(values.slice(i * width, (i + 1) * width)));
const buffer = (file) => {
  const content = readFileSync(file);
  return content.buffer.slice(content.byteOffset, content.byteOffset + content.byteLength);
};

/** Converts a GaussianCloud of Niantic's library or spz-js: logits, log scales, quaternions xyzw. */
function cloud(data) {
  if (!data.numPoints) throw new Error("reads no Gaussians");
  return {
    means: rows(data.positions, 3),
    quats: rows(data.rotations, 4).map(([x, y, z, w]) => [w, x, y, z]),
    scales: rows(data.scales.map(Math.exp), 3),
    opacities: Array.from(data.alphas, logistic),
    sh0: rows(data.colors, 3),
    shN: rows(data.sh, data.sh.length / data.numPoints).map((row) => rows(row, 3)),
  };
}

/** Converts a geometry of three's GaussianSplat: covariances, 8-bit colours, 8-bit harmonics. */
function geometry(object, matrix) {
  const count = object.getAttribute("position").count;
  const color = object.getAttribute("color").array;
  const bands = [1, 2, 3].map((degree) => {
    const packed = object.getAttribute(`sphericalHarmonics${degree}`).array;
    return { bytes: new Uint8Array(packed.buffer), stride: (packed.length / count) * 4, of: 2 * degree + 1 };
  });
  if (matrix && !matrix.elements.every((value, i) => value === (i % 5 === 0 ? 1 : 0))) throw new Error("turned node");
  return {
    means: rows(object.getAttribute("position").array, 3),
    covariances: rows(object.getAttribute("covariance").array, 6),
    opacities: rows(color, 4).map((row) => row[3] / 255),
    colors: rows(color, 4).map((row) => row.slice(0, 3).map((value) => value / 255)),
    shN: Array.from({ length: count }, (_, i) =>
      bands.flatMap(({ bytes, stride, of }) =>
        rows(bytes.slice(i * stride, i * stride + 3 * of), 3).map((row) => row.map((value) => (value - 128) / 128)),
      ),
    ),
  };
}

async function adobe() {
  const { default: create } = await load(inModules("@adobe/spz/dist/spz.js"));
  return create({ print: () => {}, printErr: () => {} });
}

const readers = {
  "@adobe/spz": async (file, to = "UNSPECIFIED") => {
    const spz = await adobe();
    return cloud(spz.loadSpzFromBuffer(readFileSync(file), { to: spz.CoordinateSystem[to] }));
  },
  "spz-js": async (file) => {
    const { loadPly, loadSpz } = await load(inModules("spz-js/dist/index.js"));
    if (extname(file) === ".spz") return cloud(await loadSpz(readFileSync(file)));
    return cloud(await loadPly(new Blob([readFileSync(file)]).stream()));
  },
  three: async (file) => {
    const loader = (name) => load(inModules(`three/examples/jsm/loaders/${name}.js`));
    if (extname(file) === ".spz") return geometry(await new (await loader("SPZLoader")).SPZLoader().parse(buffer(file)));
    if (extname(file) === ".ply") {
      return geometry(new (await loader("GaussianSplatPLYLoader")).GaussianSplatPLYLoader().parse(buffer(file)));
    }
    globalThis.self = globalThis;
    const { GLTFLoader } = await loader("GLTFLoader");
    const { GLTFGaussianSplatLoaderExtension } = await loader("GLTFGaussianSplatLoaderExtension");
    const gltf = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const { scene } = await gltf.parseAsync(buffer(file), "");
    scene.updateMatrixWorld(true);
    let found;
    scene.traverse((object) => {
      if (object.isGaussianSplat) found = object;
    });
    return geometry(found.splatGeometry, found.matrixWorld);
  },
};

/** Converts a .ply; with @adobe/spz, a .spz to the version in the name of `out`, as in `a.2.spz`. */
async function write(program, file, out) {
  if (program === "@adobe/spz") {
    const spz = await adobe();
    const asItIs = spz.CoordinateSystem.UNSPECIFIED;
    const data = spz.loadSpzFromBuffer(readFileSync(file), { to: asItIs });
    const version = Number(basename(out).split(".").at(-2));
    writeFileSync(out, spz.saveSpzToBuffer(data, { version, sh1Bits: 8, shRestBits: 8, from: asItIs }));
    return;
  }
  if (program === "splat-transform") {
    execFileSync(inModules(".bin/splat-transform"), ["-q", "-w", file, out]);
    return;
  }
  if (program !== "spz-js") throw new Error(`${program} is only read with`);
  const { loadPly, serializeSpz } = await load(inModules("spz-js/dist/index.js"));
  writeFileSync(out, await serializeSpz(await loadPly(new Blob([readFileSync(file)]).stream())));
}

const [action, program, file, out, axes] = process.argv.slice(2);
if (action === "write") await write(program, file, out);
else writeFileSync(out, JSON.stringify(await readers[program](file, axes)));
