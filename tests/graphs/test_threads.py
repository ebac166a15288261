import threading
from collections.abc import Callable

import torch

import lyceum_warp as lw

CASES = [("warp", "hopper", 1), ("mujoco", "hopper", 2), ("warp", "hopper", 3), ("mujoco", "point_mass", 4)]


def numbers(engine: str, task: str, seed: int) -> list[torch.Tensor]:
    env = lw.make(task, engine=engine, nworld=3, seed=seed)
    draws = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(4):
        env.action.copy_(2 * torch.rand(env.action.shape, generator=draws) - 1)
        env.step()
        found += [env.obs.clone(), env.reward.clone()]
    state = env.get_state()
    env.rand_reset()
    env.set_state(state)
    env.step()
    return [*found, env.get_state()]


def in_threads(*functions: Callable[[], list[torch.Tensor]]) -> list[list[torch.Tensor] | Exception]:
    results: list[list[torch.Tensor] | Exception] = [RuntimeError("did not end")] * len(functions)

    def call(i: int) -> None:
        try:
            results[i] = functions[i]()
        except Exception as error:
            results[i] = error

    threads = [threading.Thread(target=call, args=(i,), daemon=True) for i in range(len(functions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def test_environments_in_threads_equal_environments_in_one_thread() -> None:
    expected = [numbers(*case) for case in CASES]
    found = in_threads(*(lambda case=case: numbers(*case) for case in CASES))
    for case, own, alone in zip(CASES, found, expected, strict=True):
        assert isinstance(own, list), (case, own)
        assert all(map(torch.equal, own, alone)), case
