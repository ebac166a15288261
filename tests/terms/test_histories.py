import numpy as np
import pytest
import torch
import warp as wp
from conftest import SharedEnv
from rail_task import rail
from term_calls import N, call

import lyceum_warp as lw
from lyceum_warp import Row, terms

WIDTH = 3


@wp.struct
class World:
    qvel: Row[float]
    past_actions: Row[float] = lw.memory(1 + 2)
    delay: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float
    delay: float = 2.0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qvel[0]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = terms.delayed_action(action, s.past_actions, s.delay, 0)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    terms.push_history(s1.past_actions, action)


@wp.func
def initialize(s: World, p: Params):
    s.delay[0] = p.delay


class Delayed(lw.Task):
    model, obs, horizon = staticmethod(rail), {"speed": 1}, 40


@pytest.mark.parametrize("length", [1, 2, 4])
def test_history_contains_the_last_values_and_repeats_the_first_value_until_full(length: int) -> None:
    rng, values = np.random.default_rng(0), []
    history = np.zeros((N, 1 + length * WIDTH))
    assert call("history_length", history=history, width=WIDTH).result[0] == length
    assert not call("put_history", target=np.ones(length * WIDTH), history=history, width=WIDTH).after["target"].any()
    for _ in range(3 * length + 2):  # enough values for the counter to wrap around
        values.append(rng.standard_normal((N, WIDTH)).astype(np.float32))
        history = call("push_history", history=history, value=values[-1]).after["history"]
        kept = [values[max(len(values) - 1 - age, max(len(values) - length, 0))] for age in range(length + 1)]
        for age, i in ((0, 0), (length - 1, 1), (length, 2)):
            found = call("read_history", history=history, width=WIDTH, age=age, i=i).result
            np.testing.assert_array_equal(found, kept[age][:, i])
        written = call("put_history", target=np.zeros(length * WIDTH), history=history, width=WIDTH).after["target"]
        np.testing.assert_array_equal(written, np.hstack(kept[length - 1 :: -1]))


def test_actions_are_delayed_by_the_delay_of_their_world() -> None:
    rng = np.random.default_rng(0)
    delay = rng.integers(0, 4, (N, 1)).astype(float)
    actions, history = rng.standard_normal((9, N, 2)), np.zeros((N, 1 + 3 * 2))
    for step, action in enumerate(actions):
        source = np.maximum(step - delay[:, 0].astype(int), 0)
        for i in range(2):
            found = call("delayed_action", action=action, history=history, delay=delay, i=i).result
            np.testing.assert_allclose(found, actions[source, np.arange(N), i], rtol=1e-6)
        history = call("push_history", history=history, value=action).after["history"]


def test_delay_beyond_the_history_is_a_fault_of_its_world(shared_env: SharedEnv) -> None:
    env = shared_env(Delayed, nworld=4, delay=[0.0, 2.0, 3.0, -1.0])
    speeds, faults = [], []
    for action in (1.0, 0.0, 0.0, -1.0):
        before = env.obs.clone()
        env.step(torch.full((4, 1), action))
        speeds.append((env.obs - before)[:2, 0].sign().tolist())
        faults.append([lw.Done(reason) for reason in env.done_reason.tolist()])
    assert speeds == [[1.0, 1.0], [0.0, 1.0], [0.0, 1.0], [-1.0, 0.0]]
    assert faults == [[0, 0, lw.Done.NAN, lw.Done.NAN]] * 4
