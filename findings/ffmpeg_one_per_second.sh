#!/usr/bin/env bash
# ffmpeg's picture n of one per second is not that of second n.
# Version:   imageio-ffmpeg 0.8.1, whose wheel has ffmpeg 9.0.2
# Source:    ffmpeg libavfilter/vf_fps.c: time stamps are rounded to the nearest second by default, and a frame is
#            dropped while the next one has a stamp that is not later: of the frames with one stamp the last is kept.
#            `-r 1` drops and repeats frames right before the encoder, as the documentation says, by
#            another rule: video_sync_process in fftools/ffmpeg_filter.c.
# Behaviour: `-vf fps=1` gives the frame of n + 0.5 s. `-r 1` gives two neighbouring frames at the start, and
#            later ones of n - 1.1 s. `fps=1:round=up` gives the frame of n s.
# Guess:     (before the run) the frame that is nearest to n s.
# Matters:   frames that are paired with GPS, an IMU or another camera by their number are half a period off: 5 m for a
#            drone at 10 m/s. By -r, the first pair has nearly no baseline.
# Seen:      30 frames per second, fps=1: 14 44 74 104; -r 1: 0 1 26 56; fps=1:round=up: 0 30 60 90
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile imageio-ffmpeg==0.8.1 numpy==2.4.6
"$work/bin/python" - "$work/video.mkv" <<'PY'
import subprocess
import sys
import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe

video = sys.argv[1]
tool = [get_ffmpeg_exe(), "-loglevel", "error"]
frames = np.broadcast_to(np.arange(150, dtype=np.uint8)[:, None, None], (150, 16, 16))  # grey: the frame's number
raw = ["-f", "rawvideo", "-pix_fmt", "gray", "-s", "16x16", "-r", "30", "-i", "-"]
subprocess.run([*tool, *raw, "-c:v", "ffv1", video], input=frames.tobytes(), check=True)

def numbers(*options):
    command = [*tool, "-i", video, *options, "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    pixels = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8)
    return pixels.reshape(-1, 16, 16)[:4, 0, 0].tolist()

seen = numbers("-vf", "fps=1"), numbers("-r", "1"), numbers("-vf", "fps=1:round=up")
print("fps=1:", *seen[0], " -r 1:", *seen[1], " fps=1:round=up:", *seen[2])
sys.exit(seen != ([14, 44, 74, 104], [0, 1, 26, 56], [0, 30, 60, 90]))
PY
