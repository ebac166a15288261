"""MPPI of judo on our cartpole: the same model file, and the same reward as a judo task states it.

Reads one JSON object: model, starts (qpos and qvel of each episode), steps, samples, horizon (steps), knots, noise,
temperature, seed. Prints one: the median time of a plan in milliseconds, and the return of each episode.
"""

import json
import statistics
import sys
import time

import judo.tasks.base
import mujoco
import numpy as np
from judo.app.structs import MujocoState
from judo.controller.controller import Controller, ControllerConfig
from judo.optimizers.mppi import MPPI, MPPIConfig

# every task of judo downloads the meshes of all tasks, and this one has none
judo.tasks.base.download_and_extract_meshes = lambda *args, **words: None


def near_zero(x: np.ndarray, margin: float, value_at_margin: float) -> np.ndarray:
    """dm_control's tolerance with a quadratic sigmoid around 0."""
    return np.maximum(1.0 - (1.0 - value_at_margin) * (x / margin) ** 2, 0.0)


def rewards(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Rewards of lyceum_warp's cartpole_swingup: states (..., 4) after the controls (..., 1)."""
    upright = (1.0 + np.cos(states[..., 1])) / 2.0
    centred = (1.0 + near_zero(states[..., 0], 2.0, 0.1)) / 2.0
    small_control = (4.0 + near_zero(controls[..., 0], 1.0, 0.0)) / 5.0
    small_velocity = (1.0 + near_zero(states[..., 3], 5.0, 0.1)) / 2.0
    return upright * centred * small_control * small_velocity


class Swingup(judo.tasks.base.Task):
    """Our task for judo."""

    name = "lyceum_swingup"
    config_t = judo.tasks.base.TaskConfig

    def reward(self, states, sensors, controls, system_metadata=None):
        return rewards(states, controls).sum(-1)


def main(options: dict) -> dict:
    np.random.seed(options["seed"])
    task = Swingup(model_path=options["model"])
    # knots at both ends of the horizon: one more than intervals
    optimizer = MPPI(
        MPPIConfig(num_rollouts=options["samples"], num_nodes=options["knots"] + 1, use_noise_ramp=False,
                   sigma=options["noise"], temperature=options["temperature"]),
        task.nu,
    )  # fmt: skip
    settings = ControllerConfig(horizon=options["horizon"] * task.dt, spline_order="linear", max_opt_iters=1)
    controller = Controller(settings, task, optimizer)
    assert controller.num_timesteps == options["horizon"], controller.num_timesteps
    data, times, returns = mujoco.MjData(task.model), [], []
    for start in options["starts"]:
        mujoco.mj_resetData(task.model, data)
        data.qpos[:], data.qvel[:] = start["qpos"], start["qvel"]
        mujoco.mj_forward(task.model, data)
        controller.time = 0.0
        controller.reset()
        total = 0.0
        for _ in range(options["steps"]):
            state = MujocoState(data.time, data.qpos, data.qvel, data.xpos, data.xquat, data.mocap_pos,
                                data.mocap_quat, {})  # fmt: skip
            began = time.perf_counter()
            controller.update_states(state)
            controller.update_action()
            action = np.clip(controller.action(data.time), -1.0, 1.0)
            times.append(time.perf_counter() - began)
            data.ctrl[:] = action
            mujoco.mj_step(task.model, data)
            total += float(rewards(np.concatenate([data.qpos, data.qvel]), action))
        returns.append(round(total, 4))
    return {"plan_ms": 1e3 * statistics.median(times[5:]), "returns": returns}


if __name__ == "__main__":
    print(json.dumps(main(json.load(sys.stdin))))
