#!/usr/bin/env bash
# Version:   @adobe/spz 0.2.3 (npm), Niantic's library for .spz compiled for JavaScript; Node.js 20
# Source:    npm; nianticlabs/spz, src/cc/splat-types.h (`coordinateConverter`) and README.md, "Coordinate System"
# Behaviour: axes are named by the directions of x, y and z. The names of LFD, RFD, LBU and RBU are not what the
#            library turns by: it takes a file with axes RFD as if y pointed back and z up, half a turn about x from
#            the name. The other twelve are as named.
# Guess:     (before the run) a point (1, 2, 3) of a file that names RFD becomes (1, 3, 2) in right, down, forward;
#            one that names RFU becomes (1, -3, 2).
# Seen:      RFD 1 -3 -2
#            RFU 1 -3 2
# Fails if this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
echo '{}' > package.json
npm install --silent --no-audit --no-fund --ignore-scripts @adobe/spz@0.2.3
cat > run.mjs <<'JS'
import create from "./node_modules/@adobe/spz/dist/spz.js";
const spz = await create({ print: () => {}, printErr: () => {} });
const cloud = {
  numPoints: 1, shDegree: 0, antialiased: false, extensions: [], positions: new Float32Array([1, 2, 3]),
  scales: new Float32Array(3), rotations: new Float32Array([0, 0, 0, 1]), alphas: new Float32Array(1),
  colors: new Float32Array(3), sh: new Float32Array(0),
};
const { UNSPECIFIED, RDF, RFD, RFU } = spz.CoordinateSystem;
const valueOf = (axes) => (typeof axes === "number" ? axes : axes.value);
const plain = spz.saveSpzToBuffer(cloud, { version: 4, from: UNSPECIFIED, sh1Bits: 5, shRestBits: 4 });
for (const [name, axes] of Object.entries({ RFD, RFU })) {
  // Version 4: a header of 32 bytes, whose flag 2 says that records follow, and whose offset is that of the table.
  const record = new Uint32Array([0xadbe0003, 4, valueOf(axes)]);
  const named = new Uint8Array(plain.length + 12);
  named.set(plain.slice(0, 32));
  named.set(new Uint8Array(record.buffer), 32);
  named.set(plain.slice(32), 44);
  named[14] |= 2;
  new DataView(named.buffer).setUint32(16, 44, true);
  console.log(name, ...spz.loadSpzFromBuffer(named, { to: RDF }).positions);
}
JS
node run.mjs | tee seen
diff seen <(printf 'RFD 1 -3 -2\nRFU 1 -3 2\n')
