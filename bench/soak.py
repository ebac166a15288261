"""Test that faults are reported in very long runs, that memory does not leak, and that killed runs resume.

    lyceum-warp bench soak --threads 2
    lyceum-warp bench soak --parts random --tasks dm/walker_walk dm/fish_swim --engine mujoco
    lyceum-warp bench soak --parts faults --device cuda --work runs/soak

Part "faults": worlds step under random actions, and each world gets a fault every thousand steps on average. In a
variant of the task (``VARIANT``), an additional action requests some kinds of faults. Every fault must be reported in
its world and step, and no other fault may be reported. A second environment runs without faults. Each world must be
bitwise equal to its copy there until its first fault. Every fourth world gets no faults.

A run is divided into chunks. Each chunk continues from the states that the previous chunk stored in the folder
``--work``.

Part "random": worlds of every task step under random actions, without injected faults. Part "memory": environments are
made and deleted. Part "kills": training runs get SIGTERM or SIGKILL at random times, are started again by the same
command, and must give the same results as an uninterrupted run.
"""

import collections
import csv
import dataclasses
import functools
import gc
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import experiment
import numpy as np
import torch
import warp as wp
from experiment import Experiment, Row, Skipped, Table

import lyceum_warp as lw
from lyceum_warp.binding import TaskSource, file_name, find_task
from lyceum_warp.core import FAULTS, Done
from lyceum_warp.support.files import replaced
from lyceum_warp.support.validate import whole_number

PARTS = ("faults", "random", "memory", "kills")
KINDS = {"state": Done.NAN, "speed": Done.NAN, "action": Done.ACTION, "reward": Done.REWARD,
         "observation": Done.OBSERVATION, "model": Done.MODEL}  # fmt: skip
"""The reason that must be reported for each kind of fault. Kinds are numbered from 1."""
NBIT = len(Done)
EVERY = 16
"""Steps between two writes of invalid states."""
SAMPLES = 5
TASKS = {
    "point_mass": (1024, 10**7, 10, 4.0), "hopper": (512, 10**6, 10, 100.0), "soft_ball": (256, 10**6, 10, 100.0),
    "panda_lift": (256, 10**6, 10, 250.0), "adroit_relocate": (256, 10**6, 10, 250.0),
    "humanoid": (256, 10**6, 10, 300.0), "go1_velocity": (256, 10**6, 10, 300.0),
}  # fmt: skip
"""Worlds, steps per chunk, chunks, and seconds per million steps on two cores, for each task."""
OTHERS = (256, 10**6, 1, 300.0)
"""The same four numbers for tasks that are not in ``TASKS``."""
SHORT = (64, 20_000, 2, 0.0)
GPU_TASKS = {"half_cheetah": (16_384, 10**8, 10, 0.5)}
SAME_BITS = {"half_cheetah": (4096, 10**6, 10, 20.0)}
"""Entries like those of ``TASKS``, for the deterministic mode."""
TRAININGS = (
    "--algorithm npg --iterations 600 --samples 800 --nworld 16",
    "--algorithm ppo --iterations 1500 --num-steps 16 --nworld 16",
    "--algorithm sac --iterations 300 --num-steps 8 --nworld 4 --warmup 200",
)
SHORT_TRAININGS = ("--algorithm ppo --iterations 60 --nworld 8 --save-every 5",)
SMALL = "--horizon 50 --nthread 1 --hidden 32 32 --value-hidden 32 32 --mean-every 20 --mean-episodes 2"
"""Options of all trainings that are killed."""

VARIANT = """

@wp.func
def soak_control(s: {world}, action: Row[float], p: {params}, ctrl: Row[float]):
    {control}
    s.userdata[0] = action[action.shape[0] - 1]


@wp.func
def soak_observe(s: {world}, p: {params}, obs: Row[float]{rng_argument}):
    {observe}(s, p, obs{rng})
    if s.userdata[0] == 5.0:
        obs[0] = wp.nan


@wp.func
def soak_reward(s0: {world}, action: Row[float], s1: {world}, p: {params}) -> float:
    if s1.userdata[0] == 4.0:
        return wp.nan
    return {reward}(s0, action, s1, p)


@wp.func
def soak_randomize(s: {world}, p: {params}, rng: Row[wp.uint32]):
    {randomize}
    s.body_mass[1] = s.body_mass[1] * lw.uniform(rng, 0.95, 1.05)


@wp.func
def soak_event(s: {world}, p: {params}, rng: Row[wp.uint32]):
    {event}
    if s.userdata[0] == 6.0:
        s.body_mass[1] = -1.0


class Soak({parent}):
    World, Params = {task_structs}
    control, observe, reward = soak_control, soak_observe, soak_reward
    randomize, event = soak_randomize, soak_event
    actions, action_range = {{"action": {nact}, "fault": 1}}, None

    @staticmethod
    def edit_model(spec):
        spec.nuserdata = 1
"""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """Parts: faults, random, memory, kills; by default all."""
    engine: str = "auto"
    """Engine of the parts "faults", "random" and "memory"."""
    nworld: int | None = None
    """Number of worlds; by default, the number listed for the task."""
    steps: int | None = None
    """Number of steps per chunk, summed over worlds; by default, the number listed for the task."""
    kill_every: float = 8.0
    """Mean time from the start of a training to its kill, in seconds. The start is about half of it."""
    work: Path = Path("runs/soak")
    """Folder for task variants, for states between chunks, and for training runs."""


@dataclasses.dataclass(frozen=True)
class Faults:
    task: str
    chunk: int
    steps: int
    nworld: int
    engine: str
    device: str
    compared: bool
    rate: float
    seed: int
    part: str = "faults"

    def state(self, work: Path, chunk: int) -> Path:
        where = f"{self.engine}-{self.device.partition(':')[0]}"
        run = f"{file_name(self.task)}-{where}-{self.nworld}-{self.steps}-{self.seed}"
        return work / f"{run}{'-same-bits' if self.compared else ''}-{chunk}.pt"


@dataclasses.dataclass(frozen=True)
class Random:
    task: str
    steps: int
    nworld: int
    engine: str
    device: str
    seed: int
    part: str = "random"


@dataclasses.dataclass(frozen=True)
class Memory:
    task: str
    made: int
    nworld: int
    engine: str
    device: str
    part: str = "memory"


@dataclasses.dataclass(frozen=True)
class Kills:
    task: str
    words: str
    kills: int
    kill_every: float
    seed: int
    part: str = "kills"


def cases(options: Options) -> list[Any]:
    parts, short, cuda = experiment.choose(options.parts, PARTS, what="part"), options.short, options.device != "cpu"
    everything = TASKS | {task: OTHERS for task in lw.task_names() if task not in TASKS}
    sizes_of = {"point_mass": SHORT} if short else GPU_TASKS if cuda else everything
    runs = [(task, sizes_of.get(task, SHORT if short else OTHERS), not cuda)
            for task in experiment.choose(options.tasks, lw.task_names(), tuple(sizes_of), what="task")]  # fmt: skip
    if cuda and not short and not options.tasks:
        runs += [(task, sizes, True) for task, sizes in SAME_BITS.items()]
    cases: list[Any] = []
    for seed in options.seeds or (0,):
        for task, sizes, compared in runs if "faults" in parts else ():
            nworld = whole_number("--nworld", options.nworld or sizes[0], low=8)
            steps = whole_number("--steps", options.steps or sizes[1], low=nworld * SAMPLES)
            chunks = [Faults(task, chunk, steps, nworld, options.engine, options.device, compared,
                             1e-2 if short else 1e-3, seed) for chunk in range(sizes[2])]  # fmt: skip
            # continue from the last stored state; another machine may have stored it
            first_chunk = max(
                (i for i in range(1, len(chunks) + 1) if chunks[0].state(options.work, i).exists()), default=1
            )
            cases += chunks[first_chunk - 1 :]
        if "random" in parts:
            sizes = SHORT if short else OTHERS
            nworld, steps = options.nworld or sizes[0], options.steps or sizes[1]
            cases += [Random(task, steps, nworld, options.engine, options.device, seed)
                      for task in (tuple(sizes_of) if short else options.tasks or lw.task_names())]  # fmt: skip
        if "kills" in parts and not cuda:
            kills = (1, 4.0) if short else (20, options.kill_every)
            trainings = SHORT_TRAININGS if short else TRAININGS
            cases += [Kills("point_mass", arguments, *kills, seed) for arguments in trainings]
    if "memory" in parts:
        cases.append(Memory("hopper", 10 if short else 100, 32, options.engine, options.device))
    return cases


def estimate(case: Any) -> float:
    if isinstance(case, Faults):
        table = SAME_BITS if case.compared and case.device != "cpu" else TASKS | GPU_TASKS
        return 5.0 + table.get(case.task, OTHERS)[3] * case.steps / 1e6
    if isinstance(case, Random):
        return 5.0 + 100.0 * case.steps / 1e6
    return 20.0 if isinstance(case, Memory) else 20.0 + 2.0 * case.kills * case.kill_every


def measure(case: Any, options: Options) -> dict[str, Any]:
    options.work.mkdir(parents=True, exist_ok=True)
    parts: dict[str, Any] = {"faults": inject, "random": step_randomly, "memory": make_and_delete, "kills": kill}
    return parts[case.part](case, options)


# faults


def variant(task: str, work: Path) -> tuple[str, torch.Tensor, torch.Tensor]:
    """Write a variant of a task, whose additional action requests a fault; return it, and the range of the other
    actions."""
    parent, plain = find_task(task), lw.make(task, nworld=1, engine="mujoco")
    source_task = TaskSource(parent)
    functions, nact = source_task.functions, plain.action.shape[1]
    file = Path(sys.modules[parent.__module__].__file__ or "")
    source = file.read_text().replace("@lw.register\n", "")
    pattern = r'"(\w+\.xml)"'  # the model's path is relative to the task's file
    source = re.sub(pattern, lambda m: repr(str(path)) if (path := file.parent / m[1]).exists() else m[0], source)
    fields = [f"    {name}: Row[float]\n" for name in ("userdata", "body_mass") if name not in source_task.world.vars]
    source = source.replace("class World:\n", "".join(["class World:\n", *fields]), 1)
    noisy = functions["observe"] is not None and len(functions["observe"].input_types) > 3
    # if a module defines several tasks, their functions and structs have different names
    names = {name: function.func.__name__ for name, function in functions.items() if function and function.func}
    world, params = (struct.cls.__name__ for struct in list(functions["observe"].func.__annotations__.values())[:2])
    copy = "for i in range(ctrl.shape[0]):\n        ctrl[i] = action[i]"
    source += VARIANT.format(
        parent=parent.__name__, nact=nact,
        task_structs=f"{source_task.world.cls.__name__}, {source_task.defaults.__name__}",
        world=world, params=params, rng=", rng" if noisy else "",
        rng_argument=", rng: Row[wp.uint32]" if noisy else "", observe=names["observe"], reward=names["reward"],
        control=f"{names['control']}(s, action, p, ctrl)" if functions["control"] else copy,
        randomize=f"{names['randomize']}(s, p, rng)" if functions["randomize"] else "pass",
        event=f"{names['event']}(s, p, rng)" if functions["event"] else "pass",
    )  # fmt: skip
    path = work / f"soak_{file_name(task).replace('-', '_')}.py"
    if not path.exists() or path.read_text() != source:
        path.write_text(source)
    space, limited = plain.action_space, plain.model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(limited, plain.model.actuator_ctrlrange, np.inf).T  # the variant does not scale actions
    if functions["control"]:
        unbounded = np.full(nact, np.inf)
        low = unbounded if space.low is None else space.low
        high = unbounded if space.high is None else space.high
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return f"{path}:Soak", torch.as_tensor(low).float(), torch.as_tensor(high).float()


@wp.kernel(enable_backward=False)
def draw(
    seed: int, step: int, rate: float, low: wp.array[float], high: wp.array[float],
    pending: wp.array[bool], row: wp.array[int], kind_out: wp.array[int], action_out: wp.array2d[float],
    twin_action_out: wp.array2d[float],
):  # fmt: skip
    """Draw each world's action, and choose the fault that starts in this step, if any; launched over (nworld,).

    The random numbers depend on the seed, the step and the world. Every fourth world gets no fault. A world whose last
    fault is not reported yet gets no further fault.
    """
    w = wp.tid()
    rng = wp.rand_init(int(wp.rand_init(seed, step)), w)
    place, share, kind = wp.randf(rng), rate * 4.0 / 18.0, wp.int32(0)
    for k in range(6):
        width = wp.where(k > 1, share, wp.where(step % wp.static(EVERY) == 0, share * float(wp.static(EVERY)), 0.0))
        if place >= 0.0 and place < width and w % 4 != 3 and not pending[w]:
            kind = k + 1
        place -= width
    kind_out[w] = kind
    n = low.shape[0]
    for i in range(n):
        action_out[w, i] = low[i] + (high[i] - low[i]) * wp.randf(rng)
        if row[w] >= 0:
            twin_action_out[row[w], i] = action_out[w, i]
    if kind == 3:
        action_out[w, step % n] = wp.nan
    action_out[w, n] = wp.where(kind > 3, float(kind), 0.0)


@wp.kernel(enable_backward=False)
def tally(
    row: wp.array[int], kind_in: wp.array[int], reason_in: wp.array[int], done_in: wp.array[bool],
    obs_in: wp.array2d[float], reward_in: wp.array[float], twin_reason_in: wp.array[int],
    twin_obs_in: wp.array2d[float], twin_reward_in: wp.array[float], pending_inout: wp.array[bool],
    clean_inout: wp.array[bool], injected_inout: wp.array2d[int], reasons_inout: wp.array2d[int],
    outcome_inout: wp.array2d[int],
):  # fmt: skip
    """Count faults after a step, and compare worlds without faults with their copies in the twin environment."""
    w = wp.tid()
    due = wp.where(pending_inout[w], 6, wp.where(kind_in[w] < 6, kind_in[w], 0))
    pending_inout[w] = kind_in[w] == 6 and not done_in[w]  # a world that restarts gets no event in this step
    injected_inout[w, due] += 1
    for bit in range(wp.static(NBIT)):
        reasons_inout[w, due * wp.static(NBIT) + bit] += reason_in[w] >> bit & 1
    clean_inout[w] = clean_inout[w] and due == 0 and not pending_inout[w]
    compared = row[w] >= 0 and clean_inout[w] and kind_in[w] == 0  # the reward may depend on the whole action
    twin = wp.max(row[w], 0)
    same = reward_in[w] == twin_reward_in[twin] and reason_in[w] == twin_reason_in[twin]
    finite = wp.isfinite(reward_in[w])
    for i in range(obs_in.shape[1]):
        finite = finite and wp.isfinite(obs_in[w, i])
        same = same and obs_in[w, i] == twin_obs_in[twin, i]
    outcome_inout[w, 0] += int(compared)
    outcome_inout[w, 1] += int(compared and not same)
    outcome_inout[w, 2] += int(not finite)


def inject(case: Faults, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    gc.collect()  # free the environments of the previous chunk
    before = case.state(options.work, case.chunk)
    if case.chunk and not before.exists():
        raise Skipped(f"there is no {before}: pass --work with the folder that chunk {case.chunk - 1} used")
    try:
        file, low, high = variant(case.task, options.work)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    make = functools.partial(
        lw.make, file, engine=case.engine, device=case.device, seed=case.seed, nthread=options.threads,
        deterministic=case.compared and case.device != "cpu",
    )  # fmt: skip
    env = twin = make(nworld=case.nworld)
    worlds = torch.arange(case.nworld, device=env.obs.device)
    start = {"pending": torch.zeros_like(env.done), "clean": torch.ones_like(env.done)}
    if case.chunk:
        start = torch.load(before, map_location=worlds.device, weights_only=True)
        env.set_state(start["state"])
    pending, clean, row = start["pending"], start["clean"], torch.full_like(worlds, -1, dtype=torch.int32)
    paired = worlds[worlds % 4 == 3] if case.chunk else worlds
    twin_action = torch.zeros_like(env.action)
    if case.compared:
        row[paired] = torch.arange(len(paired), dtype=torch.int32, device=row.device)
        twin = make(nworld=len(paired))
        twin_action = twin.action.zero_()
        if case.chunk:
            twin.set_state(start["twin"])
    kind, qpos, qvel = torch.zeros_like(row), *(env.state_space.parts[name].start for name in ("qpos", "qvel"))
    injected = row.new_zeros(case.nworld, 7)
    reasons = row.new_zeros(case.nworld, 7 * NBIT)
    outcome = row.new_zeros(case.nworld, 3)
    draw_arrays = [
        wp.from_torch(tensor)
        for tensor in (low.to(worlds.device), high.to(worlds.device), pending, row, kind, env.action, twin_action)
    ]
    tally_arrays = [
        wp.from_torch(tensor)
        for tensor in (
            row, kind, env.done_reason, env.done, env.obs, env.reward, twin.done_reason, twin.obs, twin.reward, pending,
            clean, injected, reasons, outcome,
        )
    ]  # fmt: skip
    steps, samples, began = -(-case.steps // case.nworld), [], time.perf_counter()
    for t in range(case.chunk * steps, case.chunk * steps + steps):
        wp.launch(draw, case.nworld, [case.seed, t, case.rate, *draw_arrays], device=env.device)
        if t % EVERY == 0 and (mask := (kind == 1) | (kind == 2)).any():
            state = env.get_state()
            state[kind == 1, torch.where(worlds % 2 == 0, qpos, qvel)[kind == 1]] = torch.nan
            state[kind == 2, qvel] = 1e11
            env.set_state(state, mask, check=False)
        env.step()
        if case.compared:
            twin.step()
        wp.launch(tally, case.nworld, tally_arrays, device=env.device)
        steps_done = t % steps + 1
        if steps_done * SAMPLES // steps > (steps_done - 1) * SAMPLES // steps:
            samples.append([steps_done * case.nworld, *memory(worlds.device)])
    compared, different, infinite = outcome.sum(0).tolist()
    seconds = time.perf_counter() - began
    end = {"state": env.get_state(), "pending": pending, "clean": clean}
    if case.compared:
        last = twin.get_state()
        end["twin"] = last[paired % 4 == 3]
        different += int((end["state"][paired].view(torch.int64) != last.view(torch.int64)).any(1)[clean[paired]].sum())
    with replaced(case.state(options.work, case.chunk + 1)) as temporary:
        torch.save(end, temporary)
    case.state(options.work, case.chunk - 1).unlink(missing_ok=True)
    names = {bit.name.lower(): bit.bit_length() - 1 for bit in FAULTS if bit.name}
    kind_bits = list(enumerate((bit.bit_length() - 1 for bit in KINDS.values()), start=1))
    by_kind = reasons.sum(0).view(7, NBIT)
    counts = {name: int(by_kind[:, bit].sum()) for name, bit in names.items()}
    reported = [int(by_kind[k, bit]) for k, bit in kind_bits]
    for k, bit in kind_bits:
        by_kind[k, bit] = 0
    beside = {name: int(by_kind[1:, bit].sum()) for name, bit in names.items() if by_kind[1:, bit].any()}
    other = {name: int(by_kind[0, bit]) for name, bit in names.items() if by_kind[0, bit]}
    return {
        "injected": dict(zip(KINDS, injected.sum(0).tolist()[1:], strict=True)),
        "found": dict(zip(KINDS, reported, strict=True)), "beside": beside, "other": other,
        "counts_agree": counts == env.fault_counts,
        "compared": compared, "different": different, "not_finite": infinite, "steps": steps * case.nworld,
        "memory": samples, "steps_per_second": steps * case.nworld / seconds,
    }  # fmt: skip


# random


def step_randomly(case: Random, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    try:
        env = lw.make(case.task, nworld=case.nworld, engine=case.engine, device=case.device, seed=case.seed,
                      nthread=options.threads)  # fmt: skip
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    device = env.action.device
    low = torch.as_tensor(np.nan_to_num(env.action_space.low, neginf=-1.0), dtype=torch.float32, device=device)
    high = torch.as_tensor(np.nan_to_num(env.action_space.high, posinf=1.0), dtype=torch.float32, device=device)
    width = high - low
    generator = torch.Generator(device).manual_seed(case.seed)
    steps, began = -(-case.steps // case.nworld), time.perf_counter()
    first: list[Any] | None = None
    for t in range(steps):
        env.action.uniform_(generator=generator).mul_(width).add_(low)
        env.step()
        if first is None and (faulty := env.done_reason & int(FAULTS) != 0).any():
            world = int(faulty.nonzero()[0])
            first = [t, world, Done(int(env.done_reason[world]) & int(FAULTS)).name]
    seconds = time.perf_counter() - began
    return {"faults": env.fault_counts, "first": first, "engine": env.engine.name, "steps": steps * case.nworld,
            "steps_per_second": steps * case.nworld / seconds}  # fmt: skip


# memory


def memory(device: torch.device) -> tuple[int, int]:
    """Return the resident memory of this process and the used memory of its GPU, in bytes."""
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    if device.type == "cpu":
        return resident, 0
    free, total = torch.cuda.mem_get_info(device)
    return resident, total - free


def slope(samples: Sequence[Sequence[int]], column: int) -> float:
    points = np.array(samples[1:], dtype=float)
    return float(np.polyfit(points[:, 0], points[:, column], 1)[0])


def make_and_delete(case: Memory, options: Options) -> dict[str, Any]:
    samples = []
    for number in range(1, case.made + 1):
        env = lw.make(case.task, nworld=case.nworld, engine=case.engine, device=case.device, nthread=options.threads)
        env.step()
        device = env.obs.device
        del env
        gc.collect()
        if number * SAMPLES % case.made == 0:
            samples.append([number, *memory(device)])
    return {"memory": samples, "bytes_per_env": slope(samples, 1), "gpu_bytes_per_env": slope(samples, 2)}


# kills


def kill(case: Kills, options: Options) -> dict[str, Any]:
    """Train once without interruption and once with kills, and compare the results."""
    straight, killed = (options.work / f"{case.words.split()[1]}-{case.seed}-{name}" for name in ("straight", "killed"))
    for folder in (straight, killed):
        shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "lyceum_warp.cli", "train", case.task, *f"{case.words} {SMALL}".split(),
               "--no-plot", "--seed", str(case.seed), "--continue", "--out"]  # fmt: skip
    subprocess.run([*command, str(straight)], check=True, stdout=subprocess.DEVNULL)
    draws, kills, code = random.Random(case.seed), 0, -1
    while code < 0 or code == 128 + signal.SIGTERM:
        process = subprocess.Popen([*command, str(killed)], stdout=subprocess.DEVNULL)
        try:
            process.wait(case.kill_every * draws.uniform(0.0, 2.0) if kills < case.kills else None)
        except subprocess.TimeoutExpired:
            kills += 1
            process.send_signal(draws.choice((signal.SIGTERM, signal.SIGKILL)))
        code = process.wait()
    policies = [lw.load(folder).state_dict() for folder in (straight, killed)]
    return {
        "kills": kills, "exit_code": code, "iterations": len(table(straight)),
        "equal_rows": table(straight) == table(killed),
        "equal_policy": all(torch.equal(value, policies[1][name]) for name, value in policies[0].items()),
    }  # fmt: skip


def table(folder: Path) -> list[dict[str, str]]:
    path = folder / "metrics.csv"
    rows = csv.DictReader(path.read_text().splitlines()) if path.exists() else ()
    measured = ("seconds", "samples_per_second")
    return [{k: v for k, v in row.items() if "time" not in k and k not in measured} for row in rows]


# tables


def tables(rows: Sequence[Row]) -> list[Table]:
    parts: dict[str, list[Row]] = {}
    for row in rows:
        parts.setdefault(row.case["part"], []).append(row)
    chunks: dict[str, list[Row]] = {}
    for row in parts.get("faults", ()):
        chunks.setdefault(experiment.key({**row.case, "chunk": None}), []).append(row)
    every = [
        Table(
            "Faults reported where they were injected (one number if all were), other bits reported with them, and "
            "faults reported elsewhere; whether fault_counts agrees; steps with numbers that are not finite; steps of "
            "worlds without faults that were compared to the bit with an environment without faults, and the number "
            "of differences.",
            ["task", "worlds", "steps", *KINDS, "beside", "others", "counts agree", "not finite", "compared", "differ"],
            [fault_line(run) for run in chunks.values()],
        ),
        Table("Memory, MiB, and its growth, bytes per million steps: median over chunks and range.",
              ["task", "memory", "first", "most", "last", "growth"],
              [line for run in chunks.values() for line in growth_lines(run)]),
        Table("Uniformly random actions under the task's own physics: faults by reason, and the first fault.",
              ["task", "engine", "worlds", "steps", "steps/s", "faults", "first"],
              [random_line(row) for row in parts.get("random", ())]),
        Table("Bytes that remain allocated per environment that was made and deleted.",
              ["task", "device", "worlds", "made", "resident", "GPU"],
              [memory_line(row) for row in parts.get("memory", ())]),
        Table("Trainings that were killed and resumed, compared with an uninterrupted one.",
              ["training", "kills", "iterations", "equal metrics", "equal policy"],
              [kill_line(row) for row in parts.get("kills", ())]),
    ]  # fmt: skip
    return [table for table in every if table.rows]


def run_name(case: Mapping[str, Any]) -> str:
    deterministic = case["compared"] and case["device"] != "cpu"
    return f"{case['task']}, {case['device']}{', deterministic' * deterministic}"


def fault_line(run: Sequence[Row]) -> list[str]:
    """Add up the chunks of a run."""
    case, results = run[0].case, [row.result for row in run]
    counts = {
        name: sum((collections.Counter(result[name]) for result in results), collections.Counter())
        for name in ("injected", "found", "beside", "other")
    }
    sums = {name: sum(result[name] for result in results) for name in ("steps", "compared", "different", "not_finite")}
    injected, reported = counts["injected"], counts["found"]
    return [
        run_name(case), f"{case['nworld']:,}", f"{sums['steps']:.4g}",
        *(f"{reported[kind]:,}" + f" of {injected[kind]:,}" * (reported[kind] != injected[kind]) for kind in KINDS),
        text_of(counts["beside"]), text_of(counts["other"]), f"{all(result['counts_agree'] for result in results)}",
        f"{sums['not_finite']}", f"{sums['compared']:.4g}", f"{sums['different']}",
    ]  # fmt: skip


def growth_lines(run: Sequence[Row]) -> list[list[str]]:
    lines = []
    for column, kind in ((1, "resident"), (2, "GPU")):
        levels = [sample[column] / 2**20 for row in run for sample in row.result["memory"]]
        if any(levels):
            slopes = [round(1e6 * slope(row.result["memory"], column)) for row in run]
            lines.append([
                run_name(run[0].case), kind, f"{levels[0]:,.0f}", f"{max(levels):,.0f}", f"{levels[-1]:,.0f}",
                experiment.median_and_range(slopes, ",.0f"),
            ])  # fmt: skip
    return lines


def random_line(row: Row) -> list[str]:
    case, result = row.case, row.result
    engine = result.get("engine", case["engine"])  # the case may say "auto"
    first = "step {:,}, world {}: {}".format(*result["first"]) if result["first"] else ""
    return [case["task"], f"{engine}, {case['device']}", f"{case['nworld']}", f"{result['steps']:,}",
            f"{result['steps_per_second']:,.0f}", text_of(result["faults"]) or "none", first]  # fmt: skip


def memory_line(row: Row) -> list[str]:
    case, result = row.case, row.result
    return [case["task"], case["device"], f"{case['nworld']}", f"{case['made']}", f"{result['bytes_per_env']:,.0f}",
            f"{result['gpu_bytes_per_env']:,.0f}"]  # fmt: skip


def kill_line(row: Row) -> list[str]:
    numbers = (row.result[name] for name in ("kills", "iterations", "equal_rows", "equal_policy"))
    return [f"{row.case['task']} {row.case['words']}", *map(str, numbers)]


def text_of(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {number:,}" for name, number in counts.items() if number)


EXPERIMENT = Experiment(
    name="soak",
    conditions="Tasks run with exact physics, on the C engine or on the engine that a table names.",
    summary="Very long runs: injected faults, memory growth, and training runs that are killed and resumed.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
