"""Render the gallery: MUJOCO_GL=egl python docs/gallery.py [--runs FOLDER] [TASK ...].

If FOLDER contains a run, its policy controls the run's task. Otherwise, a pretrained policy does. MPPI controls the
other tasks. The program writes animations and results into docs/images/gallery/, and then the page gallery.md. By
default, it renders all tasks; with --page, it only writes the page.

The site's build imports this file to write still pictures and pages with turnable robots.
"""

import argparse
import copy
import dataclasses
import functools
import io
import json
import re
import textwrap
from pathlib import Path
from typing import Any

import mujoco
import torch
from PIL import Image

import lyceum_warp as lw
from lyceum_warp.binding import file_name, find_task
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.training import ALGORITHMS, Run, learned_physics, pretrained_tasks
from lyceum_warp.viz import CameraChoice, FreeCamera, write_page
from lyceum_warp.viz.cameras import camera_values
from lyceum_warp.viz.render import Painter
from lyceum_warp.viz.video import shots

DOCS = Path(__file__).resolve().parent
FOLDER = DOCS / "images" / "gallery"
RESULTS = FOLDER / "results.json"
PRETRAINED = Path(lw.__file__).parent / "pretrained"

SIZE, SCALE = (208, 156), 2  # pixels; frames are rendered larger and then scaled down, which smooths edges
RATE = 12.5  # frames per second
LARGEST = 80_000  # bytes of an animation


@dataclasses.dataclass(frozen=True)
class Show:
    """Settings for the animation of a task."""

    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the planner and options of its worlds."""
    params: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Task parameters of the planner's worlds."""
    replan_every: int = 1
    """Steps between two plans."""
    seconds: float = 4.0
    """The maximum length of the animation, in simulated seconds."""
    start: float = 0.0
    """The simulated time of the animation's first frame, in seconds."""
    seed: int = 0
    camera: CameraChoice = None


QUADRUPED = FreeCamera(track=1, distance=5.0, azimuth=135.0, elevation=-20.0)

HAND = FreeCamera(lookat=(0.12, 0.04, 0.0), distance=0.5, azimuth=160.0, elevation=-40.0)

SHOWS = {
    "adroit_door": Show(
        seconds=1.2, replan_every=2,
        camera=FreeCamera(lookat=(0.1, 0.0, 0.2), distance=1.6, azimuth=120.0, elevation=-25.0),
    ),
    "adroit_hammer": Show(
        seconds=1.2, replan_every=2,
        camera=FreeCamera(lookat=(0.0, 0.0, 0.15), distance=1.1, azimuth=60.0, elevation=-25.0),
    ),
    "adroit_pen": Show(seconds=1.5, replan_every=2),
    "leap_objects": Show(seconds=4.0, seed=1, camera=HAND),
    "leap_reorient": Show(seconds=4.0, camera=HAND),
    "leap_rotate": Show(seconds=4.0, camera=HAND),
    "adroit_relocate": Show(
        seconds=2.0, replan_every=2,
        camera=FreeCamera(lookat=(0.0, 0.0, 0.2), distance=1.2, azimuth=90.0, elevation=-30.0),
    ),
    "aloha_lift": Show(
        start=1.6, seconds=2.4, replan_every=2, camera=FreeCamera(lookat=(0.0, 0.0, 0.15), distance=1.3)
    ),
    "ant": Show(
        {"horizon": 40, "knots": 6, "noise": 0.4, "temperature": 1.0}, start=1.5, seconds=2.5,
        camera=FreeCamera(track=1, distance=3.5, azimuth=90.0, elevation=-8.0),
    ),
    "arm_hand_pickup": Show(replan_every=2),
    "dm/acrobot_swingup": Show(start=2.0, seconds=3.0, seed=1),
    "dm/acrobot_swingup_sparse": Show(start=3.5, seconds=3.0, seed=1),
    "dm/ball_in_cup_catch": Show(seconds=2.5),
    "dm/cartpole_balance": Show(seconds=2.5),
    "dm/cartpole_swingup_sparse": Show(
        {"horizon": 100, "knots": 12, "noise": 0.5, "temperature": 0.5}, {"sparse": False}, start=1.0, seconds=4.0
    ),
    "dm/cheetah_run": Show({"horizon": 40}, start=1.0, seconds=2.5, replan_every=2),
    "dm/fish_upright": Show(seconds=3.0, camera=FreeCamera(track=1, distance=0.6, elevation=-30.0)),
    "dm/hopper_hop": Show({"horizon": 60, "knots": 8, "noise": 0.7, "temperature": 0.1}, seconds=2.4),
    "dm/hopper_stand": Show({"horizon": 50, "knots": 6, "noise": 0.7, "temperature": 0.05}),
    "dm/humanoid_run": Show({"update": "cem", "horizon": 40, "knots": 5, "noise": 0.4}),
    "dm/humanoid_stand": Show({"update": "cem", "horizon": 40, "knots": 5, "noise": 0.4}, seconds=3.6),
    "dm/humanoid_walk": Show(start=13.0, seconds=3.0, camera=FreeCamera(track=1, distance=4.5, elevation=-10.0)),
    "dm/manipulator_bring_ball": Show(
        {"horizon": 32, "knots": 5, "noise": 0.5, "temperature": 0.05}, {"close": 0.1}, seconds=2.5, seed=12,
        camera=FreeCamera(lookat=(0.0, 0.0, 0.5), distance=1.1, azimuth=90.0, elevation=-5.0),
    ),
    "dm/pendulum_swingup": Show(
        {"horizon": 150, "knots": 12, "noise": 1.0, "temperature": 1.0}, {"largest_angle": 130}, start=5.0, seconds=6.0
    ),
    "dm/point_mass_easy": Show(seconds=3.0),
    "dm/quadruped_run": Show(
        {"horizon": 40, "knots": 6, "noise": 0.5, "temperature": 0.1}, replan_every=2, camera=QUADRUPED
    ),
    "dm/quadruped_walk": Show(seed=8, camera=QUADRUPED),
    "dm/reacher_easy": Show(seconds=2.0, camera=FreeCamera(lookat=(0.0, 0.0, 0.0), distance=0.8, elevation=-90.0)),
    "dm/reacher_hard": Show(seconds=2.0, camera=FreeCamera(lookat=(0.0, 0.0, 0.0), distance=0.8, elevation=-90.0)),
    "dm/swimmer_swimmer15": Show(
        {"horizon": 50, "knots": 8, "noise": 0.7, "temperature": 0.02, "timestep": 0.01, "frame_skip": 3},
        {"target_size": 1.0}, start=3.0, seconds=5.0, replan_every=2,
        camera=FreeCamera(lookat=(0.5, -0.7, 0.0), distance=2.6, azimuth=90.0, elevation=-89.0),
    ),
    "dm/walker_run": Show(start=2.0, seconds=3.0),
    "dm/walker_stand": Show(seconds=3.0),
    "dm/walker_walk": Show(start=1.0, seconds=3.0),
    "half_cheetah": Show(start=0.5, seconds=3.0),
    "hopper": Show(start=1.0, seconds=2.5, replan_every=4),
    **{f"g1_{name}": Show(seconds=3.0, camera=FreeCamera(track=1, distance=2.8, azimuth=135.0, elevation=-15.0))
       for name in ("stand", "walk")},
    "humanoid": Show(
        {"horizon": 48, "knots": 6, "noise": 0.25, "temperature": 1.0}, start=1.0, seconds=1.8,
        camera=FreeCamera(track=1, distance=4.2, azimuth=90.0, elevation=-8.0),
    ),
    "humanoid_get_up": Show(seconds=3.0),
    "humanoid_stand": Show(seconds=3.0),
    "humanoid_standup": Show(
        {"horizon": 40, "knots": 5, "noise": 0.3, "temperature": 20.0, "integrator": "implicitfast", "timestep": 0.015,
         "frame_skip": 1}, seconds=3.0, replan_every=2,
        camera=FreeCamera(lookat=(1.0, 0.0, 0.7), distance=4.2, azimuth=90.0, elevation=-10.0),
    ),
    "humanoid_walk": Show(seconds=3.0),
    "inverted_pendulum": Show(seconds=2.5),
    "inverted_double_pendulum": Show(
        seconds=2.5, camera=FreeCamera(lookat=(0.0, 0.0, 0.5), distance=3.0, azimuth=90.0, elevation=-10.0)
    ),
    "panda_lift": Show(replan_every=2),
    "point_mass": Show(seconds=3.0),
    "soft_ball": Show(
        {"samples": 128, "horizon": 40, "knots": 5, "noise": 0.6, "temperature": 0.3}, start=0.6, seconds=2.4,
        replan_every=2,
    ),
    "swimmer": Show(start=1.0, seconds=3.0),
    "walker2d": Show(start=1.0, seconds=2.5),
    **{f"{robot}_velocity": Show(start=1.0, seconds=3.2, camera=FreeCamera(track=1, distance=distance, azimuth=135.0,
                                                                           elevation=-15.0))
       for robot, distance in (("go1", 1.7), ("go1_rough", 2.2), ("spot", 2.6), ("g1", 2.8), ("g1_full", 2.8),
                               ("g1_rough", 3.2), ("h1", 3.6), ("t1", 2.8))},
}  # fmt: skip
"""Maps a task's name to its settings. Other tasks use the defaults."""

# these tasks have no policy, and under a planner the robots soon fall
for _name in ("g1_full_velocity", "g1_rough_velocity"):
    _settings = {"horizon": 32, "samples": 48, "knots": 5, "noise": 0.1, "temperature": 0.02}
    SHOWS[_name] = dataclasses.replace(SHOWS[_name], settings=_settings, replan_every=2, start=0.0, seconds=1.6)


def render(name: str, run: Path | None) -> dict[str, str]:
    """Render a task's animation, and return its command and its result."""
    show = SHOWS.get(name, Show())
    env = lw.make(name, autoreset=False)
    steps = min(env.horizon or 10**9, round((show.start + show.seconds) / env.timestep))
    if run is None:
        states, result = planned(env, show, steps)
        flags = show.settings | ({"replan-every": show.replan_every} if show.replan_every > 1 else {})
        flags |= {"seed": show.seed} if show.seed else {}
        command = f"lyceum-warp plan {name}{written(flags)}"
        command += "".join(f" --planner-param {param}={value}" for param, value in show.params.items())
    else:
        policy = lw.load(run)
        states = acted(env, policy, show, steps)
        config = json.loads((run / "config.json").read_text())
        if "evaluated" in config:
            mean = config["evaluated"]["return"]
        else:
            mean = lw.evaluate(lw.make(name, nworld=16), policy, 16, seed=0).returns.mean().item()
        result = f"{config['algorithm'].upper()}: return {number(mean)}"
        command = f"lyceum-warp view {name} --pretrained" if run.parent == PRETRAINED else training(name, run, config)
    save(pictures(env, states[round(show.start / env.timestep) :], show), FOLDER / f"{file_name(name)}.webp")
    return {"command": command, "result": result}


def training(name: str, run: Path, config: dict[str, Any]) -> str:
    """Return the command that repeats a run. It contains every flag that affects the policy."""
    algorithm = config["algorithm"]
    rows = (run / "metrics.csv").read_text().splitlines()
    flags = {"algorithm": algorithm} | ({"device": "cuda"} if config["device"].startswith("cuda") else {})
    flags |= {"nworld": config["nworld"]} if algorithm == "sac" else {}
    flags |= {"iterations": rows[-1].partition(",")[0]} | ({"seed": config["seed"]} if config["seed"] else {})
    suggested = find_task(name).training
    default = ALGORITHMS[algorithm][1](**(suggested.settings if suggested.algorithm == algorithm else {}))
    if isinstance(default, lw.SACConfig):
        default = default.resolved(config["nworld"])
    defaults = json.loads(json.dumps(vars(default)))
    flags |= {
        flag: value for flag, value in config[algorithm].items()
        if flag != "mean_every" and defaults[flag] not in (None, value)
    }  # fmt: skip
    return f"lyceum-warp train {name}{written(flags)}"


def written(flags: dict[str, Any]) -> str:
    """Write settings as command-line flags, each preceded by a space."""
    text = ""
    for name, value in flags.items():
        flag = name.replace("_", "-")
        text += f" --{'no-' * (value is False)}{flag}" if isinstance(value, bool) else f" --{flag} {value}"
    return text


def planned(env: lw.Env, show: Show, steps: int) -> tuple[torch.Tensor, str]:
    """Control an episode by a planner, and return its states and its result."""
    plan = lw.MPPI(env.task.name, seed=show.seed, params=show.params, **show.settings)
    trajectory = lw.control(env, plan, steps=steps, seed=show.seed, replan_every=show.replan_every)
    seconds, planner = trajectory.steps * env.timestep, plan.settings["update"].upper()
    if trajectory.succeeded:
        return trajectory.states, f"{planner}: success within {seconds:.2g} s"
    return trajectory.states, f"{planner}: return {number(trajectory.rewards.sum().item())} in {seconds:.2g} s"


@torch.no_grad()
def acted(env: lw.Env, policy: Any, show: Show, steps: int) -> torch.Tensor:
    """Return an episode's states under a policy, without pushes."""
    env.rand_reset(seed=show.seed)
    state = env.get_state()
    parts = env.state_space.split(state)
    if "drawn_velocity" in parts:
        parts["drawn_velocity"][:] = torch.tensor([0.8, 0.0, 0.0])
        parts["heading_controlled"][:], parts["standing"][:] = 0.0, 0.0
        parts["command_timer"][:], parts["push_timer"][:] = 1e6, 1e6
        env.set_state(state)
    states = []
    for _ in range(steps):
        states.append(env.get_state()[0])
        env.action.copy_(policy.act(env.obs))
        env.step()
        if env.done.item():
            break
    return torch.stack(states)


def pictures(env: lw.Env, states: torch.Tensor, show: Show) -> list[Image.Image]:
    """Render states at the gallery's frame rate."""
    model = copy.copy(env.model)  # the painter sets each world's model fields
    size = (SCALE * SIZE[0], SCALE * SIZE[1])
    painter = Painter(mujoco, model, size, camera_values(model, show.camera))
    steps = [round(i / RATE / env.timestep) for i in range(int(len(states) * env.timestep * RATE) or 1)]
    images = [painter.render(shot) for shot in shots(env, states[steps])]
    return [Image.fromarray(picture).resize(SIZE, Image.Resampling.LANCZOS) for picture in images]


def save(images: list[Image.Image], path: Path) -> None:
    """Write an animation in the best quality within the size limit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for quality in (80, 65, 50, 35, 20):
        file = io.BytesIO()
        images[0].save(file, "WEBP", save_all=True, append_images=images[1:], duration=round(1000 / RATE), loop=0,
                       quality=quality, method=6)  # fmt: skip
        if file.tell() <= LARGEST:
            break
    path.write_bytes(file.getvalue())
    print(f"{path.name}: {len(images)} pictures, {file.tell() / 1000:.0f} kB, quality {quality}", flush=True)


def number(value: float) -> str:
    """Format a number with three digits, and thousands with a comma."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def families() -> dict[str, tuple[str, list[str]]]:
    """Return a dict with the title and the task names of each page in docs/tasks/."""
    pages = {}
    for path in sorted((DOCS / "tasks").glob("*.md")):
        text = path.read_text()
        names = " ".join(re.findall(r"<!-- tasks: (.*?)-->", text, re.DOTALL)).split()
        pages[path.stem] = (text.partition("\n")[0].removeprefix("# "), names)
    return pages


def page(results: dict[str, dict[str, str]]) -> str:
    """Return the gallery's page."""
    introduction = (
        "Each picture links to its task, and each command shows the task. Where the animation has a command of its "
        "own, a fold contains it. A policy's return is the mean over whole episodes. A planner's return is the sum "
        "of the rewards from the start of the episode to the last frame of the animation."
    )
    lines = ["# Gallery", "", *textwrap.wrap(introduction, 120), ""]
    for stem, (title, names) in families().items():
        cards = [line for name in names if name in results for line in card(name, stem, results[name])]
        if cards:
            lines += [f"## {title}", "", '<div class="cards">', "", *cards, "</div>", ""]
    missing = " ".join(
        f"[{name}]({address(name, stem)})," for stem, (_, names) in families().items()
        for name in names if name not in results
    )  # fmt: skip
    if missing:
        lines += textwrap.wrap(f"These tasks have no animation: {missing.rstrip(',')}.", 120, break_long_words=False)
    return "\n".join(lines).rstrip("\n") + "\n"


def card(name: str, stem: str, result: dict[str, str]) -> list[str]:
    """Return a task's picture, its shortest command, and its result."""
    command = shortest_command(name)
    link = f"]({address(name, stem)})"
    lines = ["<div>", "", f"[![{name}](images/gallery/{file_name(name)}.webp){link}", "", f"[{name}{link}", ""]
    lines += ["```", command, "```", "", result["result"], ""]
    if result["command"] != command:
        head = "<details><summary>How this was made</summary>"
        lines += [head, "", "```", result["command"], "```", "", "</details>", ""]
    if name in pretrained_tasks():
        physics = learned_physics(Run.open(lw.pretrained_run(name)), find_task(name))
        lines += [f"Learned in {physics}, judged in exact physics on the C engine", ""]
        lines += [f"<!-- turnable: {name} -->", ""]
    return [*lines, "</div>", ""]


def shortest_command(name: str) -> str:
    """Return the shortest command that shows a task."""
    return f"lyceum-warp view {name} --pretrained" if name in pretrained_tasks() else f"lyceum-warp plan {name}"


def address(name: str, stem: str) -> str:
    """Return the link from the gallery to a task's section."""
    return f"tasks/{stem}.md#{name.replace('/', '')}"


# still pictures and turnable robots, which the build of the site writes


@functools.cache
def turnable_tasks() -> list[str]:
    """List the tasks with a pretrained policy and a model of plain shapes, whose pages are smaller than 0.4 MB."""
    models = {name: BoundTask(find_task(name)).model for name in pretrained_tasks()}
    return [name for name, model in models.items() if not model.nmesh and not model.nhfield]


def write_turnable(name: str, folder: Path) -> None:
    """Write four seconds of an episode under the pretrained policy as a page with a turnable robot."""
    show = SHOWS.get(name, Show())
    env = lw.make(name, autoreset=False, device="cpu")
    states = acted(env, lw.load(lw.pretrained_run(name)), show, round((show.start + 4) / env.timestep))
    write_page(env, states[round(show.start / env.timestep) :], folder / f"{file_name(name)}.html", camera=show.camera)


def write_still(animation: Path, folder: Path) -> None:
    """Write the middle frame of an animation as a picture of the same name."""
    with Image.open(animation) as image:
        image.seek(getattr(image, "n_frames", 1) // 2)
        image.save(folder / animation.name, "WEBP", quality=80)


def main() -> None:
    """Render the animations of the given tasks, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", default=PRETRAINED)
    parser.add_argument("--page", action="store_true")
    arguments = parser.parse_args()
    if arguments.page:
        (DOCS / "gallery.md").write_text(page(json.loads(RESULTS.read_text())))
        return
    runs = {json.loads(path.read_text())["task"]: path.parent for path in sorted(arguments.runs.glob("*/config.json"))}
    for name in arguments.tasks or [name for _, names in families().values() for name in names]:
        result = render(name, runs.get(name))
        # read the file again, because another process may have added results
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        results[name] = result
        RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
        (DOCS / "gallery.md").write_text(page(results))


if __name__ == "__main__":
    main()
