"""Render an environment's worlds to arrays."""

import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.viz.cameras import CameraChoice, camera_values
from lyceum_warp.viz.renderer import Renderer
from lyceum_warp.viz.video import shots


class WorldPictures(Renderer):
    """Renders the current states of an environment's worlds.

    Args:
        env: The environment.
        camera: The camera, as in ``write_video``.
        size: The width and the height in pixels, both even.
    """

    def __init__(self, env: Env, *, camera: CameraChoice = None, size: tuple[int, int] = (480, 480)) -> None:
        super().__init__(env.model, camera=camera_values(env.model, camera), size=size)
        self.env = env

    def __call__(self) -> list[np.ndarray]:
        """Render a picture of each world, (height, width, 3) uint8. The first call starts the subprocess."""
        if self._process is None:
            self.__enter__()
        pictures = []
        for shot in shots(self.env, self.env.get_state().cpu()):
            self.render(shot)
            pictures.append(self.picture())
        return pictures

    def close(self) -> None:
        """End the subprocess. The next rendering starts a new subprocess."""
        self._stop()
