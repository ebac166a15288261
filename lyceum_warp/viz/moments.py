"""Draw the moment at which a policy was farthest from each clip."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lyceum_warp.algos import ClipResults
from lyceum_warp.env import Env
from lyceum_warp.viz.cameras import CameraChoice, FreeCamera, camera_values
from lyceum_warp.viz.render import Shot
from lyceum_warp.viz.renderer import Renderer
from lyceum_warp.viz.style import new_figure, save_figure
from lyceum_warp.viz.video import shots


def draw_moments(
    env: Env, names: Sequence[str], results: ClipResults, out: str | Path, *, camera: CameraChoice = None
) -> Path:
    """Draw the worst moment of each clip as one PNG file, with the reference as a transparent robot.

    Args:
        env: An environment of the results' task and physics.
        names: The names of the clips.
        results: The results of ``evaluate_clips``.
        out: The file.
        camera: The camera, as in ``write_video``. By default, the robot and its reference are in the picture.
    """
    columns = min(4, len(names))
    figure = new_figure("the worst moments", 3.0 * columns, 3.6 * math.ceil(len(names) / columns))
    all_axes = figure.subplots(math.ceil(len(names) / columns), columns, squeeze=False).ravel()
    for axes in all_axes:
        axes.set_axis_off()
    with Renderer(env.model, camera=camera_values(env.model, camera), size=(480, 480)) as renderer:
        for i, shot in enumerate(shots(env, results.worst_states)):
            renderer.render(shot if camera is not None else _seen_together(env, shot))
            all_axes[i].imshow(renderer.picture())
            end = f", failed at {results.tracked[i]:.2f} s" if results.failed[i] else ""
            all_axes[i].set_title(f"{names[i]}\n{results.worst[i]:.2f} s{end}", fontsize=9)
    return save_figure(figure, out)


def _seen_together(env: Env, shot: Shot) -> Shot:
    """Aim the camera of a shot between the robot and its ghost, from where both are visible."""
    base = slice(env.state_space.parts["qpos"].start, env.state_space.parts["qpos"].start + 3)
    points = np.stack([shot["state"][base], *(pose[base] for pose, _, _ in shot["ghosts"])])
    distance = 1.5 * env.model.stat.extent + 1.5 * float(np.linalg.norm(points[-1] - points[0]))
    lookat = FreeCamera(lookat=tuple(points.mean(axis=0).tolist()), distance=distance, elevation=-20.0)
    return {**shot, "view": camera_values(env.model, lookat)}
