"""Run tasks for very long with injected faults, watch the memory, and kill and resume trainings.

    lyceum-warp bench soak --threads 2
    lyceum-warp bench soak --parts faults --device cuda --work runs/soak

Part faults: worlds step under random actions, and every thousandth step of a world gets a fault. States that are
not-a-number or too fast, and actions that are not finite, come from outside. For the others the soak writes a variant
of the task beside a copy of its source (``VARIANT``): a further number of the action asks for a reward or an
observation that is not-a-number, or for a negative mass. Every fault must be found in its world and in its step,
nothing else may be found, and ``env.fault_counts`` must agree. A second environment without faults must have equal
numbers, to the bit, in each world up to its first fault, and in every fourth world, which gets none, always.

A run is divided into chunks. A chunk is one result, and ends with a file of the worlds' states in the folder
``--work``, from which the next chunk continues, also on another machine that gets this folder.

Part memory: environments are made and deleted. Part kills: trainings are killed and resumed, and must end like a
training that nothing interrupted.
"""

import csv
import dataclasses
import gc
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import experiment
import numpy as np
import torch
import warp as wp
from experiment import Experiment, Row, Skipped, Table

import lyceum_warp as lw
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.registry import find_task
from lyceum_warp.done import FAULTS, Done
from lyceum_warp.support.files import replaced
from lyceum_warp.support.validate import whole_number

PARTS = ("faults", "memory", "kills")
KINDS = ("state", "speed", "action", "reward", "observation", "model")
"""The faults by the place where they are injected."""
KIND_BITS = (Done.NAN, Done.NAN, Done.ACTION, Done.REWARD, Done.OBSERVATION, Done.MODEL)
EVERY = 16
"""Steps between two in which states are changed: as many more worlds get such a fault then."""
SAMPLES = 5
"""Samples of the memory in a chunk."""
CHUNKS = 10
TASKS = {
    "point_mass": (1024, 10**7, 4.0), "hopper": (512, 10**6, 120.0), "soft_ball": (256, 10**6, 250.0),
    "panda_lift": (256, 10**6, 200.0), "adroit_relocate": (256, 10**6, 280.0), "humanoid": (256, 10**6, 350.0),
    "go1_velocity": (256, 10**6, 420.0),
}  # fmt: skip
"""Worlds, steps of a chunk, and seconds for a million steps on two cores."""
GPU_TASKS = {"half_cheetah": (16_384, 10**8, 0.5)}
SAME_BITS = {"half_cheetah": (4096, 10**6, 20.0)}
"""The same in the deterministic mode, without which a GPU's numbers differ in the last bits from run to run."""
TRAININGS = {
    "hopper": ("--iterations", "400", "--nthread", "2"),
    "point_mass": ("--algorithm", "ppo", "--iterations", "300", "--nworld", "256", "--nthread", "2"),
}
SHORT_TRAINING = ("--algorithm", "ppo", "--iterations", "60", "--nworld", "8", "--nthread", "1", "--hidden", "8",
                  "--save-every", "5")  # fmt: skip

VARIANT = """

@wp.func
def soak_control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    {control}
    s.userdata[0] = action[action.shape[0] - 1]


@wp.func
def soak_observe(s: World, p: Params, obs: Row[float]{rng_argument}):
    observe(s, p, obs{rng})
    if s.userdata[0] == 5.0:
        obs[0] = wp.nan


@wp.func
def soak_reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if s1.userdata[0] == 4.0:
        return wp.nan
    return reward(s0, action, s1, p)


@wp.func
def soak_randomize(s: World, p: Params, rng: Row[wp.uint32]):
    randomize(s, p, rng)
    s.body_mass[1] = s.body_mass[1] * lw.uniform(rng, 0.95, 1.05)


@wp.func
def soak_event(s: World, p: Params, rng: Row[wp.uint32]):
    {event}
    if s.userdata[0] == 6.0:
        s.body_mass[1] = -1.0


class Soak({parent}):
    control, observe, reward = soak_control, soak_observe, soak_reward
    randomize, event = soak_randomize, soak_event
    actions, action_range = {{"action": {nact}, "fault": 1}}, None

    @staticmethod
    def edit_model(spec):
        {parent}.edit_model(spec)
        spec.nuserdata = 1
"""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Very long runs with injected faults, memory, and kills."""

    parts: tuple[str, ...] = ()
    """faults, memory, kills; by default all."""
    engine: str = "auto"
    """Engine of the part faults."""
    nworld: int | None = None
    """Worlds; by default the experiment's, which depend on the task."""
    steps: int | None = None
    """Steps of a chunk, of all worlds together; by default the experiment's."""
    kill_every: float = 40.0
    """Seconds of training between two kills, on average."""
    kills: int = 10
    """Kills of each training."""
    work: Path = Path("runs/soak")
    """Folder of tasks, states between two chunks, and trainings."""


@dataclasses.dataclass(frozen=True)
class Faults:
    """A chunk of a task's run."""

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
        """Return the file of the state before a chunk."""
        run = f"{self.task}-{self.engine}-{self.device.partition(':')[0]}-{self.nworld}-{self.steps}-{self.seed}"
        return work / f"{run}{'-same-bits' if self.compared else ''}-{chunk}.pt"


@dataclasses.dataclass(frozen=True)
class Memory:
    """Environments that are made and deleted."""

    task: str
    made: int
    nworld: int
    engine: str
    device: str
    part: str = "memory"


@dataclasses.dataclass(frozen=True)
class Kills:
    """A training that is killed and resumed."""

    task: str
    words: str
    kills: int
    kill_every: float
    seed: int
    part: str = "kills"


def cases(options: Options) -> list[Any]:
    parts, short, cuda = experiment.choose(options.parts, PARTS, what="part"), options.short, options.device != "cpu"
    known = (GPU_TASKS if cuda else TASKS) | dict.fromkeys(options.tasks, (256, 10**6, 100.0))
    tasks = experiment.choose(options.tasks, lw.task_names(), ("point_mass",) if short else tuple(known), what="task")
    runs = []
    for task in tasks:
        nworld, steps, _ = (64, 64 * 300, 0.0) if short else (GPU_TASKS if cuda else TASKS).get(task, known[task])
        runs.append((task, nworld, steps, not cuda))
    if cuda and not short and not options.tasks:
        runs += [(task, nworld, steps, True) for task, (nworld, steps, _) in SAME_BITS.items()]
    found: list[Any] = []
    seeds = options.seeds or (0,)
    for task, nworld, steps, compared in runs if "faults" in parts else ():
        nworld = whole_number("--nworld", options.nworld or nworld, low=8)
        steps = whole_number("--steps", options.steps or steps, low=nworld * SAMPLES)
        for seed in seeds:
            chunks = [Faults(task, chunk, steps, nworld, options.engine, options.device, compared,
                             1e-2 if short else 1e-3, seed) for chunk in range(2 if short else CHUNKS)]  # fmt: skip
            # a machine that gets another one's folder goes on from there
            done = max((i for i in range(1, len(chunks) + 1) if chunks[0].state(options.work, i).exists()), default=1)
            found += chunks[done - 1 :]
    if "memory" in parts:
        found.append(Memory("hopper", 10 if short else 100, 32, options.engine, options.device))
    for task, words in TRAININGS.items() if "kills" in parts and not cuda else ():
        if task in (tasks if short else TRAININGS):
            every, kills = (0.2, 1) if short else (options.kill_every, options.kills)
            found += [Kills(task, " ".join(SHORT_TRAINING if short else words), kills, every, seed) for seed in seeds]
    return found


def estimate(case: Any) -> float:
    if isinstance(case, Faults):
        table = SAME_BITS if case.compared and case.device != "cpu" else TASKS | GPU_TASKS
        return 5.0 + table.get(case.task, (0, 0, 100.0))[2] * case.steps / 1e6
    return 20.0 if isinstance(case, Memory) else 20.0 + 3.0 * case.kills * case.kill_every


def measure(case: Any, options: Options) -> dict[str, Any]:
    options.work.mkdir(parents=True, exist_ok=True)
    part = {"faults": inject, "memory": make_and_delete, "kills": kill}[case.part]
    return part(case, options)  # type: ignore[operator]


# faults


def variant(task: str, work: Path) -> str:
    """Write a task's variant, which does what the last number of its action asks for; return how to make it."""
    parent, plain = find_task(task), lw.make(task, nworld=1, engine="mujoco")
    file = Path(sys.modules[parent.__module__].__file__ or "")
    source = file.read_text().replace("@lw.register\n", "")
    models = r'"(\w+\.xml)"'
    source = re.sub(models, lambda m: repr(str(file.parent / m[1])) if (file.parent / m[1]).exists() else m[0], source)
    own = TaskSource(parent, task)
    fields = [f"    {name}: Row[float]\n" for name in ("userdata", "body_mass") if name not in own.world.vars]
    source = source.replace("class World:\n", "".join(["class World:\n", *fields]), 1)
    rng = len(own.functions["observe"].input_types) > 3
    source += VARIANT.format(
        parent=parent.__name__, nact=plain.action.shape[1],
        control="control(s, action, p, ctrl)" if own.functions["control"] else
                "for i in range(ctrl.shape[0]):\n        ctrl[i] = action[i]",
        event="event(s, p, rng)" if own.functions["event"] else "pass",
        rng=", rng" if rng else "", rng_argument=", rng: Row[wp.uint32]" if rng else "",
    )  # fmt: skip
    path = work / f"soak_{task}.py"
    if not path.exists() or path.read_text() != source:
        path.write_text(source)
    return f"{path}:Soak"


def bounds(task: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the range of random actions: of the controls, or of the task's own actions."""
    env = lw.make(task, nworld=1, engine="mujoco")
    low, high = env.action_space.low, env.action_space.high
    if env.task.functions["control"] is None:  # the variant does not scale
        low, high = np.where(env.model.actuator_ctrllimited[:, None], env.model.actuator_ctrlrange, np.inf).T
    low, high = (np.full(env.action.shape[1], np.inf) if bound is None else bound for bound in (low, high))
    bounded = np.isfinite(low) & np.isfinite(high)
    return np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)


@wp.kernel(enable_backward=False)
def draw(
    seed: int, step: int, rate: float, every: int, low: wp.array[float], high: wp.array[float],
    pending: wp.array[bool], row: wp.array[int], kind_out: wp.array[int], action_out: wp.array2d[float],
    twin_action_out: wp.array2d[float],
):  # fmt: skip
    """Draw actions, and faults that begin with this step: a function of seed, step and world; launched over (nworld,).

    Every fourth world gets no fault, nor does a world in which a fault waits to be found.
    """
    w = wp.tid()
    rng = wp.rand_init(int(wp.rand_init(seed, step)), w)
    place, share, kind = wp.randf(rng), rate * 4.0 / 18.0, wp.int32(0)
    for k in range(6):
        width = wp.where(k < 2, wp.where(step % every == 0, share * float(every), 0.0), share)
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
    bits: wp.array[int], row: wp.array[int], kind_in: wp.array[int], reason_in: wp.array[int], done_in: wp.array[bool],
    obs_in: wp.array2d[float], reward_in: wp.array[float], twin_reason_in: wp.array[int],
    twin_obs_in: wp.array2d[float], twin_reward_in: wp.array[float], pending_inout: wp.array[bool],
    clean_inout: wp.array[bool], injected_inout: wp.array2d[int], found_inout: wp.array2d[int],
    beside_inout: wp.array2d[int], other_inout: wp.array2d[int], outcome_inout: wp.array2d[int],
):  # fmt: skip
    """Count faults after a step, and compare clean worlds with those of the twin; launched over (nworld,)."""
    w = wp.tid()
    due = wp.where(pending_inout[w], 6, wp.where(kind_in[w] < 6, kind_in[w], 0))
    pending_inout[w] = kind_in[w] == 6 and not done_in[w]  # no event happens in a world that restarts
    own = wp.int32(0)
    if due > 0:
        own = bits[due - 1]
        injected_inout[w, due - 1] += 1
        if (reason_in[w] & own) != 0:
            found_inout[w, due - 1] += 1
    for bit in range(other_inout.shape[1]):
        if (reason_in[w] >> bit & 1) != 0:
            if due == 0:
                other_inout[w, bit] += 1
            elif (own >> bit & 1) == 0:
                beside_inout[w, bit] += 1
    if due > 0 or pending_inout[w]:
        clean_inout[w] = False
    same = bool(True)
    finite = wp.isfinite(reward_in[w])
    for i in range(obs_in.shape[1]):
        finite = finite and wp.isfinite(obs_in[w, i])
        if row[w] >= 0:
            same = same and obs_in[w, i] == twin_obs_in[row[w], i]
    if row[w] >= 0 and clean_inout[w]:
        same = same and reward_in[w] == twin_reward_in[row[w]] and reason_in[w] == twin_reason_in[row[w]]
        outcome_inout[w, 0] += 1
        if not same:
            outcome_inout[w, 1] += 1
    if not finite:
        outcome_inout[w, 2] += 1


def inject(case: Faults, options: Options) -> dict[str, Any]:
    """Step a task for a chunk with injected faults, beside a twin without any."""
    torch.set_num_threads(1)
    gc.collect()  # environments of the chunk before
    before = case.state(options.work, case.chunk)
    if case.chunk and not before.exists():
        raise Skipped(f"there is no {before}: give the folder in which chunk {case.chunk - 1} ran as --work")
    file, (low, high) = variant(case.task, options.work), bounds(case.task)
    words: dict[str, Any] = {
        "engine": case.engine,
        "device": case.device,
        "seed": case.seed,
        "nthread": options.threads,
    }
    if case.compared and case.device != "cpu":
        words["deterministic"] = True
    env = lw.make(file, nworld=case.nworld, **words)
    device, everyone = env.obs.device, torch.arange(case.nworld, device=env.obs.device)
    pending, clean = torch.zeros_like(env.done), torch.ones_like(env.done)
    kept = everyone[everyone % 4 == 3] if case.chunk else everyone  # of the twin
    if case.chunk:
        start = torch.load(before, map_location=device, weights_only=True)
        env.set_state(start["state"])
        pending, clean = start["pending"], start["clean"]
    row, twin = torch.full_like(everyone, -1, dtype=torch.int32), env
    if case.compared:
        row[kept] = torch.arange(len(kept), dtype=torch.int32, device=device)
        twin = lw.make(file, nworld=len(kept), **words)
        if case.chunk:
            twin.set_state(start["twin"])
        twin.action.zero_()
    counts = [torch.zeros(case.nworld, n, dtype=torch.int32, device=device) for n in (6, 6, 10, 10, 3)]
    injected, found, beside, other, outcome = counts
    kind = torch.zeros_like(row)
    limits = [torch.as_tensor(bound, dtype=torch.float32, device=device) for bound in (low, high)]
    bits = torch.tensor([int(bit) for bit in KIND_BITS], dtype=torch.int32, device=device)
    arrays = [wp.from_torch(x) for x in (*limits, pending, row, kind, env.action)]
    tallied = [wp.from_torch(x) for x in (
        bits, row, kind, env.done_reason, env.done, env.obs, env.reward, twin.done_reason, twin.obs, twin.reward,
        pending, clean, *counts,
    )]  # fmt: skip
    spare = torch.zeros_like(env.action)
    twin_action = wp.from_torch(twin.action if case.compared else spare)
    steps, samples = case.steps // case.nworld, []
    qpos, qvel = (env.state_space.parts[name].start for name in ("qpos", "qvel"))
    began = time.perf_counter()
    for t in range(steps):
        now = case.chunk * steps + t
        wp.launch(draw, case.nworld, [case.seed, now, case.rate, EVERY, *arrays, twin_action], device=env.device)
        if now % EVERY == 0 and (mask := (kind == 1) | (kind == 2)).any():
            state = env.get_state()
            state[kind == 1, torch.where(everyone % 2 == 0, qpos, qvel)[kind == 1]] = torch.nan
            state[kind == 2, qvel] = 1e11
            env.set_state(state, mask, check=False)
        env.step()
        if case.compared:
            twin.step()
        wp.launch(tally, case.nworld, tallied, device=env.device)
        if (t + 1) * SAMPLES // steps > t * SAMPLES // steps:
            samples.append([(t + 1) * case.nworld, *memory(device)])
    seconds = time.perf_counter() - began
    end = {"state": env.get_state(), "pending": pending, "clean": clean}
    different = int(outcome[:, 1].sum())
    if case.compared:
        last = twin.get_state()
        end["twin"] = last[kept % 4 == 3]
        different += int((end["state"][kept].view(torch.int64) != last.view(torch.int64)).any(1)[clean[kept]].sum())
    with replaced(case.state(options.work, case.chunk + 1)) as temporary:
        torch.save(end, temporary)
    case.state(options.work, case.chunk - 1).unlink(missing_ok=True)
    counted = env.fault_counts, sum(twin.fault_counts.values())
    named = {bit.name.lower(): bit.bit_length() - 1 for bit in FAULTS}  # type: ignore[union-attr]
    kinds = {name: dict(zip(KINDS, tensor.sum(0).tolist(), strict=True))
             for name, tensor in (("injected", injected), ("found", found))}  # fmt: skip
    result = kinds | {
        name: {fault: int(tensor[:, bit].sum()) for fault, bit in named.items() if tensor[:, bit].any()}
        for name, tensor in (("beside", beside), ("other", other))
    }
    expected = dict.fromkeys(named, 0)
    for name, bit in zip(KINDS, KIND_BITS, strict=True):
        expected[bit.name.lower()] += result["found"][name]  # type: ignore[union-attr]
    for more in (result["beside"], result["other"]):
        for fault, number in more.items():
            expected[fault] += number
    return result | {
        "counts_agree": expected == counted[0], "twin_faults": counted[1] if case.compared else 0,
        "compared": int(outcome[:, 0].sum()), "different": different, "not_finite": int(outcome[:, 2].sum()),
        "steps": steps * case.nworld, "memory": samples, "steps_per_second": steps * case.nworld / seconds,
    }  # fmt: skip


# memory


def memory(device: torch.device) -> tuple[int, int]:
    """Return the resident memory of this process and the used memory of its GPU, in bytes."""
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    if device.type == "cpu":
        return resident, 0
    free, total = torch.cuda.mem_get_info(device)
    return resident, total - free


def slope(samples: Sequence[Sequence[int]], column: int) -> float:
    """Return the growth of the memory per step, or per environment, without the first sample."""
    points = np.array(samples[1:], dtype=float)
    return float(np.polyfit(points[:, 0], points[:, column], 1)[0])


def make_and_delete(case: Memory, options: Options) -> dict[str, Any]:
    """Make, step and delete environments."""
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
    """Train without interruption, and with kills; compare."""
    folders = [options.work / f"{case.task}-{case.seed}-{name}" for name in ("straight", "killed")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    draws, lost, kills = random.Random(case.seed), 0, 0
    words = [*case.words.split(), "--seed", str(case.seed), "--no-video", "--no-plot"]
    program = [sys.executable, "-m", "lyceum_warp.cli", "train"]
    subprocess.run([*program, case.task, *words, "--out", str(folders[0])], check=True, stdout=subprocess.DEVNULL)
    killed, iterations = folders[1], words[words.index("--iterations") + 1]
    while True:
        resumes = (killed / "checkpoint.pt").exists()
        if not resumes and killed.exists():  # killed before its first save
            shutil.rmtree(killed)
            lost += 1
        how = ["--resume", str(killed), "--iterations", iterations, "--no-video", "--no-plot"]
        begun = len(table(killed)) if resumes else 0
        process = subprocess.Popen([*program, *(how if resumes else [case.task, *words, "--out", str(killed)])],
                                   stdout=subprocess.DEVNULL)  # fmt: skip
        try:
            while process.poll() is None and len(table(killed)) <= begun:
                time.sleep(0.05)
            if kills < case.kills:
                process.wait(case.kill_every * draws.uniform(0.5, 1.5))
            else:
                process.wait()
        except subprocess.TimeoutExpired:
            kills += 1
        finally:
            process.kill()
        if (code := process.wait()) >= 0:
            break
    rows = [table(folder) for folder in folders]
    policies = [lw.load(folder).state_dict() for folder in folders]
    same = policies[0].keys() == policies[1].keys() and all(torch.equal(policies[0][k], policies[1][k])
                                                            for k in policies[0])  # fmt: skip
    return {"kills": kills, "begun_again": lost, "exit_code": code, "iterations": len(rows[0]),
            "equal_rows": rows[0] == rows[1], "equal_policy": same}  # fmt: skip


def table(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics.csv without measured times."""
    if not (folder / "metrics.csv").exists():
        return []
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    measured = ("seconds", "samples_per_second")
    return [{k: v for k, v in row.items() if "time" not in k and k not in measured} for row in rows]


# tables


def tables(rows: Sequence[Row]) -> list[Table]:
    yes = {True: "yes", False: "NO"}
    faults, grown = [], []
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.case["part"] == "faults":
            same_run = {name: value for name, value in row.case.items() if name != "chunk"}
            groups.setdefault(experiment.key(same_run), []).append(row)
    for group in groups.values():
        case, results = group[0].case, [row.result for row in group]
        total = sum(result["steps"] for result in results)
        cells = []
        for kind in KINDS:
            injected, found = (sum(result[name][kind] for result in results) for name in ("injected", "found"))
            cells.append(f"{found:,}" if found == injected else f"{found:,} of {injected:,}")
        other = sum(sum(result["other"].values()) for result in results)
        compared, different, infinite = (sum(result[name] for result in results)
                                         for name in ("compared", "different", "not_finite"))  # fmt: skip
        name = f"{case['task']}, {'CPU' if case['device'] == 'cpu' else 'GPU'}"
        if case["compared"] and case["device"] != "cpu":
            name += ", deterministic"
        agree = yes[all(result["counts_agree"] for result in results)]
        faults.append([name, f"{case['nworld']:,}", f"{total:.3g}", *cells, str(other), agree, str(infinite),
                       f"{compared:.3g}", str(different)])  # fmt: skip
        for column, what in ((1, "resident"), (2, "GPU")):
            slopes = [1e6 * slope(result["memory"], column) for result in results]
            levels = [result["memory"][k][column] / 2**20 for result in results for k in range(SAMPLES)]
            if max(levels) > 0:
                grown.append([name, what, f"{levels[0]:,.0f}", f"{max(levels):,.0f}", f"{levels[-1]:,.0f}",
                              experiment.median_and_range(slopes, ",.0f")])  # fmt: skip
    made = [[row.case["task"], str(row.case["nworld"]), str(row.case["made"]), row.case["device"],
             f"{row.result['bytes_per_env']:,.0f}", f"{row.result['gpu_bytes_per_env']:,.0f}"]
            for row in rows if row.case["part"] == "memory"]  # fmt: skip
    kills = [[f"{row.case['task']} {row.case['words']}", str(row.result["kills"]), str(row.result["begun_again"]),
              str(row.result["iterations"]), yes[row.result["equal_rows"]], yes[row.result["equal_policy"]]]
             for row in rows if row.case["part"] == "kills"]  # fmt: skip
    return [
        Table("Faults found, of those injected (one number if all were found); other faults; whether fault_counts "
              "agrees; steps with numbers that are not finite; steps of worlds without faults that were compared to "
              "the bit, and how many differed.",
              ["task", "worlds", "steps", *KINDS, "other", "counts agree", "not finite", "compared", "different"],
              faults),
        Table("Memory: MiB at the beginning, at most and at the end; bytes per million steps, median over chunks and "
              "range.", ["task", "memory", "first", "most", "last", "growth"], grown),
        Table("Environments made and deleted: bytes that stay for each.",
              ["task", "worlds", "made", "device", "resident", "GPU"], made),
        Table("Trainings that were killed and resumed, beside one that was not interrupted.",
              ["training", "kills", "begun again", "iterations", "equal metrics", "equal policy"], kills),
    ]  # fmt: skip


EXPERIMENT = Experiment(
    name="soak", summary="Very long runs with injected faults, memory, and trainings that are killed and resumed.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
