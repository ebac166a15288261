"""Load clips for a task, and print how well a policy follows each of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp import algos, binding, core, motions, viz
from lyceum_warp.cli.display import console, say, table, tried
from lyceum_warp.engines import options_on_cores
from lyceum_warp.env import Env, Policy
from lyceum_warp.support.long_work import LongWork

_COLUMNS = {
    "mpkpe": ("MPKPE, mm", 1000.0), "r_mpkpe": ("R-MPKPE, mm", 1000.0),
    "joint_position_error": ("joints, rad", 1.0), "joint_velocity_error": ("joints, rad/s", 1.0),
    "end_position_error": ("ends, mm", 1000.0), "end_rotation_error": ("ends, rad", 1.0),
}  # fmt: skip
"""The heading and the factor of each error."""


def clips_of_task(files: Sequence[Path], task: str, options: core.EnvOptions) -> motions.Clips:
    """Load clips at the rate of a task."""
    definition = binding.find_task(task)
    physics = options.physics.resolved(definition.physics)
    bound = binding.BoundTask(definition, model=options.model, physics=physics)
    clips = motions.load_clips(files, bound.model, rate=1.0 / bound.timestep, device=options.device or "cpu")
    say(f"{len(clips)} clips, {clips.seconds:.6g} s: {', '.join(clips.names)}")
    return clips


def print_clips(
    env: Env,
    policy: Policy,
    files: Sequence[Path],
    names: Sequence[str] = (),
    picture: Path | None = None,
    camera: viz.CameraChoice = None,
) -> None:
    """Play clips on the C engine under exact physics, and in the environment's own simulation, and print the errors.

    Args:
        env: An environment of a tracking task.
        policy: The policy.
        files: Files or folders of motions. By default, the environment's clips are played.
        names: Names of the environment's clips.
        picture: Path of a picture of the worst moments.
        camera: Camera of the picture.
    """
    changes: dict[str, Any] = {}
    if files:
        changes["clips"] = clips = motions.load_clips(
            files, env.model, rate=1.0 / env.timestep, device=env.device.alias
        )
        names = clips.names
    exact = env.replicate(nworld=1, **options_on_cores(), physics=algos.EXACT)
    for worlds in (exact, env) if algos.simulation(exact) != algos.simulation(env) else (exact,):
        with LongWork("playing the clips", "steps", console) as work:
            results = algos.evaluate_clips(worlds, policy, progress=work, **changes)
        names = names or tuple(f"clip {i}" for i in range(len(results.failed)))
        say(f"{env.task.name}: {results.failures} of {len(names)} clips failed on the {algos.simulation(worlds)}")
        console.print(table(_columns(names, results)))
        if worlds is exact and picture is not None:
            say(f"worst moments: {tried(viz.draw_moments, exact, names, results, picture, camera=camera)}")


def _columns(names: Sequence[str], results: algos.ClipResults) -> dict[str, Sequence[str]]:
    """Make the columns of a table with a row for each clip, and a row for all."""
    fails = np.where(results.failed, [f"{at:.2f} s" for at in results.tracked.tolist()], "")
    columns: dict[str, Sequence[str]] = {
        "": [*names, "all"],
        "seconds": [f"{seconds:.2f}" for seconds in (*results.seconds.tolist(), results.seconds.sum().item())],
        "failed at": [*fails.tolist(), f"{results.failures} of {len(names)}"],
    }
    numbers = {"score": (results.scores, 1.0), "return": (results.returns, 1.0)}
    numbers |= {heading: (results.errors[name], factor) for name, (heading, factor) in _COLUMNS.items()}
    for heading, (values, factor) in numbers.items():
        columns[heading] = [f"{factor * value:.3g}" for value in (*values.tolist(), values.mean().item())]
    return columns
