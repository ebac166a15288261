"""Measure frames per second of an environment with a camera, beside the bare renderer of MuJoCo Warp.

    lyceum-warp bench pictures --parts speed --device cuda
    MUJOCO_GL=egl lyceum-warp bench pictures --parts gap --runs runs/first runs/second
    lyceum-warp bench pictures --short

Part "speed": a frame is one step of one world with its picture. The environment and the bare engine take turns of ten
steps, from the same states (kept.py). The bare engine is one graph of ``mujoco_warp.step``, ``refit_bvh`` and
``render``: its pictures are a substep older than its states, and its colours stay packed. With final pictures, all
worlds are rendered a second time in each step in which an episode ends.

Part "gap": policies that see are judged with their own pictures and with those of MuJoCo's renderer (picture_gap.py).
Without ``--runs``, a policy first learns to balance a pole, which takes minutes on a CPU core.
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
import picture_gap
import warp as wp
from experiment import Experiment, Row, Table, choose

import lyceum_warp as lw

TASKS = ("cartpole", "half_cheetah", "go1_velocity", "aloha_lift")
CONTESTANTS = ("pictures", "final pictures")
PARTS = ("speed", "gap")


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    sizes: tuple[int, ...] = (64, 84, 128)
    """Widths and heights of the pictures."""
    worlds: tuple[int, ...] = (1024, 4096)
    """Numbers of worlds."""
    blocks: int = 10
    """Turns of ten steps."""
    parts: tuple[str, ...] = ()
    """speed and gap; by default both."""
    runs: tuple[str, ...] = ("",)
    """Folders of runs whose policies see cameras, for the gap."""
    episodes: int = 32
    """Episodes with each renderer, for the gap."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    size: int
    worlds: int
    contestant: str
    device: str
    blocks: int


@dataclasses.dataclass(frozen=True)
class GapCase:
    run: str
    renderer: str
    seed: int
    episodes: int
    iterations: int
    """Iterations of the learners if there is no run."""


def cases(options: Options) -> list[Case | GapCase]:
    parts = choose(options.parts, PARTS, what="part")
    return [*(speed_cases(options) if "speed" in parts else []), *(gap_cases(options) if "gap" in parts else [])]


def gap_cases(options: Options) -> list[GapCase]:
    episodes, iterations = (2, 1) if options.short else (options.episodes, 60)
    return [
        GapCase(run, renderer, seed, episodes, iterations)
        for run in options.runs
        for seed in options.seeds or (1,)
        for renderer in picture_gap.RENDERERS
    ]


def speed_cases(options: Options) -> list[Case]:
    tasks = choose(options.tasks, TASKS, TASKS[:1] if options.short else TASKS, what="task")
    worlds, blocks = ((4,), 1) if options.short else (options.worlds, options.blocks)
    return [
        Case(task, size, number, contestant, options.device, blocks)
        for task in tasks
        for number in worlds
        for size in (options.sizes[:1] if options.short else options.sizes)
        for contestant in choose(options.contestants, CONTESTANTS, what="contestant")
    ]


def estimate(case: Case | GapCase) -> float:
    if isinstance(case, GapCase):
        return 5.0 + 3.0 * case.episodes + case.iterations
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


def measure(case: Case | GapCase, options: Options) -> dict[str, Any]:
    return picture_gap.gap(**vars(case)) if isinstance(case, GapCase) else speed(case)


def speed(case: Case) -> dict[str, Any]:
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
        time_bare = kept.seconds_of_bare(env, bare, actions)
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
    gaps = [row for row in rows if "renderer" in row.case]
    return [*speed_tables([row for row in rows if row not in gaps]), *gap_tables(gaps)]


def gap_tables(rows: Sequence[Row]) -> list[Table]:
    header = ["policy", "pictures", "return", "lowest", "episodes", "pixels that differ visibly"]
    lines = [
        [row.case["run"] or "cartpole, 32 x 32 pixels, from a teacher", row.case["renderer"],
         f"{statistics.mean(row.result['returns']):.1f} ± {statistics.pstdev(row.result['returns']):.1f}",
         f"{min(row.result['returns']):.1f}", str(len(row.result["returns"])), f"{row.result['differing']:.2%}"]
        for row in rows
    ]  # fmt: skip
    title = (
        "The picture gap: returns of the same episodes on the C engine, with pictures of this package and of "
        "mujoco.Renderer; plain: without shadows, reflections and antialiasing; of another world: how much the policy "
        "needs its eyes."
    )
    return [Table(title, header, lines)] if lines else []


def speed_tables(rows: Sequence[Row]) -> list[Table]:
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
    conditions="Frames: the Warp engine steps tasks with their own (exact) physics. Gap: the C engine, exact physics.",
    summary="Frames per second of environments with a camera, and policies under MuJoCo's own renderer.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
