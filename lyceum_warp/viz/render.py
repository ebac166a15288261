"""Render states as a video or as single pictures: ``python render.py folder``.

``renderer.py`` runs this program as a subprocess. It writes pickled objects to the program's stdin: a dict with
``size``, ``fps``, ``camera`` and ``background``, then a ``Shot`` for each picture, and None at the end. If stdin closes
before None arrives, the parent process has died. The folder holds the model, ``model.mjb``. The program writes
``video.mp4``. If ``fps`` is None, it writes each picture to ``picture.raw`` instead. The program prints "ready" once it
can render, and "frame" after each picture.

MuJoCo chooses its graphics backend when it is imported, and a failing driver may end the process. ``renderer.py``
therefore starts a process for each backend that it tries. Exit code 3 means that the machine cannot render with this
backend. The last line on stderr then holds the reason. The program imports no module of the package.
"""

import contextlib
import itertools
import os
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

CANNOT_RENDER = 3
ABANDONED = 4

VIDEO, PICTURE = "video.mp4", "picture.raw"
"""A picture has the shape (height, width, 3) and the type uint8."""


class Shot(TypedDict):
    """The content of one or several successive frames."""

    state: np.ndarray
    """The integration state (``mjSTATE_INTEGRATION``)."""
    model_fields: dict[str, np.ndarray]
    """Values of model fields by name. Every shot has the same fields."""
    ghosts: list[tuple[np.ndarray, tuple[float, ...] | None, tuple[float, float]]]
    """Further states, each with a colour (None for the model's colours) and a shift in x and y."""
    lines: list[tuple[np.ndarray, tuple[float, ...], float]]
    """Lines, each as points (points, 3), a colour and a width in pixels."""
    frames: int
    view: NotRequired[dict[str, Any]]
    """Attributes of the ``MjvCamera`` from this shot on, if they change."""


class Painter:
    """Renders states of a model."""

    def __init__(self, mujoco: Any, model: Any, size: tuple[int, int], camera: dict[str, Any]) -> None:
        self.mujoco, self.model = mujoco, model
        width, height = size
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        # a finer shadow map would look the same, but without a GPU, it would take half of a frame's time
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 2 * max(size))
        self.renderer = mujoco.Renderer(model, height, width)
        self.data, self.ghost = mujoco.MjData(model), mujoco.MjData(model)
        self.view, self.option, self.perturb = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
        self._look(camera)
        self._fields: dict[str, np.ndarray] = {}

    def render(self, shot: Shot) -> np.ndarray:
        """Render one frame, (height, width, 3) uint8."""
        if any(not np.array_equal(value, self._fields.get(name, ())) for name, value in shot["model_fields"].items()):
            self._fields = shot["model_fields"]
            change_model(self.mujoco, self.model, self._fields)
        self._look(shot.get("view", {}))
        self._place(self.data, shot["state"])
        self.renderer.update_scene(self.data, self.view, self.option)
        scene = self.renderer.scene
        for state, colour, shift in shot["ghosts"]:
            self._place(self.ghost, state)
            first = scene.ngeom
            moving = int(self.mujoco.mjtCatBit.mjCAT_DYNAMIC)
            self.mujoco.mjv_addGeoms(self.model, self.ghost, self.option, self.perturb, moving, scene)
            for geom in scene.geoms[first : scene.ngeom]:
                geom.pos[:2] += shift
                if colour is not None:
                    geom.rgba[:], geom.matid, geom.transparent = colour, -1, 1
        for points, paint, width in shot["lines"]:
            self._add_line(scene, points, paint, width)
        image: np.ndarray = self.renderer.render()
        return image

    def _look(self, camera: dict[str, Any]) -> None:
        for name, value in camera.items():
            setattr(self.view, name, value)

    def _place(self, data: Any, state: np.ndarray) -> None:
        self.mujoco.mj_setState(self.model, data, state, self.mujoco.mjtState.mjSTATE_INTEGRATION)
        self.mujoco.mj_forward(self.model, data)

    def _add_line(self, scene: Any, points: np.ndarray, colour: tuple[float, ...], width: float) -> None:
        kind = int(self.mujoco.mjtGeom.mjGEOM_LINE)
        for start, end in itertools.pairwise(points):
            if scene.ngeom == scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            rgba = np.array(colour, dtype=np.float32)
            self.mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
            self.mujoco.mjv_connector(geom, kind, width, start, end)
            scene.ngeom += 1


def change_model(mujoco: Any, model: Any, rows: dict[str, Any]) -> None:
    """Set fields of a model by name, and recompute derived constants, such as the poses of cameras."""
    for name, row in rows.items():
        owner = owner_of(model, name)
        setattr(owner, name, np.reshape(row, np.shape(getattr(owner, name))))
    mujoco.mj_setConst(model, mujoco.MjData(model))


def owner_of(model: Any, name: str) -> Any:
    """Return the object that has a field of a model: the model or its options."""
    return model if hasattr(model, name) else model.opt


def main(folder: str) -> int:
    """Render the shots that arrive on stdin, and return the exit code."""
    source = sys.stdin.buffer
    try:
        import mujoco

        job = pickle.load(source)
        if job["background"]:
            os.nice(10)
        model = mujoco.MjModel.from_binary_path(str(Path(folder, "model.mjb")))
        painter = Painter(mujoco, model, job["size"], job["camera"])
        painter.renderer.update_scene(painter.data, painter.view)
        painter.renderer.render()  # some drivers fail only when they render
    except Exception as error:  # the type of the error depends on the backend
        print(str(error).strip() or type(error).__name__, file=sys.stderr)
        return CANNOT_RENDER
    try:
        with contextlib.nullcontext() if job["fps"] is None else _video(Path(folder, VIDEO), job) as writer:
            print("ready", flush=True)
            while (shot := pickle.load(source)) is not None:
                image = painter.render(shot)
                if writer is None:
                    Path(folder, PICTURE).write_bytes(image.tobytes())
                else:
                    for _ in range(shot["frames"]):
                        writer.append_data(image)
                print("frame", flush=True)
    except (EOFError, pickle.UnpicklingError):
        shutil.rmtree(folder, ignore_errors=True)
        return ABANDONED
    painter.renderer.close()
    return 0


def _video(path: Path, job: dict[str, Any]) -> Any:
    import imageio.v2 as imageio

    options: Any = dict(fps=float(job["fps"]), codec="libx264", pixelformat="yuv420p", quality=8, macro_block_size=2)
    return imageio.get_writer(str(path), format="FFMPEG", **options)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
