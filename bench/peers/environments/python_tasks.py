"""Define tasks for Gymnasium and dm_control with the formulas and models of lyceum_warp's tasks.

The file runs in the other libraries' virtual environments, and does not import lyceum_warp.
"""

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.humanoid_v5 import mass_center

MODELS = Path(__file__).resolve().parents[3] / "lyceum_warp" / "tasks"

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
    "cartpole": "LyceumCartpole-v0",
    "herb_reach": "LyceumHerbReach-v0",
}

JUDGE_NEW_STATE = {"humanoid_standup", "reacher", "pusher", "inverted_pendulum", "inverted_double_pendulum"}
"""Tasks whose reward and termination depend only on the state at the end of the step."""


class CartpoleEnv(MujocoEnv):
    """dm_control's cartpole balance, the same task as ``lyceum_warp/tasks/cartpole.py``."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, **options: Any) -> None:
        space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float64)
        super().__init__(str(MODELS / "cartpole.xml"), 1, space, **options)

    def _get_obs(self) -> np.ndarray:
        (cart, angle), velocity = self.data.qpos, self.data.qvel
        return np.array([cart, np.cos(angle), np.sin(angle), velocity[0], velocity[1]])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.do_simulation(action, self.frame_skip)
        (cart, angle), control = self.data.qpos, min(abs(float(action[0])), 1.0)
        upright = (1.0 + np.cos(angle)) / 2.0
        centred = (1.0 + np.exp((cart / 2.0) ** 2 * np.log(0.1))) / 2.0
        small_control = (4.0 + 1.0 - control**2) / 5.0
        small_velocity = (1.0 + np.exp((self.data.qvel[1] / 5.0) ** 2 * np.log(0.1))) / 2.0
        return self._get_obs(), upright * centred * small_control * small_velocity, False, False, {}

    def reset_model(self) -> np.ndarray:
        random = self.np_random
        qpos = np.array([random.uniform(-0.1, 0.1), random.uniform(-0.034, 0.034)])
        self.set_state(qpos, 0.01 * random.standard_normal(2))
        return self._get_obs()


class HerbReachEnv(MujocoEnv):
    """Two arms that reach for targets, the same task as ``lyceum_warp/tasks/herb_reach.py``."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, **options: Any) -> None:
        space = gymnasium.spaces.Box(-np.inf, np.inf, (72,), np.float64)
        super().__init__(str(MODELS / "herb.xml"), 10, space, **options)
        self.palms = [self.model.site(f"{side}/palm").id for side in ("left", "right")]
        self.targets = [int(self.model.body(f"{side}_target").mocapid[0]) for side in ("left", "right")]
        arms = [self.model.joint(f"{side}/j1").qposadr[0] for side in ("left", "right")]
        self.arm_joints = np.concatenate([first + np.arange(7) for first in arms])
        self.home = self.model.key("home").qpos.copy()

    def _errors(self) -> np.ndarray:
        return self.data.mocap_pos[self.targets] - self.data.site_xpos[self.palms]

    def _get_obs(self) -> np.ndarray:
        data = self.data
        return np.concatenate([data.qpos, data.qvel, data.site_xpos[self.palms].ravel(), self._errors().ravel()])

    def _get_rew(self, velocity: float, action: np.ndarray) -> tuple[float, dict[str, float]]:
        distances = np.linalg.norm(self._errors(), axis=1)
        precision = np.exp((distances / 0.05) ** 2 * np.log(0.1)).sum()
        return -distances.sum() + 0.5 * precision - 0.01 * np.square(action).sum(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.do_simulation(action, self.frame_skip)
        mujoco.mj_kinematics(self.model, self.data)  # mj_step does not update site positions to the new state
        return self._get_obs(), self._get_rew(0.0, action)[0], False, False, {}

    def reset_model(self) -> np.ndarray:
        random, qpos = self.np_random, self.home.copy()
        qpos[self.arm_joints] += random.uniform(-0.1, 0.1, 14)
        self.data.mocap_pos[self.targets] = random.uniform((0.6, 0.1, 0.7), (0.95, 0.6, 1.3), (2, 3))
        self.data.mocap_pos[self.targets[1], 1] *= -1.0
        self.set_state(qpos, np.zeros(self.model.nv))
        return self._get_obs()


gymnasium.register("LyceumCartpole-v0", entry_point=CartpoleEnv, max_episode_steps=1000)
gymnasium.register("LyceumHerbReach-v0", entry_point=HerbReachEnv, max_episode_steps=100)

POSITIONS = {
    "humanoid": lambda env: mass_center(env.model, env.data)[0],
    "ant": lambda env: env.data.body("torso").xpos[0],
}


def dm_control_env(task: str, seed: int) -> Any:
    """Make a dm_control environment. Its task is one of dm_control's suite, or uses Gymnasium's formulas."""
    from dm_control import mujoco as dm_mujoco, suite
    from dm_control.rl import control

    own = "dm/cartpole_balance" if task == "cartpole" else task
    for domain, name in suite.ALL_TASKS:
        if own == f"dm/{domain}_{name}":
            return suite.load(domain, name, task_kwargs={"random": seed})

    class FromGymnasium(control.Task):
        def __init__(self, env: Any, physics: Any) -> None:
            self.env, self.position = env, POSITIONS.get(task, lambda env: env.data.qpos[0])
            env.model, env.data = physics.model.ptr, physics.data.ptr
            env.reset(seed=seed)

        def initialize_episode(self, physics: Any) -> None:
            self.env.reset_model()

        def action_spec(self, physics: Any) -> Any:
            return dm_mujoco.action_spec(physics)

        def before_step(self, action: np.ndarray, physics: Any) -> None:
            self.action, self.before = action, float(self.position(self.env))
            physics.set_control(action)

        def after_step(self, physics: Any) -> None:
            mujoco.mj_rnePostConstraint(self.env.model, self.env.data)

        def get_reward(self, physics: Any) -> float:
            velocity = (float(self.position(self.env)) - self.before) / self.env.dt
            return self.env._get_rew(velocity, self.action)[0]

        def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
            return {"observations": self.env._get_obs()}

        def get_termination(self, physics: Any) -> float | None:
            ends = getattr(self.env, "_terminate_when_unhealthy", False)
            return 0.0 if ends and not self.env.is_healthy else None

    class FromStep(FromGymnasium):
        """A task that computes observation and reward by Gymnasium's step function, with the physics disabled."""

        def __init__(self, env: Any, physics: Any) -> None:
            super().__init__(env, physics)
            env.do_simulation = lambda action, substeps: None
            self.obs = env._get_obs()

        def initialize_episode(self, physics: Any) -> None:
            self.obs = self.env.reset_model()

        def before_step(self, action: np.ndarray, physics: Any) -> None:
            self.action = action
            physics.set_control(action)

        def after_step(self, physics: Any) -> None:
            super().after_step(physics)
            self.obs, self.reward, self.ends, *_ = self.env.step(self.action)

        def get_reward(self, physics: Any) -> float:
            return float(self.reward)

        def get_observation(self, physics: Any) -> dict[str, np.ndarray]:
            return {"observations": self.obs}

        def get_termination(self, physics: Any) -> float | None:
            return 0.0 if self.ends else None

    made = gymnasium.make(GYMNASIUM[task])
    env = made.unwrapped
    physics = dm_mujoco.Physics.from_xml_path(env.fullpath)
    limit = made.spec.max_episode_steps * env.dt
    judged = (FromStep if task in JUDGE_NEW_STATE else FromGymnasium)(env, physics)
    return control.Environment(physics, judged, limit, n_sub_steps=env.frame_skip)
