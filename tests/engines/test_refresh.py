import re
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import step_table as table
import warp as wp

from lyceum_warp.core.fields import describe, early_sensor_columns
from lyceum_warp.engines import Engine
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine

SENSORS = {name: table.SENSORS[name] for name in ("position", "velocity", "limits", "histories")}
SENSORS["limits"] = re.sub(r"<\w+frc [^>]*>", "", SENSORS["limits"])  # the acceleration stage computes force sensors
SENSORS["mixed"] = table.SENSORS["velocity"] + table.SENSORS["acceleration"]
FIELDS = "site_xpos xpos xquat subtree_com cam_xpos cvel sensordata"


def model_of(sensors: str, equality: str = "none") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(table.xml(table.PLAIN | {"equality": equality}, SENSORS[sensors]))


def everyone(engine: Engine) -> wp.array:
    return wp.full(engine.nworld, True, dtype=bool, device=engine.device)


def only(engine: Engine, *worlds: int) -> wp.array:
    return wp.array(np.isin(np.arange(engine.nworld), worlds), dtype=bool, device=engine.device)


def begin(engine: Engine, mask: wp.array, seed: int) -> None:
    """Begin episodes in random states. Some states exceed a joint limit or have contacts."""
    rng, chosen = np.random.default_rng(seed), mask.numpy().astype(bool)
    engine.reset(mask)
    write(engine, "qpos", chosen, engine.arrays["qpos"].numpy() + 0.1 * rng.normal(size=engine.arrays["qpos"].shape))
    write(engine, "qvel", chosen, rng.normal(size=engine.arrays["qvel"].shape))
    engine.commit(mask)
    engine.refresh(mask)


def write(engine: Engine, name: str, chosen: np.ndarray, values: np.ndarray) -> None:
    array = engine.arrays[name]
    array.assign(np.where(chosen[:, None], values.astype(np.float32), array.numpy()))


def state_of(engine: Engine) -> np.ndarray:
    state = wp.zeros((engine.nworld, engine.state_size), dtype=wp.float64, device=engine.device)
    engine.get_state(state)
    return state.numpy().copy()


def put(engine: Engine, state: np.ndarray, mask: wp.array) -> None:
    engine.set_state(wp.array(state, dtype=wp.float64, device=engine.device), mask)


def shown(engine: Engine) -> dict[str, np.ndarray]:
    return {name: engine.arrays[name].numpy().copy() for name in engine.fields if name in FIELDS.split()}


def full_forward(engine: Engine) -> dict[str, np.ndarray]:
    state = state_of(engine)[:, : engine.integration_size]
    spec, names = mujoco.mjtState.mjSTATE_INTEGRATION.value, [n for n in FIELDS.split() if n in engine.fields]
    if isinstance(engine, WarpEngine):
        m, d = engine.bare()
        mjw.set_state(m, d, wp.array(state, dtype=float, device=engine.device), spec)
        mjw.forward(m, d)
        return {name: getattr(d, name).numpy().copy() for name in names}
    rows: dict[str, list[Any]] = {name: [] for name in names}
    for row in state:
        data = mujoco.MjData(engine.model)
        mujoco.mj_setState(engine.model, data, row, spec)
        mujoco.mj_forward(engine.model, data)
        for name in names:
            rows[name].append(getattr(data, name).astype(np.float32).copy())
    return {name: np.array(row) for name, row in rows.items()}


def check_current(engine: Engine, *, whole: bool = False, worlds: slice = slice(None)) -> None:
    found, wanted = shown(engine), full_forward(engine)
    columns = early_sensor_columns(engine.model)
    for name, value in found.items():
        expected = wanted[name].reshape(value.shape)
        if name == "sensordata" and not whole:
            value, expected = value[:, columns], expected[:, columns]
        np.testing.assert_array_equal(value[worlds], expected[worlds], err_msg=name)


class WholeWarpEngine(WarpEngine):
    """A Warp engine whose forward passes always compute all worlds."""

    partial_refresh = False


@pytest.fixture(params=[MujocoEngine, WarpEngine, WholeWarpEngine], ids=["mujoco", "warp", "whole_warp"])
def kind(request: pytest.FixtureRequest) -> type[Engine]:
    engine: type[Engine] = request.param
    return engine


def make(kind: type[Engine], sensors: str, equality: str = "none", names: str = FIELDS) -> Engine:
    model = model_of(sensors, equality)
    fields = [describe(model, name) for name in ("qpos", "qvel", *names.split())]
    sizes = {} if kind is MujocoEngine else {"nconmax": 64, "njmax": 256}
    engine = kind(model, 4, wp.get_device("cpu"), fields, **sizes)
    begin(engine, everyone(engine), 0)
    return engine


@pytest.mark.quick(*(f"mujoco-{name}" for name in SENSORS), "warp-mixed", "warp-histories")
@pytest.mark.parametrize("sensors", SENSORS)
def test_a_refresh_equals_a_full_forward_pass(kind: type[Engine], sensors: str) -> None:
    engine = make(kind, sensors)
    for steps in (1, 3):
        check_current(engine, whole=True)
        for _ in range(5):
            engine.step(steps)
            check_current(engine)
        state = state_of(engine)
        engine.step(2)
        put(engine, state, only(engine, 1, 2))
        check_current(engine)
        np.testing.assert_array_equal(state_of(engine)[1:3], state[1:3])
        before = state_of(engine)
        begin(engine, only(engine, 3), steps)
        np.testing.assert_array_equal(state_of(engine)[:3], before[:3])
        check_current(engine, whole=True, worlds=slice(3, 4))
        check_current(engine)
        begin(engine, everyone(engine), steps)


@pytest.mark.quick("mujoco", "warp")
@pytest.mark.parametrize("sensors", ["mixed", "histories"])
def test_acceleration_sensors_keep_their_values_from_the_last_substep(kind: type[Engine], sensors: str) -> None:
    engine = make(kind, sensors)
    late = np.setdiff1d(np.arange(engine.model.nsensordata), early_sensor_columns(engine.model))
    engine.step(3)
    left = shown(engine)["sensordata"]
    assert np.abs(left[:, late]).max() > 0
    engine.refresh_current(everyone(engine))
    np.testing.assert_array_equal(shown(engine)["sensordata"], left)
    before, chosen = state_of(engine), only(engine, 0, 2)
    write(engine, "qvel", chosen.numpy(), engine.arrays["qvel"].numpy() + 1.0)
    engine.commit(chosen)
    engine.refresh_current(chosen)
    check_current(engine)
    pushed = shown(engine)["sensordata"]
    np.testing.assert_array_equal(pushed[:, late], left[:, late])
    np.testing.assert_array_equal(pushed[[1, 3]], left[[1, 3]])
    assert (pushed[[0, 2]] != left[[0, 2]]).any()
    # a refresh does not change the sensors of a restored world
    engine.step(1)
    put(engine, before, only(engine, 1))
    engine.refresh_current(everyone(engine))
    np.testing.assert_array_equal(shown(engine)["sensordata"][1], left[1])


@pytest.mark.quick("mujoco-mixed", "warp-mixed")
@pytest.mark.parametrize("names", ["xpos", "xpos cvel", FIELDS], ids=["positions", "velocities", "sensors"])
@pytest.mark.parametrize("sensors", ["mixed", "histories"])
def test_parts_of_a_step_equal_the_whole_step(kind: type[Engine], sensors: str, names: str) -> None:
    whole, parts = (make(kind, sensors, names=names) for _ in range(2))
    for _ in range(3):
        whole.step(3)
        for i in range(3):
            for phase in parts.step_phases(1, first=i == 0, last=i == 2):
                phase.run()
        np.testing.assert_array_equal(state_of(parts), state_of(whole))
        check_current(parts)


def test_worlds_that_share_an_mjdata_have_separate_fields() -> None:
    model, device = model_of("mixed"), wp.get_device("cpu")
    for lagged, current in ((), ("xpos",)), (("cvel",), ("xpos",)), (("cvel", "xpos"), ("sensordata",)):
        fields = [describe(model, name, lagged=name in lagged) for name in (*lagged, *current, "qacc", "qvel")]
        engines = [MujocoEngine(model, nworld, device, fields, nthread=1) for nworld in (4, 1, 1, 1, 1)]
        for engine in engines:
            engine.reset(everyone(engine))
        together, apart = engines[0], engines[1:]
        for w, engine in enumerate(apart):
            for made, row in ((together, w), (engine, 0)):
                made.arrays["qvel"].numpy()[row] = 0.4 * (w + 1)
        for engine in engines:
            engine.commit(everyone(engine))
            engine.refresh(everyone(engine))
            for nstep in (2, 3, 1):
                engine.step(nstep)
        for field in fields:
            rows = np.concatenate([engine.arrays[field.name].numpy() for engine in apart])
            np.testing.assert_array_equal(together.arrays[field.name].numpy(), rows, err_msg=f"{field.name} {lagged}")
            assert len(np.unique(rows.reshape(4, -1), axis=0)) == 4, field.name
