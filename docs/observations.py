"""Find the joints and units of observations by differences, and write them to observations.json.

Run ``python docs/observations.py TASK ...`` after a change of tasks' observations; without names, it does all tasks.
The file spares the site's build from compiling every task.
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import torch

import lyceum_warp as lw
from lyceum_warp.binding import find_task, package_task_names
from lyceum_warp.binding.bound_task import BoundTask

FILE = Path(__file__).with_name("observations.json")
START, STEP = 0.3, 0.4
"""Offset of all positions and velocities, and change of one of them, in m, rad, m/s or rad/s. They are large, so that a
sine is not taken for its angle."""

Sources = dict[str, dict[str, list[str]]]
"""For each group of observations, the joint and the unit of each index that depends on one joint only. The unit is
empty if the observation is another function of the joint, such as its sine."""


def sources(name: str) -> Sources:
    """Return the joints and units of a task's observations."""
    noise = {key: 0.0 for key in BoundTask(find_task(name)).params if key.endswith("_noise")}
    model = lw.make(name, nworld=1).task.model
    nv = model.nv
    env = lw.make(name, nworld=1 + 2 * nv, autoreset=False, **noise)
    env.reset()
    states = env.get_state()[:1].repeat(env.nworld, 1)
    qpos, qvel = env.state_space.parts["qpos"], env.state_space.parts["qvel"]
    start = states[0, qpos].numpy().copy()
    mujoco.mj_integratePos(model, start, np.full(nv, START), 1.0)
    states[:, qpos] = torch.from_numpy(start)
    states[:, qvel] = START
    for dof in range(nv):
        moved, change = start.copy(), np.zeros(nv)
        change[dof] = STEP
        mujoco.mj_integratePos(model, moved, change, 1.0)
        states[1 + dof, qpos] = torch.from_numpy(moved)
        states[1 + nv + dof, qvel.start + dof] += STEP
    env.set_state(states)
    names = [model.joint(joint).name or f"joint {joint}" for joint in model.dof_jntid]
    kinds = ["m" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for kind in model.jnt_type[model.dof_jntid]]
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        first = model.jnt_dofadr[joint]
        for i, axis in enumerate("xyz"):
            kinds[first + i] = "m"
            names[first + i] += f", {axis}"
            names[first + 3 + i] += f", about {axis}"
    indexed: Sources = {}
    for group in env.task.layouts.obs:
        obs = env.get_obs(group=group)
        slopes = (obs[1:] - obs[:1]).double().numpy() / STEP
        changed = np.abs(slopes) > 1e-4
        indexed[group] = {}
        for index in np.flatnonzero(changed.sum(axis=0) == 1):
            row = int(changed[:, index].argmax())
            unit = kinds[row % nv] + ("/s" if row >= nv else "")
            is_value = abs(abs(slopes[row, index]) - 1) < 1e-2
            indexed[group][str(index)] = [names[row % nv], unit if is_value else ""]
    return indexed


if __name__ == "__main__":
    stored: dict[str, Sources] = json.loads(FILE.read_text()) if FILE.exists() else {}
    for task in sys.argv[1:] or package_task_names():
        stored[task] = sources(task)
    FILE.write_text(json.dumps(dict(sorted(stored.items())), separators=(",", ":")).replace('},"', '},\n"') + "\n")
