"""The second reading of go1_velocity's rewards, mjlab's, against formulas on the substeps of the same transitions."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from go1_formulas import DT, STILL, State, expected_terms, random_steps

import lyceum_warp as lw

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture(scope="module")
def readings() -> ModuleType:
    spec = importlib.util.spec_from_file_location("readings", BENCH / "readings.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["readings"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_mjlabs_reading_is_that_of_the_substep_before(readings: ModuleType) -> None:
    env = lw.make(readings.Readings, nworld=8, autoreset=False, **STILL)
    fine = lw.make("go1_velocity", nworld=8, autoreset=False, frame_skip=1, **STILL)
    parts, peaks, compared = fine.state_space.parts, np.zeros((8, 4)), 0
    for action in random_steps(env, 20):
        s0, state = State(env), env.get_state()
        own = env.state_space.split(state)
        other = fine.get_state()
        for name, columns in parts.items():
            other[:, columns] = own[name][:, : columns.stop - columns.start]
        fine.set_state(other)
        for _ in range(3):
            fine.step(action)
        env.step(action)
        seen, s1 = State(fine), State(env)
        current = expected_terms(s0, action.numpy(), s1, env.model)
        wanted = current | {
            name: expected_terms(s0, action.numpy(), seen, env.model)[name]
            for name in ("track_linear_velocity", "track_angular_velocity", "upright", "foot_slip")
        }
        command = s0.command()
        active = np.linalg.norm(command[:, :2], axis=1) + np.abs(command[:, 2]) > 0.05
        landed = (seen.contact_time > 0) & (seen.contact_time < DT + 1e-6)
        wanted["foot_clearance"] = -2.0 * active * (np.abs(s0.height - 0.1) * seen.foot_speed).sum(axis=1)
        wanted["foot_swing_height"] = -0.25 * active * (landed * (peaks / 0.1 - 1.0) ** 2).sum(axis=1)
        wanted["soft_landing"] = -1e-5 * active * (landed * np.linalg.norm(s1.force, axis=2)).sum(axis=1)
        peaks = np.where(landed, 0.0, np.where(seen.touching, peaks, np.maximum(peaks, s0.height)))
        for name, term in wanted.items():
            np.testing.assert_allclose(env.metrics[name].numpy(), DT * current[name], rtol=1e-3, atol=1e-6)
            found = env.metrics[f"{name} (mjlab)"].numpy()
            np.testing.assert_allclose(found, DT * term, rtol=1e-3, atol=1e-6, err_msg=name)
        compared += int(landed.sum())
    assert compared > 20
