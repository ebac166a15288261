"""Damage the files of runs, saved episodes, models and tables at random, and read them.

A case is "KIND SEED" or the name of a case in ``minimal_cases.py``.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import io
import json
import re
import shutil
import tomllib
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

import guarded
import mutations
import numpy as np
import tiny_task
import torch
from arbitrary_models import ARM, MOTOR, text
from guarded import ProblemError
from minimal_cases import FILES
from motion_files import go1, go1_clip, write_csv, write_npz, write_pickle

import lyceum_warp as lw
import lyceum_warp.cli.view
from lyceum_warp import cli
from lyceum_warp.cli.parsing import parse
from lyceum_warp.cli.sweep import Search, trial_settings
from lyceum_warp.cli.train import Train
from lyceum_warp.controllers import episode_env, load_episodes
from lyceum_warp.training import Run, flag_words
from lyceum_warp.viz.video import NoVideoError

REFUSALS = (ValueError, OSError, ImportError, NoVideoError, FloatingPointError)
"""The documented errors for invalid files and arguments."""
BASE, CASE, CANARY = Path("base").absolute(), Path("case").absolute(), Path("canary").absolute()

TASK = tiny_task.changed(
    ("    dt: float", "    dt: float\n    motion: wp.array2d[float] = [[0.0, 1.0]]"),
    ("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0]\n    obs[1] = p.motion[0, 1]"),
    ("hopper.xml", "slide.xml"),
    ('obs = {"x": 1}', 'obs = {"x": 1, "reference": 1}\n    horizon = 8'),
)
SLIDE = text(
    ARM,
    f'<default><geom density="500"/><default class="ball"><geom rgba="1 0 0 1"/></default></default>{MOTOR}'
    '<sensor><framepos objtype="site" objname="tip"/></sensor><keyframe><key name="home" qpos=".1 .2"/></keyframe>',
)
SIZES = "--samples 16 --nworld 2 --hidden 4 --value-hidden 4 --mean-every 2 --mean-episodes 2 --no-video --no-plot"


SWEEP = """
task = "point_mass"
trials = 3
out = "case/sweep"
settings = { iterations = 2, hidden = [4] }
[ranges]
gamma = { low = 0.9, high = 0.99 }
samples = { low = 16, high = 64, log = true }
value_hidden = { choices = [[4], [8, 8]] }
"param.success_distance" = { low = 0.1, high = 0.2 }
"""


@dataclasses.dataclass(frozen=True)
class Kind:
    file: str
    mutate: Callable[[bytes, Random], bytes]
    readers: tuple[str, ...]
    names: tuple[str, ...] = ()
    """Words that an error may contain instead of the file's name."""


_checkpoint = functools.partial(mutations.mutated_checkpoint, canary=CANARY)
_episode = functools.partial(mutations.mutated_episode, canary=CANARY)
_table = functools.partial(mutations.mutated_table, canary=CANARY)


KINDS = {
    "config.json": Kind(
        "run/config.json", mutations.mutated_json, ("open", "eval", "resume", "from", "view"), ("trained by",)
    ),
    "kept config.json": Kind(
        "kept/config.json", mutations.mutated_json, ("eval kept", "resume kept", "from kept"), ("trained by",)
    ),
    "metrics.csv": Kind("run/metrics.csv", mutations.mutated_csv, ("open", "resume")),
    "policy.pt": Kind("run/policy.pt", _checkpoint, ("load", "load", "eval", "view", "from")),
    "best.pt": Kind("run/best.pt", _checkpoint, ("load best", "resume", "from best")),
    "evaluation.json": Kind("run/evaluation.json", mutations.mutated_json, ("eval",)),
    "checkpoint.pt": Kind("run/checkpoint.pt", _checkpoint, ("resume alone",)),
    "previous.pt": Kind("run/previous.pt", _checkpoint, ("resume previous",), ("checkpoint.pt",)),
    "teacher.pt": Kind("cloned/teacher.pt", _checkpoint, ("resume cloned",)),
    "episode.npz": Kind("episodes/episode-000.npz", _episode, ("episodes", "view episodes")),
    "kept model": Kind("kept/task/slide.xml", mutations.mutated_xml, ("eval kept",), ("the task 'tiny'",)),
    "kept table": Kind("kept/task/tables/motion.npy", _table, ("eval kept",)),
    "model.xml": Kind("model.xml", mutations.mutated_xml, ("make", "new"), ("the task 'tiny'",)),
    "task.py": Kind("slide.py", mutations.mutated_task, ("make file", "check"), ("the task 'tiny'",)),
    "fit.json": Kind("fit/fit.json", mutations.mutated_json, ("fitted",), ("the task 'tiny'",)),
    "log.csv": Kind("log.csv", mutations.mutated_csv, ("log",), ("the column", "times", "the log", "window")),
    "table.npy": Kind("table.npy", _table, ("table",)),
    "clip.npz": Kind("clips/clip.npz", functools.partial(_episode, main="joint_pos"), ("clips",)),
    "clip.csv": Kind("clips/clip.csv", mutations.mutated_csv, ("clips",)),
    "clip.pkl": Kind("clips/clip.pkl", functools.partial(mutations.mutated_pickle, canary=CANARY), ("clips",)),
}  # fmt: skip
if importlib.util.find_spec("optuna") is not None:
    KINDS["sweep.toml"] = Kind("sweep.toml", mutations.mutated_toml, ("sweep",), ("the range", "lyceum-warp train"))


def _both(run: Path, which: str = "last") -> None:
    for load in (lw.load, lw.load_value):
        load(run, which=which)


def _resume(run: Path, *task: Path) -> None:
    command("train", *task, "--resume", run, "--iterations", "3", "--no-video", "--no-plot")


def _episodes(path: Path) -> None:
    episodes = load_episodes(path)
    env = episode_env(episodes)
    for episode in episodes.values():
        env.set_state(episode.states[:1])


def _sweep(file: Path) -> None:
    """Read a sweep's file and the options of its first trial, without training."""
    import optuna

    try:
        search, trial = Search(**tomllib.loads(file.read_text())), optuna.create_study().ask()
    except (TypeError, ValueError) as error:  # as the command does
        raise ValueError(f"{file}: {error}") from error
    parse(Train, "lyceum-warp train", [search.task, *flag_words(trial_settings(search, trial))])


READERS: dict[str, Callable[[], object]] = {
    "open": lambda: (Run.open(CASE / "run").task_name, Run.open(CASE / "run").rows()),
    "load": lambda: _both(CASE / "run"),
    "load best": lambda: _both(CASE / "run", "best"),
    "eval": lambda: command("eval", CASE / "run", "--episodes", 2),
    "eval kept": lambda: command("eval", CASE / "kept", "--task", _COPY, "--episodes", 2),
    "view": lambda: command("view", CASE / "run", "--nworld", 1),
    "resume": lambda: _resume(CASE / "run"),
    "resume cloned": lambda: _resume(CASE / "cloned"),
    "resume alone": lambda: _resume(CASE / "run"),
    "resume previous": lambda: _resume(CASE / "run"),
    "resume kept": lambda: _resume(CASE / "kept", _COPY),
    "from": lambda: command("train", "--from", CASE / "run", *_NEW),
    "from best": lambda: command("train", "--from", CASE / "run", "--which", "best", *_NEW),
    "from kept": lambda: command("train", _COPY, "--from", CASE / "kept", *_NEW),
    "episodes": lambda: _episodes(CASE / "episodes"),
    "view episodes": lambda: command("view", CASE / "episodes"),
    "make": lambda: lw.make(SLIDE_PY, model=CASE / "model.xml").step(),
    "new": lambda: command("new", "case/my_new_task", "--model", CASE / "model.xml"),
    "make file": lambda: lw.make(CASE / "slide.py").step(),
    "check": lambda: command("check", CASE / "slide.py", "--nworld", 2, "--steps", 2, "--rule", "reset"),
    "fitted": lambda: lw.make(SLIDE_PY, fitted=CASE / "fit", fitted_draws=True).step(),
    "log": lambda: lw.fit(CASE / "model.xml", CASE / "log.csv", ["delay.ctrl.*"], samples=0, iterations=1, nthread=1),
    "table": lambda: lw.make(SLIDE_PY, motion=CASE / "table.npy").step(),
    "sweep": lambda: _sweep(CASE / "sweep.toml"),
    "clips": lambda: lw.load_clips(CASE / "clips", go1()),
}  # fmt: skip
WITHOUT = {"resume alone": "run/previous.pt", "resume previous": "run/checkpoint.pt"}
"""Files that a case deletes first, so that the command must read another file."""
SLIDE_PY = str(BASE / "slide.py")
_COPY = CASE / "kept/task/slide.py"
_NEW = ("--out", "case/new", "--iterations", "1", "--no-video", "--no-plot")


class RefusedError(Exception):
    """Raised for a command that exited with 2 and printed one line to stderr."""


def command(*words: object) -> None:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([str(word) for word in words])
    lines = [line for line in err.getvalue().splitlines() if line.startswith("lyceum-warp: ")]
    if code == 2:
        raise RefusedError(lines[-1] if lines else "the command printed no line to stderr")
    if code not in (0, 130):
        raise ProblemError(f"{words[0]} ended with {code}: {err.getvalue()[-300:]}")


def attack(case: str) -> None:
    if case in FILES:
        read(*FILES[case])
        return
    name = case.rpartition(" ")[0]
    random = Random(case)
    kind = KINDS[name]
    read(name, random.choice(kind.readers), lambda data: kind.mutate(data, random))


def read(name: str, reader: str, change: Callable[[bytes], bytes]) -> bool:
    """Change a file, and read it. Return False if the reader refuses the file."""
    kind = KINDS[name]
    shutil.rmtree(CASE, ignore_errors=True)
    shutil.copytree(BASE, CASE)
    file = CASE / kind.file
    file.write_bytes(change(file.read_bytes()))
    if reader in WITHOUT:
        (CASE / WITHOUT[reader]).unlink()
    before = content(CASE)
    error: BaseException | None = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            READERS[reader]()
        except ProblemError as problem:
            raise ProblemError(f"{name}, {reader}: {problem}") from problem
        except (*REFUSALS, RefusedError) as refused:
            error = refused
        except KeyboardInterrupt:
            raise
        except BaseException as failure:
            raise ProblemError(f"{name}, {reader}", failure) from failure
    if CANARY.exists():
        CANARY.unlink()
        raise ProblemError(f"{name}, {reader}: code in the file was executed")
    if error is not None:
        _check_refusal(f"{name}, {reader}", kind, error, before)
    return error is None


def _check_refusal(where: str, kind: Kind, error: BaseException, before: Mapping[str, bytes]) -> None:
    # only MuJoCo's compiler knows how much memory a model needs
    if guarded.out_of_memory(error) and "MuJoCo refuses the model" not in str(error):
        raise ProblemError(f"{where}: reading takes too much memory", error)
    if not any(name in str(error) for name in (Path(kind.file).name, *kind.names)):
        raise ProblemError(f"{where}: the message does not name the file", error)
    after = content(CASE)
    changed = [name for name in before | after if before.get(name) != after.get(name)]
    if changed:
        raise ProblemError(f"{where}: the file was rejected, but the reader changed {', '.join(changed)}", error)


def content(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def warm_up() -> None:
    lyceum_warp.cli.view.view = lambda *args, **options: None  # no window
    torch.set_num_threads(1)
    if not BASE.exists():
        making = BASE.with_name("making")
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir()
        _make(making)
        making.rename(BASE)
    for reader, name in {reader: name for name, kind in KINDS.items() for reader in kind.readers}.items():
        assert read(name, reader, lambda data: data), f"{reader} fails without damage"


def _make(folder: Path) -> None:
    (folder / "slide.py").write_text(TASK)
    (folder / "slide.xml").write_text(SLIDE)
    (folder / "model.xml").write_text(SLIDE)
    (folder / "sweep.toml").write_text(SWEEP)
    (folder / "clips").mkdir()
    qpos = go1_clip()[:20]
    write_npz(folder / "clips/clip.npz", go1(), qpos, 50.0)
    write_csv(folder / "clips/clip.csv", qpos)
    write_pickle(folder / "clips/clip.pkl", qpos, 50.0)
    np.save(folder / "table.npy", np.linspace(0.0, 1.0, 80, dtype=np.float32).reshape(40, 2))
    times = 0.01 * np.arange(60)
    control = np.sin(9.0 * times)
    rows = np.stack([times, control, 0.1 * np.sin(8.0 * times), 0.1 * np.cos(7.0 * times)], axis=1).round(4)
    names = ["ctrl.push", "qpos.hinge", "qvel.hinge"]
    (folder / "log.csv").write_text("\n".join(",".join(map(str, row)) for row in [["time", *names], *rows.tolist()]))
    (folder / "fit").mkdir()
    fields = {"dof_damping": {"hinge": [0.1]}}
    content = {"format": 1, "fields": fields, "delays": {}, "names": ["a"], "value": [1.0], "low": [0.5], "high": [2.0]}
    (folder / "fit/fit.json").write_text(json.dumps(content | {"determined": [True]}))
    np.savez(folder / "fit/draws.npz", **{"dof_damping.hinge": np.full((4, 1), 0.1)})
    options = [*SIZES.split(), "--iterations", "2", "--keep-every", "1"]
    options = [*SIZES.split(), "--iterations", "2", "--keep-every", "1", "--evaluate"]
    command("train", "point_mass", "--horizon", "8", "--out", folder / "run", *options)
    motion = f"motion={folder / 'table.npy'}"
    command("train", folder / "slide.py", "--out", folder / "kept", "--param", motion, *options)
    for run in ("run", "kept"):  # round measured times, so that all files have the same length
        path = folder / run / "metrics.csv"
        path.write_text(re.sub(r"\d+\.\d{9,}", lambda found: found[0][:8], path.read_text()))
    config = json.loads((folder / "kept/config.json").read_text())
    # the original files are missing, so a command must read the copies in the run
    config |= {"task": "/nowhere/slide.py", "params": {"motion": "/nowhere/table.npy"}}
    (folder / "kept/config.json").write_text(json.dumps(config, indent=2))
    plant = lw.make("point_mass", autoreset=False, horizon=4)
    episode = lw.control(plant, lambda state, obs: torch.zeros(2), seed=1)
    times = {name: torch.zeros_like(getattr(episode, name)) for name in ("times", "ages", "plan_times", "plan_starts")}
    dataclasses.replace(episode, wall_seconds=1.0, **times).save(folder / "episodes/episode-000.npz")
    cloning = (
        "--algorithm distill --nworld 2 --num-steps 12 --hidden 4 --mean-every 0 --iterations 2 --no-video --no-plot"
    )
    places = "--demonstrations", folder / "episodes", "--out", folder / "cloned"
    command("train", "point_mass", *cloning.split(), *places)


if __name__ == "__main__":
    guarded.serve(attack, warm_up)
