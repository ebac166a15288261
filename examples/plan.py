"""Control an arm with MPPI, which makes a new plan at every step.

    python examples/plan.py
    python examples/plan.py --task half_cheetah --steps 200 --samples 64

The command line has more options: ``lyceum-warp plan reach --real-time`` controls the arm in real time.
"""

import tyro

import lyceum_warp as lw


def main(
    task: str = "reach",
    episodes: int = 5,
    steps: int | None = None,
    samples: int | None = None,
    seed: int = 0,
) -> None:
    """Control a task with MPPI.

    Args:
        task: Name of a task, or a file that defines one.
        episodes: Number of episodes.
        steps: Number of steps per episode; by default the task's horizon.
        samples: Number of samples per plan. The task has a default.
        seed: Seed of the first episode; the next episode has the next seed.
    """
    plant = lw.make(task, autoreset=False)
    # the planner has its own worlds
    plan = lw.MPPI(task) if samples is None else lw.MPPI(task, samples=samples)

    trajectories = []
    for episode in range(episodes):
        trajectory = lw.control(plant, plan, steps=steps, seed=seed + episode)
        print(
            f"episode {episode}: return {trajectory.episode_return:8.2f}, evaluation {trajectory.evals[-1]:.3f}, "
            f"{'success' if trajectory.succeeded else 'no success'} after {trajectory.steps} steps"
        )
        trajectories.append(trajectory)

    report = lw.control_report(trajectories)
    print(f"success: {report.success:.0%} of {report.episodes} episodes")
    print(f"planning time: median {report.plan_p50_ms:.2f} ms, longest {report.plan_max_ms:.2f} ms")
    print(f"real time: {report.misses} of {report.plans} plans took longer than a step of {report.deadline_ms:g} ms")


if __name__ == "__main__":
    tyro.cli(main)
