"""A program that draws states into a video: ``python render.py job.npz model.mjb out.mp4``.

The job holds a row for each frame of ``qpos``, ``mocap_pos``, ``mocap_quat``, and of each model field that differs
between states, as ``model_geom_size``.

MuJoCo chooses its graphics library once, when it is imported, and a driver that fails may end the process. Therefore
``video.py`` runs this file in a process for each library that it tries. The file imports nothing of the package. Exit
code 3 means that this machine cannot draw with this library; the last line on stderr holds the reason.
"""

import sys
from typing import Any

import numpy as np

CANNOT_DRAW = 3

MODEL_FIELD = "model_"
"""What the job's names of model fields begin with."""


def camera(mujoco: Any, model: Any) -> Any:
    """Choose the first tracking camera, else the first one fixed to the world, else one that follows the first body."""
    modes = [int(mode) for mode in model.cam_mode]
    # as numbers, because MuJoCo's enums do not equal NumPy's integers
    tracking = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
    for i, mode in enumerate(modes):
        if mode in tracking:
            return i
    for i, body in enumerate(model.cam_bodyid):
        if body == 0:
            return i
    view = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, view)
    if model.nbody > 1:
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
    return view


def change_model(mujoco: Any, model: Any, rows: dict[str, Any]) -> None:
    """Set fields of a model by their names, and compute what follows from them, such as the poses of cameras."""
    for name, row in rows.items():
        owner = model if hasattr(model, name) else model.opt
        value = getattr(owner, name)
        if isinstance(value, np.ndarray):
            value[...] = row.reshape(value.shape)
        else:
            setattr(owner, name, row.item())
    mujoco.mj_setConst(model, mujoco.MjData(model))


def main(job_path: str, model_path: str, out: str) -> int:
    """Draw one frame for each row of the job."""
    try:
        import mujoco

        model = mujoco.MjModel.from_binary_path(model_path)
        job = np.load(job_path)
        width, height = (int(size) for size in job["size"])
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # of different types, depending on the library
        print(str(error).strip() or type(error).__name__, file=sys.stderr)
        return CANNOT_DRAW
    import imageio.v2 as imageio

    data, view = mujoco.MjData(model), camera(mujoco, model)
    fields = {key.removeprefix(MODEL_FIELD): job[key] for key in job.files if key.startswith(MODEL_FIELD)}
    options: Any = dict(fps=float(job["fps"]), codec="libx264", pixelformat="yuv420p", quality=8, macro_block_size=2)
    writer: Any = imageio.get_writer(out, format="FFMPEG", **options)
    with writer:
        frames = len(job["qpos"])
        for i in range(frames):
            if any(i == 0 or (rows[i] != rows[i - 1]).any() for rows in fields.values()):
                change_model(mujoco, model, {name: rows[i] for name, rows in fields.items()})
            data.qpos[:] = job["qpos"][i]
            if model.nmocap:
                data.mocap_pos[:] = job["mocap_pos"][i].reshape(-1, 3)
                data.mocap_quat[:] = job["mocap_quat"][i].reshape(-1, 4)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, view)
            writer.append_data(renderer.render())
            print(f"frame {i + 1} of {frames}", flush=True)  # video.py reads it
    renderer.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
