r"""Learn to balance a pole on a cart from pictures, or to swing it up, by PPO or from a teacher.

    python examples/pixels.py --device cuda --nworld 1024 --size 64
    python examples/pixels.py --teacher
    python examples/pixels.py --task dm/cartpole_swingup --teacher --seconds 4 --distance 5 --target 830 \
        --device cuda --nworld 1024 --size 64

The policy sees only a camera. Its value function knows the state, because the policy does not need it after training.
With ``--teacher``, PPO first learns a policy for the state, which then teaches the policy that sees. This takes about a
minute on one CPU core. Episodes of training take 2 s, so that most pictures show a pole that can still be caught, or
``--seconds``. The evaluation uses episodes of 10 s.
"""

import time
from typing import Any

import torch
import tyro

import lyceum_warp as lw


def main(
    task: str = "cartpole", device: str = "cpu", nworld: int = 64, size: int = 32, seconds: float = 2.0,
    distance: float = 2.5, iterations: int = 100, minutes: float = 20.0, target: float = 950.0,
    teacher: bool = False, seed: int = 0,
) -> None:  # fmt: skip
    """Train until all of eight episodes reach the target, and evaluate the policy on the C engine."""
    start = time.perf_counter()
    cameras = [lw.Camera("near", size, size, pos=(0.0, -distance, 1.0), lookat=(0.0, 0.0, 1.0))]
    blind = lw.make(task, nworld=nworld, device=device, frame_skip=4, horizon=round(25 * seconds), seed=seed)
    env = blind.replicate(cameras=cameras, seed=seed)

    def train(learner: lw.Learner) -> Any:
        judge = learner.env.replicate(nworld=8, horizon=250)
        for it in learner:
            elapsed, last = time.perf_counter() - start, it.iteration == iterations
            if it.iteration % 10 and not last:
                continue
            returns = 4 * lw.evaluate(judge, learner.policy, 8, seed=0).returns
            rate = it.samples / it.iteration / (it.time_sample + it.time_update)
            print(
                f"{elapsed:6.0f} s, {learner.algorithm} {it.iteration}: {it.samples:,} samples, return "
                f"{returns.mean():.0f} of 1000, lowest {returns.min():.0f}; {rate:,.0f} samples/s; sampling "
                f"{it.time_sample:.2f} s and the update {it.time_update:.2f} s", flush=True,
            )  # fmt: skip
            if returns.min() >= target or last or elapsed > 60.0 * minutes:
                return learner.policy

    common: dict[str, Any] = {"hidden": (128, 128), "mean_every": 0}
    settings = {"value_hidden": (128, 128), "epochs": 4, "gamma": 0.98, "entropy_coef": 0.0} | common
    if teacher:
        state_policy = train(lw.PPO(blind, config=lw.PPOConfig(**settings), seed=seed))
        sees = {"policy_groups": ("camera",), "log_std": -1.5, "epochs": 4, "gradient_length": 6}
        config = lw.DistillConfig(**sees, **common)
        policy = train(lw.Distill(env, config=config, teacher=state_policy, seed=seed))
    else:
        policy = train(lw.PPO(env, config=lw.PPOConfig(policy_groups=("camera",), **settings), seed=seed))
    judge = env.replicate(nworld=8, horizon=250, engine="mujoco", device="cpu")
    returns = 4 * lw.evaluate(judge, policy, 8, seed=1).returns
    print(f"return on the C engine, of 1000: {returns.mean():.0f}, lowest {returns.min():.0f}")


if __name__ == "__main__":
    torch.set_num_threads(1)  # several threads would wait for each other in small networks
    tyro.cli(main)
