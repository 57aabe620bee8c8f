#!/usr/bin/env bash
# ffmpeg and imageio give the frames of a video of variable frame rate several times.
# Version:   imageio-ffmpeg 0.8.1, whose wheel has ffmpeg 9.0.2; imageio 2.38.1; PyAV 18.1.0
# Source:    ffmpeg documentation, -fps_mode: the default, auto, is cfr or vfr by what the output format can hold, and
#            cfr duplicates and drops frames for a constant rate. Numbered pictures and raw frames in a pipe, from
#            which imageio reads, are such formats.
# Behaviour: the rate is the base rate of the stream (libavformat/avformat.h, r_frame_rate), in which all its times
#            fit: 120 per second for frames of 1/30 s and 1/24 s. `-fps_mode passthrough` gives each frame once, and so
#            does PyAV.
# Guess:     (before the run) each frame once, none missing.
# Matters:   phones lower their rate in the dark. The pictures of a scan are then copies of each other: held-out views
#            are in the training set too, structure from motion has pairs without a baseline, and picture n is not
#            frame n.
# Seen:      35 frames of 1/30 s and 35 of 1/24 s: 314 pictures by ffmpeg, 314 by imageio, 70 by passthrough and PyAV;
#            35 of 1/30 s and 35 of 1/20 s: 174
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile imageio-ffmpeg==0.8.1 imageio==2.38.1 av==18.1.0 numpy==2.4.6
venv/bin/python - <<'PY'
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
import av
import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np

CLOCK = 90000
def write(path, times):
    """Write a grey frame of its own level at each time."""
    with av.open(path, "w") as video:
        stream = video.add_stream("libx264", rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, CLOCK)
        for number, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 + 3 * number, np.uint8), format="rgb24")
            frame.pts, frame.time_base = round(time * CLOCK), Fraction(1, CLOCK)
            video.mux(stream.encode(frame))
        video.mux(stream.encode())

def extracted(path, *options):
    for old in Path().glob("*.png"):
        old.unlink()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", path, *options, "%04d.png"]
    subprocess.run(command, check=True)
    return len(list(Path().glob("*.png")))

wrong = right = True
for slow in (24, 20):
    path = f"{slow}.mp4"
    write(path, np.cumsum([0] + [1 / 30] * 35 + [1 / slow] * 34))
    seen = extracted(path), sum(1 for _ in iio.imiter(path, plugin="FFMPEG"))
    once = extracted(path, "-fps_mode", "passthrough"), sum(1 for _ in iio.imiter(path, plugin="pyav"))
    print(f"70 frames at 30 and {slow} per second: ffmpeg {seen[0]}, imageio {seen[1]}", end="; ")
    print(f"passthrough {once[0]}, PyAV {once[1]}")
    wrong &= min(seen) > 140
    right &= once == (70, 70)
sys.exit(not (wrong and right))
PY
