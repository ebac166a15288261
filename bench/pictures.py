"""Measure frames per second of an environment with a camera, beside the bare renderer of MuJoCo Warp.

    lyceum-warp bench pictures --device cuda
    lyceum-warp bench pictures --short

A frame is one step of one world with its picture. The environment and the bare engine take turns of ten steps, from the
same states (kept.py). The bare engine is one graph of ``mujoco_warp.step``, ``refit_bvh`` and ``render``. With final
pictures, all worlds are rendered a second time in each step in which an episode ends.
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from typing import Any

import contestants
import experiment
import kept
import mujoco_warp as mjw
import numpy as np
import warp as wp
from experiment import Experiment, Row, Table, choose

import lyceum_warp as lw

TASKS = ("cartpole", "half_cheetah", "go1_velocity", "aloha_lift")
CONTESTANTS = ("pictures", "final pictures")


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    sizes: tuple[int, ...] = (64, 84, 128)
    """Widths and heights of the pictures."""
    worlds: tuple[int, ...] = (1024, 4096)
    """Numbers of worlds."""
    blocks: int = 10
    """Turns of ten steps."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    size: int
    worlds: int
    contestant: str
    device: str
    blocks: int


def cases(options: Options) -> list[Case]:
    tasks = choose(options.tasks, TASKS, TASKS[:1] if options.short else TASKS, what="task")
    worlds, blocks = ((4,), 1) if options.short else (options.worlds, options.blocks)
    return [
        Case(task, size, number, contestant, options.device, blocks)
        for task in tasks
        for number in worlds
        for size in (options.sizes[:1] if options.short else options.sizes)
        for contestant in choose(options.contestants, CONTESTANTS, what="contestant")
    ]


def estimate(case: Case) -> float:
    return 20.0 + case.blocks


class BareWithPictures(kept.BareWarp):
    """A graph of ``mujoco_warp.step`` and of MuJoCo Warp's renderer."""

    def __init__(self, env: lw.Env) -> None:
        super().__init__(env)
        (camera,) = env.task.cameras
        with wp.ScopedDevice(env.device):
            skybox = bool((env.task.model.tex_type == 2).any())
            size = [(camera.width, camera.height)]
            context = mjw.create_render_context(
                env.task.model, env.nworld, size, True, False, False, cam_active=[camera.name], render_skybox=skybox
            )
            mjw.refit_bvh(self.m, self.d, context)
            mjw.render(self.m, self.d, context)
            with wp.ScopedCapture() as capture:
                for _ in range(env.task.frame_skip):
                    mjw.step(self.m, self.d)
                mjw.refit_bvh(self.m, self.d, context)
                mjw.render(self.m, self.d, context)
        self.graph, self._context = capture.graph, context


def measure(case: Case, options: Options) -> dict[str, Any]:
    statistic = lw.make(case.task).model.stat
    look = statistic.center
    place = look + statistic.extent * np.array([0.6, -1.2, 0.5])
    camera = lw.Camera("bench", case.size, case.size, pos=tuple(place), lookat=tuple(look), group="camera")
    env = lw.make(
        case.task, nworld=case.worlds, engine="warp", device=case.device, cameras=[camera],
        final_pictures=case.contestant == "final pictures",
    )  # fmt: skip
    actions, bare = contestants.actions(env, seed=0), BareWithPictures(env)

    def block() -> None:
        for t in range(kept.BLOCK):
            env.action.copy_(actions[t])
            env.step()

    env_seconds, bare_seconds = [], []
    for repetition in range(2 + case.blocks):  # the first blocks capture graphs
        start = env.get_state()
        time_env = kept.seconds(env, block)
        env.set_state(start)
        snapshots = []
        for t in range(kept.BLOCK):
            env.action.copy_(actions[t])
            snapshots.append(bare.snapshot())
            env.step()
        time_bare = 0.0
        for snapshot in snapshots:
            bare.load(snapshot)
            time_bare += kept.seconds(env, bare.step)
        if repetition >= 2:
            env_seconds.append(time_env / kept.BLOCK)
            bare_seconds.append(time_bare / kept.BLOCK)
    return {
        "frames_per_second": env.nworld / statistics.median(env_seconds),
        "bare_frames_per_second": env.nworld / statistics.median(bare_seconds),
        "kept": statistics.median(b / a for a, b in zip(env_seconds, bare_seconds, strict=True)),
        "bytes_per_world": env.bytes_per_world,
    }


def tables(rows: Sequence[Row]) -> list[Table]:
    header = ["task", "worlds", "size", "", "frames/s", "of the bare engine's", "kB a world"]
    lines = [
        [row.case["task"], f"{row.case['worlds']:,}", str(row.case["size"]), row.case["contestant"],
         f"{row.result['frames_per_second']:,.0f}", f"{row.result['kept']:.1%}",
         f"{row.result['bytes_per_world'] / 1e3:,.0f}"]
        for row in rows
    ]  # fmt: skip
    title = "Frames per second: steps of the environment with a colour picture of each world, random actions."
    return [Table(title, header, lines)] if lines else []


EXPERIMENT = Experiment(
    name="pictures",
    conditions="The Warp engine steps tasks with their own (exact) physics, and renders one camera.",
    summary="Frames per second of environments with a camera, beside MuJoCo Warp's bare renderer.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
