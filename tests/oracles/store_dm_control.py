"""Store episodes of dm_control's suite for the tests: states, observations, rewards, discounts and initial states.

dm_control 1.0.50 does not run on MuJoCo 4, so run this script in a separate virtual environment:

    python -m venv dm && dm/bin/pip install dm-control==1.0.50 mujoco==3.17.0
    MUJOCO_GL=disable dm/bin/python tests/oracles/store_dm_control.py tests/data/dm_control [DOMAIN ...]

An episode has segments of 40 steps with one random action each. At the beginning of a segment, the state is rounded to
float32 and the warm start is set to 0. The stored state is therefore exactly the state from which dm_control continued.
"""

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from dm_control import suite

TASKS = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse"),
    "cheetah": ("run",),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run"),
    "manipulator": ("bring_ball",),
    "pendulum": ("swingup",),
    "point_mass": ("easy",),
    "quadruped": ("walk", "run"),
    "reacher": ("easy", "hard"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}
TARGETS = {
    "finger": (("site_pos", "target"),),
    "fish": (("geom_pos", "target"),),
    "manipulator": (("body_pos", "target_ball"), ("body_quat", "target_ball")),
    "reacher": (("geom_pos", "target"),),
    "swimmer": (("geom_pos", "target"),),
}
"""Model fields that dm_control randomizes in each episode."""
STARTS, SEGMENTS, STEPS, RESETS = 5, 25, 40, 300


def flat(observation: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for value in observation.values()])


def state(domain: str, physics: Any) -> dict[str, np.ndarray]:
    targets = [np.ravel(getattr(physics.named.model, field)[name]) for field, name in TARGETS.get(domain, ())]
    found = {"qpos": physics.data.qpos, "qvel": physics.data.qvel, "act": physics.data.act}
    return {name: value.copy() for name, value in found.items()} | {"target": np.concatenate([[], *targets])}


def begin_segment(physics: Any, action: np.ndarray) -> None:
    for name in ("qpos", "qvel", "act"):
        getattr(physics.data, name)[:] = getattr(physics.data, name).astype(np.float32)
    physics.set_control(action)
    physics.forward()
    physics.data.qacc_warmstart[:] = 0.0


def round_target(domain: str, physics: Any) -> None:
    for field, name in TARGETS.get(domain, ()):
        row = getattr(physics.named.model, field)[name]
        getattr(physics.named.model, field)[name] = row.astype(np.float32)


def stored(domain: str, task: str) -> dict[str, Any]:
    """Return a task's arrays.

    Episodes have the shape (starts, segments, size). Initial states have the shape (resets, size).
    """
    env = suite.load(domain, task, task_kwargs={"random": 0})
    physics, spec = env.physics, env.action_spec()
    rng = np.random.default_rng(0)
    rows: dict[str, list[Any]] = {}
    for _ in range(STARTS):
        first = env.reset()
        round_target(domain, physics)
        episode: dict[str, list[Any]] = {"step_type": [int(first.step_type)], "discount": []}
        for _ in range(SEGMENTS):
            action = rng.uniform(spec.minimum, spec.maximum).astype(np.float32)
            begin_segment(physics, action)
            values = state(domain, physics) | {
                "action": action,
                "observation": flat(env.task.get_observation(physics)),
                "reward": env.task.get_reward(physics),
            }
            for step in range(STEPS):
                timestep = env.step(action)
                episode["step_type"].append(int(timestep.step_type))
                episode["discount"].append(timestep.discount)
                if step == 0:
                    after = {"observation": flat(timestep.observation), "reward": timestep.reward}
                    after |= {name: getattr(physics.data, name).copy()
                              for name in ("qpos", "qvel")}  # fmt: skip
                    values |= {f"next_{name}": value for name, value in after.items()}
            values["end_qpos"] = physics.data.qpos.copy()
            for name, value in values.items():
                episode.setdefault(name, []).append(np.asarray(value, np.float32))
        for name, value in episode.items():
            rows.setdefault(name, []).append(np.array(value))
    for _ in range(RESETS):
        env.reset()
        for name, value in state(domain, physics).items():
            rows.setdefault(f"reset_{name}", []).append(value.astype(np.float32))
    out: dict[str, Any] = {name: np.array(value) for name, value in rows.items()}
    out["step_type"], out["discount"] = out["step_type"].astype(np.uint8), out["discount"].astype(np.float32)
    shapes = {name: np.shape(value) for name, value in first.observation.items()}
    return out | {
        "parts": list(shapes), "sizes": [int(np.prod(shape, dtype=int)) for shape in shapes.values()],
        "dimensions": [len(shape) for shape in shapes.values()], "control_timestep": env.control_timestep(),
        "timestep": physics.timestep(), "minimum": spec.minimum, "maximum": spec.maximum,
    }  # fmt: skip


def main(folder: Path, *domains: str) -> None:
    versions = [f"{name} {version(name)}" for name in ("dm-control", "mujoco", "numpy")]
    for domain in domains or TASKS:
        values = {f"{task}/{name}": value for task in TASKS[domain] for name, value in stored(domain, task).items()}
        np.savez_compressed(folder / f"{domain}.npz", script="tests/oracles/store_dm_control.py", versions=versions,
                            **values)  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
