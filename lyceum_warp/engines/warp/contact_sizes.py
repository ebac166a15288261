"""The number of contacts and constraints that a model needs, measured on random rollouts."""

import contextlib
import hashlib
import logging

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco.batch import Batch, SimulationError

log = logging.getLogger(__name__)

_WORLDS, _HOLDS, _SUBSTEPS = 32, 25, 20

_LEAST, _LEAST_WITH_FLEX = (8, 8), (256, 512)
"""The smallest sizes. Contacts of a flex come in bursts that a probe may miss: a geom that is pressed into it touches
up to 50 of its elements. Those with a flex are MuJoCo Warp's own defaults."""

_known: dict[str, tuple[int, int]] = {}


def probe_sizes(model: mujoco.MjModel) -> tuple[int, int]:
    """Contacts and constraints to make room for in each world: twice the peak of random rollouts.

    32 worlds start in the model's initial state or a keyframe, half of them with random velocities, and take
    500 substeps on the C engine under random controls held for 20. The result is remembered for each model.

    Returns:
        (nconmax, njmax), multiples of 8: each at least 8, with a flex at least 256 and 512.

    Raises:
        NotImplementedError, ValueError: MuJoCo Warp refuses the model.
    """
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    key = hashlib.sha256(buffer.tobytes()).hexdigest()
    if key not in _known:
        _known[key] = _probe(model)
    return _known[key]


def _probe(model: mujoco.MjModel) -> tuple[int, int]:
    with wp.ScopedDevice("cpu"):
        mjw.put_model(model)  # a model that is refused is not worth a probe, which may take a minute
    batch = Batch(model, _WORLDS)
    rng = np.random.default_rng(0)
    ncon, nefc = batch.bind("ncon"), batch.bind("nefc")
    if model.nkey:
        batch.reset(keyframe=np.arange(_WORLDS, dtype=np.int32) % (model.nkey + 1) - 1)
    batch.qvel[: _WORLDS // 2] += rng.normal(size=(_WORLDS // 2, model.nv))
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1.0, 1.0)).T
    contacts = constraints = 0
    for _ in range(_HOLDS):
        batch.ctrl[:] = rng.uniform(low, high, size=(_WORLDS, model.nu))
        for _ in range(_SUBSTEPS):
            # a world that fails because memory is short has shown how much it needs
            with contextlib.suppress(SimulationError):
                batch.step()
            contacts, constraints = max(contacts, int(ncon.max())), max(constraints, int(nefc.max()))
    least = _LEAST_WITH_FLEX if model.nflex else _LEAST
    sizes = tuple(max(low, -(-2 * peak // 8) * 8) for low, peak in zip(least, (contacts, constraints), strict=True))
    log.info("probed peaks of %d contacts and %d constraints: nconmax=%d, njmax=%d", contacts, constraints, *sizes)
    return sizes[0], sizes[1]
