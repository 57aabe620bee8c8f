#!/usr/bin/env bash
# magick-wasm's compare with ErrorMetric.StructuralSimilarity gives the dissimilarity, and its PSNR is not in dB.
# Version:   @imagemagick/magick-wasm 0.0.43 (npm), ImageMagick 7.1.2-30; Node 20. In 0.0.35, ImageMagick 7.1.1-48, SSIM
#            is SSIM.
# Source:    the package's MagickImage.compare and ErrorMetric; ImageMagick, MagickCore/compare.c: GetImageDistortion
#            turns the similarity of 7.1.2 into a distortion. The types name no unit and no direction.
# Behaviour: StructuralSimilarity is (1 - SSIM) / 2, the same number as StructuralDissimilarity: 0 for equal pictures.
#            PeakSignalToNoiseRatio is PSNR / 120, and 1 for equal pictures.
# Guess:     (before the run) the SSIM of Wang et al. to 0.005, and 10 log10(1 / MSE).
# Matters:   an update of the package turns a ranking by SSIM upside down: the worst view has the largest value. Each
#            value is still between 0 and 1.
# Seen:      grey 100 and 120: 0.0082 for an SSIM of 0.9836, 0.184 for 22.11 dB; 100 and 200: 0.1000 for 0.8000
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
echo '{}' > package.json
npm install --silent --no-audit --no-fund --ignore-scripts @imagemagick/magick-wasm@0.0.43 > log 2>&1 ||
  { cat log; exit 1; }
cat > compare.mjs <<'JS'
import fs from "fs";
import * as magick from "@imagemagick/magick-wasm";

await magick.initializeImageMagick(fs.readFileSync("node_modules/@imagemagick/magick-wasm/dist/x86/magick.wasm"));
const side = 64;
function grey(level) {
  const settings = { format: magick.MagickFormat.Gray, width: side, height: side, depth: 8 };
  const picture = magick.MagickImage.create();
  picture.read(new Uint8Array(side * side).fill(level), new magick.MagickReadSettings(settings));
  return picture;
}
let same = true;
for (const [first, second] of [[100, 100], [100, 120], [100, 200]]) {
  const metric = (name) => grey(first).compare(grey(second), magick.ErrorMetric[name]);
  // Flat pictures have no variance: this is their SSIM.
  const constant = (0.01 * 255) ** 2;
  const ssim = (2 * first * second + constant) / (first ** 2 + second ** 2 + constant);
  const psnr = Math.min(120, 20 * Math.log10(255 / Math.abs(first - second)));
  const seen = metric("StructuralSimilarity"), peak = metric("PeakSignalToNoiseRatio");
  const text = [`${seen.toFixed(4)} for an SSIM of ${ssim.toFixed(4)}`, `${peak.toFixed(3)} for ${psnr.toFixed(2)} dB`];
  console.log(first, second, text.join(", "));
  same &&= Math.abs(seen - (1 - ssim) / 2) < 1e-4 && seen === metric("StructuralDissimilarity");
  same &&= Math.abs(peak - psnr / 120) < 1e-3;
}
process.exit(same ? 0 : 1);
JS
node compare.mjs
