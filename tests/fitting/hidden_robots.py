"""Make logs of robots whose parameters are known, as of a hidden robot."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.fitting.parameters import Parameter, Parameters

ARM = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping=".3" armature=".02" range="-3 3"/>
<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4"/><body name="lower" pos="0 0 -.4">
<joint name="elbow" axis="0 1 0" damping=".2" armature=".01" range="-3 3"/>
<geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.3"/></body></body></worldbody>
<actuator><position name="shoulder" joint="shoulder" kp="30" kv="1" forcerange="-20 20"/>
<position name="elbow" joint="elbow" kp="15" kv=".5" forcerange="-10 10"/></actuator></mujoco>"""

HOPPING = """<mujoco model="hopping"><option timestep="0.005" integrator="implicitfast" cone="elliptic"/>
<worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="body" pos="0 0 .3">
<freejoint name="base"/><geom type="box" size=".1 .1 .05" mass="2"/>
<body name="foot" pos="0 0 -.12"><joint name="leg" type="slide" axis="0 0 1" damping="5" range="-.1 .1"/>
<geom name="sole" type="box" size=".08 .08 .02" mass=".3" friction=".8"/></body></body></worldbody>
<actuator><position name="leg" joint="leg" kp="800" kv="10"/></actuator></mujoco>"""

STIFF = """<mujoco model="stiff"><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="hand"><joint name="wrist" axis="0 1 0" damping=".02" armature=".005" range="-3 3"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.05"/></body></worldbody>
<actuator><position name="wrist" joint="wrist" kp="60" kv="1"/></actuator></mujoco>"""

NOISE = {"qpos": 0.002, "qvel": 0.05}


def log_of(
    xml: str,
    parameters: Sequence[Parameter | str],
    truth: Mapping[str, float],
    control: np.ndarray,
    *,
    dt: float = 0.01,
    substeps: int = 2,
    noise: float = 1.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Simulate a hidden robot under controls (samples, nu), and log its noisy positions and velocities.

    ``truth`` has coordinates of the parameters: logarithms of factors, or shifts.
    """
    model = mujoco.MjSpec.from_string(xml).compile()
    bound = Parameters(parameters, model)
    x = np.array([truth.get(name, 0.0) for name in bound.names])
    hidden, delay = bound.model(x), bound.signals(x)["delay"][0]
    hidden.opt.timestep = h = dt / substeps
    data, rng = mujoco.MjData(hidden), np.random.default_rng(seed)
    qpos, qvel = [], []
    for k in range(len(control)):
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        for s in range(substeps):
            times = k * dt + s * h + h * (np.arange(50) + 0.5) / 50 - delay
            data.ctrl[:] = control[np.maximum(0, np.floor(times / dt + 1e-9).astype(int))].mean(axis=0)
            mujoco.mj_step(hidden, data)
    positions, velocities = np.array(qpos), np.array(qvel)
    return {
        "time": dt * np.arange(len(control)),
        "ctrl": control,
        "qpos": positions + noise * NOISE["qpos"] * rng.standard_normal(positions.shape),
        "qvel": velocities + noise * NOISE["qvel"] * rng.standard_normal(velocities.shape),
    }
