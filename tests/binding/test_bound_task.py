from pathlib import Path
from typing import Any

import mujoco
import pytest
import tiny_task
import torch

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.registry import kernel_name


def bound(file: Path, **options: Any) -> BoundTask:
    return BoundTask(find_task(file), **options)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("horzon = 10", "'horzon' is unknown: did you mean horizon"),
        ("obs = 10", "obs is 10"),
        ("del model", "there is no model"),
        ("lagged = ('qvel',)", "lagged has 'qvel'"),
        ("cleared = ('qacc',)", "cleared has 'qacc'"),
        ("frame_skip = 0", "frame_skip = 0"),
        ("success_steps = 2.5", r"success_steps = 2\.5"),
        ("success_steps = 2", r"success_steps = 2, but no success\(s: World, p: Params\)"),
        ("horizon = 100.0", r"horizon = 100\.0"),
        ("horizon = -1", "horizon = -1"),
        ("action_range = (1.0, -1.0)", r"action_range = \(1.0, -1.0\)"),
        ("action_range = (0.0, float('inf'))", r"action_range = \(0.0, inf\)"),
    ],
)
def test_invalid_task_attribute_raises_an_error(line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        bound(tiny_task.write(tmp_path, f"{tiny_task.TINY}    {line}\n"))


def test_cleared_forces_of_a_model_without_force_sensors_raise_an_error_about_the_sensors(tmp_path: Path) -> None:
    source = tiny_task.changed(tiny_task.field("sensordata: Row[float]"))
    with pytest.raises(ValueError, match=r"model has no sensor of them: add the sensors in edit_model$"):
        bound(tiny_task.write(tmp_path, f"{source}    cleared = ('sensordata',)\n"))


REWARD = "def reward(s0: World, action: Row[float], s1: World, p: Params)"


FIXES = {
    "wp.max(action[0], action[1], action[2])": r"as in wp\.max\(a, wp\.max\(b, c\)\)",
    "action[0] ** 2": r"as in x \*\* 2\.0",
    "2 * action[0]": "numbers as floats",
    "wp.length(2 * wp.vec3(action[0]))": "numbers as floats",
    "wp.clamp(action[0], -1, 1)": "numbers as floats",
    "wp.where(action[0] > 0.0, 1, 0)": "numbers as floats",
    "lw.tolerance(action[0], 0, 1)": "numbers as floats",
    "lw.tolerance(action[0], wp.vec3(0.0), 1.0)": r"help\(lw\.tolerance\) lists",
    "action[action[0]]": r"row\[int\(x\)\]",
    "TABLE[0]": r"into Params, as in table: wp\.array\[float\]",
    "np.clip(action[0], 0.0, 1.0)": r"use Warp's functions, such as .* wp\.clamp",
    "wp.lenght(wp.vec3(1.0))": "did you mean length",
    "p.weight": "add weight: float = 1.0 to Params",
    "s1.xpos[1][2]": r"add xpos: Row\[wp\.vec3\] to World",
    "s1.body_mass[1]": r"add body_mass: Row\[float\] to World",
    "s1.qpoz[1]": "did you mean qpos",
    "float(again(3))": "a function cannot call itself: use a loop",
}


@pytest.mark.parametrize(("expression", "fix"), FIXES.items(), ids=FIXES)
def test_function_that_warp_cannot_compile_raises_an_error_with_the_fix(
    expression: str, fix: str, tmp_path: Path
) -> None:
    helper = "import numpy as np\nTABLE = np.ones(3)\n\n@wp.func\ndef again(n: int) -> int:\n    return again(n - 1)\n"
    reward = f"@wp.func\n{REWARD} -> float:\n    return {expression}\n"
    source = tiny_task.changed(("class Tiny", f"{helper}\n{reward}\nclass Tiny"))
    with pytest.raises(ValueError, match=fix) as caught:
        lw.make(tiny_task.write(tmp_path, source))
    assert "\n" not in str(caught.value) and "reward" in str(caught.value).replace("again", "reward")


def test_actions_are_scaled_only_for_controls_with_ranges(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}    action_range = (-1.0, 1.0)\n")
    spec = lw.gymnasium_model("hopper.xml").spec()
    spec.actuators[0].ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    with pytest.raises(ValueError, match=r"the controls \[0\] have no range in the model: set the actuators"):
        lw.make(file, model=spec)


def test_model_without_actuators_raises_an_error(tmp_path: Path) -> None:
    spec = lw.gymnasium_model("hopper.xml").spec()
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    with pytest.raises(ValueError, match="the model has no actuators"):
        bound(tiny_task.write(tmp_path, tiny_task.TINY), model=spec)


def test_success_steps_longer_than_an_episode_raise_an_error(tmp_path: Path) -> None:
    source = tiny_task.with_function("def success(s: World, p: Params) -> bool:\n    return True")
    for horizon, steps in ((0, 6), (6, 6), (6, 1)):
        bound(tiny_task.write(tmp_path, f"{source}    horizon, success_steps = {horizon}, {steps}\n"))
    with pytest.raises(ValueError, match="success_steps = 7, but an episode has 6 steps"):
        bound(tiny_task.write(tmp_path, f"{source}    horizon, success_steps = 6, 7\n"))


def test_observation_size_that_differs_between_worlds_raises_an_error() -> None:
    flags = [True, False]
    with pytest.raises(ValueError, match=r"'hopper': obs has sizes that differ between worlds, \['position'\]"):
        lw.make("hopper", nworld=2, exclude_current_positions_from_observation=flags)


def test_parameters_that_change_the_observation_size_raise_an_error_and_are_not_set() -> None:
    env = lw.make("hopper", nworld=2)
    for value in (False, [True, False]):
        with pytest.raises(ValueError, match="exclude_current_positions_from_observation would change"):
            env.set_params(exclude_current_positions_from_observation=value)
    assert env.task.params["exclude_current_positions_from_observation"] is True
    env.step(torch.zeros(2, 3))
    assert env.get_obs().shape == (2, 11)


def test_params_of_a_class_replace_defaults_and_share_kernels(tmp_path: Path) -> None:
    source = tiny_task.changed(("    dt: float", "    dt: float\n    gain: float = 1.0"))
    file = tiny_task.write(tmp_path, f'{source}\nclass Fast(Tiny):\n    params = {{"gain": 3.0}}\n')
    tiny, fast = (bound(Path(f"{file}:{name}")) for name in ("Tiny", "Fast"))
    assert (tiny.params["gain"], fast.params["gain"]) == (1.0, 3.0) and fast.kernels is tiny.kernels
    file.write_text(file.read_text().replace('{"gain"', '{"gian"'))
    with pytest.raises(ValueError, match="'gian' is unknown: did you mean gain"):
        bound(Path(f"{file}:Fast"))


EVALUATE = "def evaluate(s: World, p: Params) -> float:\n    return s.qpos[1]"


def kernels(file: Path | str) -> Any:
    return BoundTask(find_task(file)).kernels


def test_equal_functions_share_kernels(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Slower(Tiny):\n    frame_skip = 2\n")
    assert kernels(f"{file}:Tiny") is kernels(f"{file}:Slower") is kernels(f"{file}:Tiny")


def test_copied_task_file_shares_kernel_modules_until_it_changes(tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    file, copy = (tiny_task.write(folder, tiny_task.TINY) for folder in (tmp_path, tmp_path / "copy"))
    first = kernel_name(find_task(file))
    assert kernel_name(find_task(copy)) == first
    assert kernels(file).judge.module.name.startswith(f"lyceum_warp.generated.{first}")
    tiny_task.write(tmp_path, tiny_task.with_function(EVALUATE))
    assert kernel_name(find_task(file)) != first
