"""Train a policy with NPG, print the learning curve, then evaluate and save the policy.

    python examples/train.py
    python examples/train.py --task half_cheetah --nworld 64 --iterations 100

The command line has more options: ``lyceum-warp train hopper`` can resume, and makes a plot and a video.
"""

from pathlib import Path

import torch
import tyro

import lyceum_warp as lw


def main(
    task: str = "hopper",
    nworld: int = 10,
    iterations: int = 40,
    samples: int = 10_000,
    device: str = "cpu",
    seed: int = 0,
    out: Path = Path("policy.pt"),
) -> None:
    """Train a policy.

    Args:
        task: Name of a task, or a file that defines one.
        nworld: Number of worlds; use thousands on a GPU.
        iterations: Number of iterations.
        samples: Transitions per iteration.
        device: cpu, or a CUDA device such as cuda:0.
        seed: Seed of the worlds, the networks and the noise.
        out: File for the policy's weights.
    """
    env = lw.make(task, nworld=nworld, device=device, seed=seed)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=samples), seed=seed)

    for it in npg:  # an endless iterator: each iteration samples and updates the policy
        print(f"iteration {it.iteration:3d}  return {it.return_mean:7.1f}  {it.samples_per_second:8,.0f} samples/s")
        if it.iteration == iterations:
            break

    # mean actions, without noise
    episodes = lw.evaluate(env, npg.policy, 20, seed=seed + 1)
    print(f"mean policy: return {episodes.returns.mean():.1f} in {episodes.lengths.mean():.0f} steps")

    torch.save({"shape": npg.policy.shape, "state": npg.policy.state_dict()}, out)
    saved = torch.load(out)
    policy = lw.GaussianPolicy(**saved["shape"])
    policy.load_state_dict(saved["state"])
    print(f"saved in {out}: {sum(p.numel() for p in policy.parameters())} parameters")


if __name__ == "__main__":
    tyro.cli(main)
