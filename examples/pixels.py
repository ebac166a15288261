"""Learn to balance a pole on a cart from pictures, by PPO.

    python examples/pixels.py --device cuda --nworld 1024 --size 64
    python examples/pixels.py --nworld 64 --size 32

The policy sees only the last three pictures of a camera. The value function knows the state, because the policy does
not need the value function after training. Training uses episodes of 2 s, so that most pictures show a pole that can
still be caught, and the evaluation uses episodes of 10 s.
"""

import time

import torch
import tyro

import lyceum_warp as lw


def main(
    task: str = "cartpole", device: str = "cpu", nworld: int = 64, size: int = 32, iterations: int = 100,
    minutes: float = 20.0, target: float = 0.95, seed: int = 0,
) -> None:  # fmt: skip
    """Train until the mean reward of a step reaches the target, and evaluate the policy on both engines' pictures."""
    start = time.perf_counter()
    cameras = [lw.Camera("near", size, size, pos=(0.0, -2.5, 1.0), lookat=(0.0, 0.0, 1.0))]
    env = lw.make(task, nworld=nworld, device=device, cameras=cameras, frame_skip=4, horizon=50, seed=seed)
    config = lw.PPOConfig(
        policy_groups=("camera",), hidden=(128, 128), value_hidden=(128, 128), epochs=4, gamma=0.98, entropy_coef=0.0,
        mean_every=10,
    )  # fmt: skip
    learner = lw.PPO(env, config=config, seed=seed)
    for it in learner:
        seconds = time.perf_counter() - start
        if it.mean_return is not None or it.iteration == iterations:
            mean = float("nan") if it.mean_return is None else it.mean_return / env.horizon
            rate = learner.count / (it.time_sample + it.time_update)
            print(
                f"{seconds:6.0f} s, iteration {it.iteration}: {it.samples:,} samples, reward {it.reward_mean:.3f} with "
                f"noise, {mean:.3f} without; {rate:,.0f} samples/s, {it.time_sample:.2f} s sampling, "
                f"{it.time_update:.2f} s update", flush=True,
            )  # fmt: skip
            if mean >= target:
                break
        if it.iteration == iterations or seconds > 60.0 * minutes:
            break
    for place in ({}, {"engine": "mujoco", "device": "cpu"}) if env.engine.name == "warp" else ({},):
        judge = env.replicate(nworld=8, horizon=250, **place)
        returns = lw.evaluate(judge, learner.policy, 8, seed=1).returns
        print(
            f"return of 10 s on the {judge.engine.name} engine, of 1000: {4 * returns.mean():.0f} (lowest "
            f"{4 * returns.min():.0f}), {time.perf_counter() - start:.0f} s"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)  # several threads would wait for each other in small networks
    tyro.cli(main)
