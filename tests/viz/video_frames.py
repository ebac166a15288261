"""Read videos for tests."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

# in a subprocess, because imageio forks, and this process may be too large for a fork
PROGRAM = """
import json, sys
import imageio.v2 as imageio
with imageio.get_reader(sys.argv[1]) as reader:
    frames = list(reader.iter_data())
    result = {"fps": reader.get_meta_data()["fps"], "shape": frames[0].shape, "frames": len(frames)}
    result["brightest"] = [int(frame.max()) for frame in frames]
    result["red"] = [int((frame[..., 0] > frame[..., 1].astype(int) + 60).sum()) for frame in frames]
    result["columns"] = [
        float((frame[..., 0] > frame[..., 1].astype(int) + 60).nonzero()[1].mean()) if red else None
        for frame, red in zip(frames, result["red"])
    ]
    print(json.dumps(result))
"""


def read(path: Path) -> dict[str, Any]:
    """Return a video's rate, shape and number of frames, and each frame's brightest and red pixels."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(path)], capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))
