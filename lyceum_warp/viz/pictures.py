"""Pictures of an environment's worlds, as arrays."""

from pathlib import Path

import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.cameras import CameraChoice
from lyceum_warp.viz.drawing import DrawingProcess
from lyceum_warp.viz.render import PICTURE, Shot
from lyceum_warp.viz.video import shots


class Pictures(DrawingProcess):
    """A process that draws poses as arrays, with the first graphics library that works; a context.

    The arguments and errors are those of ``DrawingProcess``, without ``fps``.
    """

    product = "the picture"

    def draw(self, shot: Shot) -> np.ndarray:
        """Draw a pose, (height, width, 3) uint8.

        Raises:
            NoVideoError: The process has ended.
        """
        if not self._send(shot) or self._answer() != "frame":
            raise NoVideoError(f"{self.product} could not be drawn ({self._ended()[1]})")
        width, height = self.size
        return np.fromfile(Path(self._folder, PICTURE), dtype=np.uint8).reshape(height, width, 3)


class WorldPictures:
    """Draws the worlds of an environment as they are now.

    Args:
        env: The environment.
        camera: The camera, as in ``write_video``.
        size: Width and height in pixels, even numbers.

    Raises:
        ValueError: The model has no such camera, or the size is odd.
    """

    def __init__(self, env: Env, *, camera: CameraChoice = None, size: tuple[int, int] = (480, 480)) -> None:
        self.env = env
        self._drawing = Pictures(env.model, camera=camera, size=size, fps=None)
        self._open = False

    def __call__(self) -> list[np.ndarray]:
        """A picture of each world, (height, width, 3) uint8; the first call starts the process.

        Raises:
            NoVideoError: The machine cannot draw.
        """
        if not self._open:
            self._drawing.__enter__()
            self._open = True
        return [self._drawing.draw(shot) for shot in shots(self.env, self.env.get_state().cpu())]

    def close(self) -> None:
        """End the process; a later call starts another one."""
        if self._open:
            self._open = False
            self._drawing.__exit__()
