"""Measure environment steps per second of another library; bench/venvs.py starts this program.

The program reads a JSON object (contestant, task, envs, threads, seconds, warm, seed) and prints a JSON object. Actions
are uniform within their bounds. They are drawn before the clock starts.
"""

import json
import multiprocessing
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

KEPT_ACTIONS = 4096
"""Number of actions that are drawn before the clock starts."""

GYMNASIUM = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "half_cheetah": "HalfCheetah-v5",
    "swimmer": "Swimmer-v5",
    "ant": "Ant-v5",
    "humanoid": "Humanoid-v5",
    "humanoid_standup": "HumanoidStandup-v5",
    "reacher": "Reacher-v5",
    "pusher": "Pusher-v5",
    "inverted_pendulum": "InvertedPendulum-v5",
    "inverted_double_pendulum": "InvertedDoublePendulum-v5",
}
ENVPOOL = GYMNASIUM | {
    "cartpole": "CartpoleBalance-v1",
    "dm/cartpole_swingup": "CartpoleSwingup-v1",
    "dm/cheetah_run": "CheetahRun-v1",
    "dm/walker_walk": "WalkerWalk-v1",
    "dm/humanoid_walk": "HumanoidWalk-v1",
}


def draw(low: np.ndarray, high: np.ndarray, envs: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (max(16, KEPT_ACTIONS // envs), envs, *low.shape))


class Gymnasium:
    def __init__(self, contestant: str, task: str, envs: int, threads: int, seed: int) -> None:
        import gymnasium

        name = GYMNASIUM[task]
        self.single = contestant == "gymnasium"
        if self.single:
            self.env: Any = gymnasium.make(name)
            space = self.env.action_space
        else:
            kind = {"gym-sync": gymnasium.vector.SyncVectorEnv, "gym-async": gymnasium.vector.AsyncVectorEnv}
            mode = gymnasium.vector.AutoresetMode.SAME_STEP
            self.env = kind[contestant]([lambda: gymnasium.make(name)] * envs, autoreset_mode=mode)
            space = self.env.single_action_space
        self.actions = draw(space.low, space.high, envs, seed).astype(np.float32)
        self.env.reset(seed=seed)

    def step(self, t: int) -> None:
        if not self.single:
            self.env.step(self.actions[t])
            return
        _, _, terminated, truncated, _ = self.env.step(self.actions[t][0])
        if terminated or truncated:
            self.env.reset()

    def close(self) -> None:
        self.env.close()


def dm_control_env(task: str, seed: int) -> Any:
    from dm_control import suite

    domain, name = next(pair for pair in suite.ALL_TASKS if task == f"dm/{'_'.join(pair)}")
    return suite.load(domain, name, task_kwargs={"random": seed})


class DmControl:
    """dm_control's environments in persistent subprocesses.

    The authors of dm_control recommend subprocesses (github.com/google-deepmind/dm_control/issues/94). Each process
    gets one message per step; actions and results are in shared memory.
    """

    def __init__(self, contestant: str, task: str, envs: int, threads: int, seed: int) -> None:
        first = dm_control_env(task, seed)
        spec = first.action_spec()
        self.actions = draw(spec.minimum, spec.maximum, envs, seed)
        self.pipes: list[Connection] = []
        context = multiprocessing.get_context("fork")
        nobs = sum(int(np.prod(part.shape)) for part in first.observation_spec().values())
        self.shared_actions = shared(context, (envs, *spec.shape))
        results = shared(context, (envs, nobs + 2))
        for part in np.array_split(np.arange(envs), min(envs, threads)):
            here, there = context.Pipe()
            args = (there, task, [seed + int(i) for i in part], self.shared_actions[part[0] : part[-1] + 1],
                    results[part[0] : part[-1] + 1])  # fmt: skip
            context.Process(target=Share.serve, args=args, daemon=True).start()
            self.pipes.append(here)
        for pipe in self.pipes:
            pipe.recv_bytes()

    def step(self, t: int) -> None:
        self.shared_actions[:] = self.actions[t]
        for pipe in self.pipes:
            pipe.send_bytes(b"step")
        for pipe in self.pipes:
            pipe.recv_bytes()

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send_bytes(b"end")


def shared(context: Any, shape: tuple[int, ...]) -> np.ndarray:
    memory = context.RawArray("d", int(np.prod(shape)))
    return np.frombuffer(memory).reshape(shape)


class Share:
    """The environments of one subprocess."""

    def __init__(self, task: str, seeds: list[int], actions: np.ndarray, results: np.ndarray) -> None:
        self.envs = [dm_control_env(task, seed) for seed in seeds]
        for env in self.envs:
            env.reset()
        self.actions, self.results = actions, results

    def step(self) -> None:
        for i, env in enumerate(self.envs):
            step = env.step(self.actions[i])
            reward, end = step.reward, step.last()
            if end:
                step = env.reset()
            obs = np.concatenate([np.ravel(part) for part in step.observation.values()])
            self.results[i, :-2], self.results[i, -2], self.results[i, -1] = obs, reward, end

    @classmethod
    def serve(cls, pipe: Connection, *args: Any) -> None:
        share = cls(*args)
        pipe.send_bytes(b"ready")
        while pipe.recv_bytes() == b"step":
            share.step()
            pipe.send_bytes(b"done")


class EnvPool:
    def __init__(self, contestant: str, task: str, envs: int, threads: int, seed: int) -> None:
        import envpool

        self.env = envpool.make(ENVPOOL[task], env_type="gymnasium", num_envs=envs, num_threads=threads, seed=seed)
        space = self.env.action_space
        self.actions = draw(space.low, space.high, envs, seed).astype(space.dtype)
        self.env.reset()

    def step(self, t: int) -> np.ndarray:
        """Return each environment's step count within its episode."""
        return self.env.step(self.actions[t])[-1]["elapsed_step"]

    def transition_share(self) -> float:
        """Run 200 more steps, and return the fraction of them that simulate physics.

        The step after the end of an episode only resets: it ignores its action, and returns the next episode's first
        observation.
        """
        first = [np.mean(self.step(t % len(self.actions)) == 0) for t in range(200)]
        return 1.0 - float(np.mean(first))

    def close(self) -> None:
        self.env.close()


CONTESTANTS: dict[str, Callable[..., Any]] = {
    "gymnasium": Gymnasium,
    "gym-sync": Gymnasium,
    "gym-async": Gymnasium,
    "dm_control": DmControl,
    "envpool": EnvPool,
}

PACKAGES = {Gymnasium: ("gymnasium", "mujoco"), DmControl: ("dm_control", "mujoco"), EnvPool: ("envpool",)}
"""Packages that affect the result; EnvPool includes its own MuJoCo."""


def timed(
    step: Callable[[int], None], period: int, warm: int, seconds: float, wait: Callable[[], None] = lambda: None
) -> tuple[int, float]:
    """Run ``warm`` steps, and then measure. Return the number of measured steps, and the seconds they took together.

    ``step`` gets the index of the actions, from 0 to ``period`` - 1. ``wait`` waits for the end of asynchronous steps.
    """
    for t in range(warm):
        step(t % period)
    wait()
    count, block, start = 0, 1, time.perf_counter()
    now = start
    while now - start < seconds:
        began = now
        for _ in range(block):
            step(count % period)
            count += 1
        wait()
        now = time.perf_counter()
        if now - began < 0.01:  # reading the clock takes time
            block *= 2
    return count, now - start


def main() -> None:
    request = json.load(sys.stdin)
    settings = {name: request[name] for name in ("contestant", "task", "envs", "threads", "seed")}
    contestant = CONTESTANTS[request["contestant"]](**settings)
    steps, seconds = timed(contestant.step, len(contestant.actions), request["warm"], request["seconds"])
    share = contestant.transition_share() if isinstance(contestant, EnvPool) else 1.0
    width = contestant.actions.shape[1]
    contestant.close()
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES[type(contestant)])
    rate = steps * width * share / seconds
    print(json.dumps({"env_steps_per_second": rate, "steps": steps, "versions": versions}))


if __name__ == "__main__":
    main()
