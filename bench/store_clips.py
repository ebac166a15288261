"""Make the package's clips from its walking policies: lyceum-warp bench store_clips.

The G1's policies move only the legs. Its arms swing against the legs, or wave, by formulas of this file. The clips are
stored as tables in lyceum_warp/tasks/tracking/.
"""

from pathlib import Path

import numpy as np
import torch

import lyceum_warp as lw

FOLDER = Path(lw.__file__).parent / "tasks/tracking"
START, SECONDS = 3.0, 4.0
COMMANDS = {
    "g1": {"walk": (0.6, 0.0, 0.0), "turn": (0.4, 0.0, 0.6), "side": (0.0, 0.3, 0.0), "wave": (0.0, 0.0, 0.0)},
    "go1": {"walk": (0.8, 0.0, 0.0), "turn": (0.4, 0.0, 0.6), "side": (0.0, 0.4, 0.0), "back": (-0.5, 0.0, 0.0)},
}
"""Forward and lateral velocity (m/s) and yaw rate (rad/s) of each clip."""
NEVER = [1e6, 1e6]


@torch.no_grad()
def walk(task: str, commands: dict[str, tuple[float, float, float]]) -> lw.Clips:
    """Run a walking policy under each command."""
    policy = lw.load(lw.pretrained_run(task))
    env = lw.make(task, nworld=len(commands), horizon=0, encoder_bias=0.0, push_seconds=NEVER)
    env.reset()
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["drawn_velocity"][:] = torch.tensor(list(commands.values()))
    parts["heading_controlled"][:], parts["standing"][:] = 0.0, 0.0
    parts["command_timer"][:] = parts["push_timer"][:] = NEVER[0]
    env.set_state(state)
    rows = []
    for _ in range(round((START + SECONDS) / env.timestep) + 1):
        rows.append(env.field("qpos").clone())
        env.step(policy.act(env.obs))
        assert not env.done.any()
    qpos = torch.stack(rows[round(START / env.timestep) :], 1).double().numpy()
    rate = 1.0 / env.timestep
    return lw.Clips(names=tuple(commands), qpos=tuple(qpos), rate=rate, weights=len(commands) * (1.0,))


def swing(qpos: np.ndarray) -> None:
    """Let the G1's arms swing against its legs."""
    hips = qpos[:, [7, 13]] - qpos[:, [7, 13]].mean()
    for side, (shoulder, elbow) in enumerate(((22, 25), (29, 32))):
        qpos[:, shoulder] = 0.2 + 1.2 * hips[:, 1 - side]
        qpos[:, elbow] = 1.0 - 0.5 * hips[:, 1 - side]


def wave(qpos: np.ndarray, rate: float) -> None:
    """Raise the G1's right arm, wave and turn the waist, and lower the arm again."""
    t = np.arange(len(qpos)) / rate
    up = np.clip(np.minimum(t, t[-1] - t) / 0.8, 0.0, 1.0)
    up = up * up * (3.0 - 2.0 * up)
    for joint, raised in ((29, -1.2), (30, -1.0), (31, 0.3), (32, 0.6)):
        qpos[:, joint] += up * (raised - qpos[:, joint])
    qpos[:, 31] += up * 0.5 * np.sin(2.0 * np.pi * 1.2 * t)
    qpos[:, 19] += up * 0.2 * np.sin(2.0 * np.pi * 0.6 * t)


if __name__ == "__main__":
    for robot, commands in COMMANDS.items():
        clips = walk(f"{robot}_velocity", commands)
        if robot == "g1":
            for qpos in clips.qpos[:3]:
                swing(qpos)
            wave(clips.qpos[3], clips.rate)
        for qpos in clips.qpos:
            qpos[:, :2] -= qpos[0, :2]
        np.save(FOLDER / f"{robot}.npy", clips)
        print(f"{FOLDER / robot}.npy: {', '.join(clips.names)}, {clips.seconds:g} s")
