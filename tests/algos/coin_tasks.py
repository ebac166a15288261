"""Define tasks for planner tests.

A fair coin decides whether the reward of a step is its action or minus its action.
"""

import warp as wp
from rail_task import rail

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class Coin:
    qpos: Row[float]
    coin: Row[float] = lw.memory()


@wp.struct
class CoinParams:
    dt: float


@wp.func
def toss(rng: Row[wp.uint32]) -> float:
    return wp.where(lw.uniform(rng, 0.0, 1.0) < 0.5, -1.0, 1.0)


@wp.func
def toss_at_reset(s: Coin, p: CoinParams, rng: Row[wp.uint32]):
    s.coin[0] = toss(rng)


@wp.func
def toss_in_step(s0: Coin, action: Row[float], s1: Coin, p: CoinParams, rng: Row[wp.uint32]):
    s1.coin[0] = toss(rng)


@wp.func
def observe_coin(s: Coin, p: CoinParams, obs: Row[float]):
    obs[0] = s.coin[0]


@wp.func
def paid_by_coin_after_action(s0: Coin, action: Row[float], s1: Coin, p: CoinParams) -> float:
    return action[0] * s1.coin[0]


@wp.func
def copied(s: Coin, action: Row[float], p: CoinParams, ctrl: Row[float]):
    ctrl[0] = action[0]


class TossedAfter(lw.Task):
    """Toss the coin after the action, so that all actions are equally good."""

    model = staticmethod(lambda: rail(limits='ctrllimited="true" ctrlrange="-1 1"'))
    obs = {"coin": 1}
    horizon = 100
    World = Coin
    Params = CoinParams
    observe, reward = observe_coin, paid_by_coin_after_action
    randomize, advance = toss_at_reset, toss_in_step


class TossedAfterWithControl(TossedAfter):
    """The ``control`` function makes the engine run rollouts step by step."""

    control = copied
