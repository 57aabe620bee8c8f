#!/usr/bin/env bash
# Niantic's .spz library moves a Gaussian that is farther than 2048 units into the scene, or to its other side.
# Version:   @adobe/spz 0.2.3 (npm), Niantic's library for .spz compiled for JavaScript; Node.js 20
# Source:    npm; nianticlabs/spz, src/cc/load-spz.cc: packGaussians has 12 bits for the fraction and writes the low 24
#            bits of a position. Its README says that positions are 24-bit fixed-point numbers.
# Behaviour: a coordinate outside -2048 to 2048 comes back modulo 4096, in versions 2, 3 and 4 of the format, without
#            an error or warning.
# Guess:     (before the run) it is clamped to the border of the range, as scales are, or refused.
# Matters:   sky and background that trained far away, and scenes in metres of a map's projection, come back in front of
#            the cameras: floaters which the .ply does not have.
# Seen:      100 2049 3000 5000 -3000 become 100 -2047 -1096 904 1096
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
echo '{}' > package.json
npm install --silent --no-audit --no-fund --ignore-scripts @adobe/spz@0.2.3
cat > run.mjs <<'JS'
import create from "./node_modules/@adobe/spz/dist/spz.js";
const spz = await create({ print: () => {}, printErr: () => {} });
const written = [100, 2049, 3000, 5000, -3000];
const count = written.length;
const cloud = {
  numPoints: count, shDegree: 0, antialiased: false, extensions: [],
  positions: new Float32Array(written.flatMap((x) => [x, 0, 0])), scales: new Float32Array(3 * count),
  rotations: new Float32Array(written.flatMap(() => [0, 0, 0, 1])), alphas: new Float32Array(count),
  colors: new Float32Array(3 * count), sh: new Float32Array(0),
};
const axes = spz.CoordinateSystem.UNSPECIFIED;
for (const version of [2, 3, 4]) {
  const file = spz.saveSpzToBuffer(cloud, { version, from: axes, sh1Bits: 5, shRestBits: 4 });
  const { positions } = spz.loadSpzFromBuffer(file, { to: axes });
  console.log(...written, "become", ...positions.filter((_, index) => index % 3 === 0));
}
JS
node run.mjs | tee seen
line='100 2049 3000 5000 -3000 become 100 -2047 -1096 904 1096'
diff seen <(printf '%s\n' "$line" "$line" "$line")
