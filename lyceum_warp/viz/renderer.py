"""Start and control the subprocess that renders a video or pictures."""

import contextlib
import importlib.util
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO, Any, Self

import mujoco
import numpy as np

from lyceum_warp.support.files import replaced
from lyceum_warp.viz.extra import EXTRA, NoVideoError
from lyceum_warp.viz.render import CANNOT_RENDER, PICTURE, VIDEO, Shot

_PATIENCE = 10.0  # seconds that a subprocess gets to end before it is killed


def check_video() -> None:
    """Check that the packages for videos are installed."""
    if missing := [name for name in ("imageio", "imageio_ffmpeg") if importlib.util.find_spec(name) is None]:
        raise NoVideoError(f"videos need {' and '.join(missing)}: {EXTRA}")


def backends() -> list[str]:
    """The values of MUJOCO_GL to try, in order. "" stands for MuJoCo's default."""
    backend = os.environ.get("MUJOCO_GL", "")
    if not sys.platform.startswith("linux"):
        return [backend]
    return list(dict.fromkeys([*filter(None, [backend]), "egl", "osmesa"]))


class Renderer:
    """A context manager for a subprocess that renders states with the first graphics backend that works.

    Args:
        model: The model.
        out: The file that ``finish`` writes: a video (mp4) or, without ``fps``, the last picture (png).
        camera: The attributes of the ``mujoco.MjvCamera``.
        size: The width and the height in pixels, both even.
        fps: The frames per second of a video. None renders pictures.
        background: Whether the subprocess has a low priority.
    """

    def __init__(
        self, model: mujoco.MjModel, out: str | Path | None = None, *, camera: dict[str, Any], size: tuple[int, int],
        fps: float | None = None, background: bool = False,
    ) -> None:  # fmt: skip
        self._model, self._out = model, Path(out or "")
        self.product = "the picture" if fps is None else "the video"
        if len(size) != 2 or any(not isinstance(n, int | np.integer) or n < 2 or n % 2 for n in size):
            raise ValueError(f"size must be two even numbers, the width and the height in pixels, not {size}")
        if fps is not None and (self._out.suffix.lower() != ".mp4" or self._out.is_dir()):
            raise ValueError(f"a video is an mp4 file: give a file's name that ends in .mp4, not {str(out)!r}")
        if out is not None:
            check_video()
        self.size = int(size[0]), int(size[1])
        self._job = {"size": self.size, "fps": fps, "camera": camera, "background": background}
        self._resources = contextlib.ExitStack()
        self._folder: Path
        self._log: IO[str]
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()  # other threads may call `abandon`
        self.abandoned = self._rendered = False

    def __enter__(self) -> Self:
        failures: list[str] = []
        for backend in backends():
            try:
                self._start(backend)
                if self._reply() == "ready":
                    return self
                code, reason = self._end()
            except BaseException:
                self._stop()
                raise
            self._stop()
            failures.append(f"{backend or 'OpenGL'}: {reason}")
            if code > 0 and code != CANNOT_RENDER:  # another backend would fail, too
                raise NoVideoError(f"{self.product} could not be written ({reason})")
        raise NoVideoError(
            f"this machine cannot render off-screen ({'; '.join(failures)}): install Mesa's EGL (on Debian and Ubuntu "
            "libegl1 and libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL to a backend that works"
        )

    def __exit__(self, *exception: object) -> None:
        self._stop()

    def render(self, shot: Shot) -> None:
        """Render a shot."""
        self._rendered = True
        if not self._send(shot) or self._reply() != "frame":
            raise NoVideoError(f"{self.product} could not be written ({self._end()[1]})")

    def picture(self) -> np.ndarray:
        """Return the last picture, (height, width, 3) uint8."""
        return np.fromfile(self._folder / PICTURE, dtype=np.uint8).reshape(self.size[1], self.size[0], 3)

    def abandon(self) -> None:
        """Kill the subprocess, and do not start another one. Any thread may call this method.

        The rendering thread then gets a ``NoVideoError``.
        """
        with self._lock:
            self.abandoned = True
            if self._process is not None:
                _kill(self._process)

    def finish(self) -> Path:
        """Complete the video or the picture, and move it to its path."""
        if not self._rendered:
            raise NoVideoError(f"{self.product} {self._out} has no frame: nothing is written")
        self._send(None)
        code, reason = self._end()
        if code:
            raise NoVideoError(f"{self.product} could not be written ({reason})")
        self._out.parent.mkdir(parents=True, exist_ok=True)
        with replaced(self._out) as temporary:
            if self._job["fps"] is None:
                import imageio.v2 as imageio

                imageio.imwrite(temporary, self.picture(), format="png")
            else:
                shutil.copyfile(self._folder / VIDEO, temporary)
        return self._out

    def _start(self, backend: str) -> None:
        environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
        if backend:
            environment["MUJOCO_GL"] = backend
        folder = tempfile.TemporaryDirectory(prefix="lyceum-warp-", ignore_cleanup_errors=True)
        self._folder = Path(self._resources.enter_context(folder))
        self._log = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115
        self._resources.enter_context(self._log)
        mujoco.mj_saveModel(self._model, str(self._folder / "model.mjb"), None)
        # -P: modules beside render.py must not shadow packages
        command = [sys.executable, "-P", str(Path(__file__).with_name("render.py")), str(self._folder)]
        with self._lock:
            if self.abandoned:
                raise NoVideoError(f"{self.product} was cancelled")
            self._process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log,
                start_new_session=True,  # so that Ctrl-C in the shell reaches only the parent
            )  # fmt: skip
        self._send(self._job)

    def _send(self, message: Any) -> bool:
        assert self._process is not None and self._process.stdin is not None
        try:
            pickle.dump(message, self._process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
        except OSError:
            return False
        return True

    def _reply(self) -> str:
        """Read the next reply of the subprocess, or "" if it has ended."""
        assert self._process is not None and self._process.stdout is not None
        for line in self._process.stdout:
            if line in (b"ready\n", b"frame\n"):  # drivers may print other lines
                return line.decode().strip()
        return ""

    def _end(self) -> tuple[int, str]:
        """Wait for the end of the subprocess, and return its exit code and the last line that it printed."""
        assert self._process is not None
        code = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().strip().splitlines()
        return code, lines[-1].strip()[:160] if lines else f"it ended with code {code}"

    def _stop(self) -> None:
        with self._lock:
            process, self._process = self._process, None
        with self._resources:
            if process is None:
                return
            assert process.stdin is not None and process.stdout is not None
            with contextlib.suppress(OSError):
                process.stdin.close()  # the subprocess ends at EOF
            try:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_PATIENCE)
            finally:
                _kill(process)  # no effect on a process that has ended
                process.wait()
                process.stdout.close()


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
