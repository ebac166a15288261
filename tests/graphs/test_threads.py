import threading
from collections.abc import Callable

import pytest
import torch

import lyceum_warp as lw

CASES = [("warp", "hopper", 1), ("mujoco", "hopper", 2), ("warp", "hopper", 3), ("mujoco", "point_mass", 4)]


def numbers(engine: str, task: str, seed: int, envs: int) -> list[torch.Tensor]:
    found = []
    for _ in range(envs):
        env = lw.make(task, engine=engine, nworld=3, seed=seed)
        draws = torch.Generator().manual_seed(seed)
        for _ in range(4):
            env.action.copy_(2 * torch.rand(env.action.shape, generator=draws) - 1)
            env.step()
            found += [env.obs.clone(), env.reward.clone()]
        state = env.get_state()
        env.rand_reset()
        env.set_state(state)
        env.step()
        found.append(env.get_state())
    return found


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


def check(times: int, envs: int) -> None:
    expected = [numbers(*case, envs) for case in CASES]
    for _ in range(times):
        found = in_threads(*(lambda case=case: numbers(*case, envs) for case in CASES))
        for case, own, alone in zip(CASES, found, expected, strict=True):
            assert isinstance(own, list), (case, own)
            assert all(map(torch.equal, own, alone)), case


def test_environments_in_threads_equal_environments_in_one_thread() -> None:
    check(times=1, envs=1)


@pytest.mark.long
def test_repeated_runs_of_environments_in_threads_equal_a_run_in_one_thread() -> None:
    check(times=20, envs=2)
