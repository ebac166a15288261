"""The form of a task: what is written wrongly is told at once, and several tasks live side by side."""

import sys
import types
from pathlib import Path

import pytest
import torch

import lyceum_warp as lw

HEAD = """
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row

@wp.struct
class World:
    qpos: Row[float]

@wp.struct
class Params:
    dt: float

@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
"""

CLASS = """
class Shape(lw.Task):
    model = "hopper.xml"
    obs = {"x": 1}
"""


def made(tmp_path: Path, source: str, name: str = "shape.py") -> lw.Env:
    file = tmp_path / name
    file.write_text(source)
    return lw.make(file)


@pytest.mark.parametrize(
    "written, message",
    [
        (
            "def reward(s0: World, s1: World, action: Row[float], p: Params) -> float:\n    return 1.0",
            r"reward of the task 'shape' has to be written as reward\(s0: World, action: Row\[float\], s1: World",
        ),
        ("def terminated(s: World, p: Params) -> float:\n    return 1.0", r"terminated .* written as .* -> bool"),
        ("def success(s: World) -> bool:\n    return True", r"success .* written as success\(s: World, p: Params\)"),
        ("def sucess(s: World, p: Params) -> bool:\n    return True", "'sucess': did you mean success"),
        (
            "def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:\n    return s1.qvel[0]",
            "Warp can't compile the functions of the task 'shape': .*qvel",
        ),
    ],
)
def test_a_function_that_is_written_wrongly_is_named(tmp_path: Path, written: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(tmp_path, f"{HEAD}\n@wp.func\n{written}\n{CLASS}")


@pytest.mark.parametrize(
    "line, message",
    [
        ("frameskip = 5", "'frameskip' in its class: did you mean frame_skip"),
        ("horizon = -1", "horizon of the task 'shape' must be a whole number"),
        ("obs = 10", "obs of the task 'shape' is 10: add the parts of its observation"),
    ],
)
def test_a_class_that_is_written_wrongly_is_named(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(tmp_path, f"{HEAD}{CLASS}    {line}\n")


def test_actions_can_be_scaled_to_ranges_only(tmp_path: Path) -> None:
    import mujoco

    spec = mujoco.MjSpec.from_file(str(Path(__file__).parent / "data" / "unlimited.xml"))
    file = tmp_path / "shape.py"
    file.write_text(f"{HEAD}{CLASS}    action_range = (-1.0, 1.0)\n")
    with pytest.raises(ValueError, match=r"gives none to the controls \[0\]: set their ctrlrange"):
        lw.make(file, model=spec)


def test_two_files_may_hold_tasks_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first = made(tmp_path / "a", f"{HEAD}\n@lw.register{CLASS}")
    second = made(tmp_path / "b", f"{HEAD}\n@lw.register{CLASS}    frame_skip = 2\n")
    assert (first.task.frame_skip, second.task.frame_skip) == (1, 2)


def test_tasks_in_one_notebook_keep_their_own_functions(tmp_path: Path) -> None:
    """Each cell defines the same names anew; a task keeps those of its own cell."""
    one = f"{HEAD}\n@wp.func\ndef evaluate(s: World, p: Params) -> float:\n    return 1.0\n{CLASS}"
    two = HEAD.replace("s.qpos[0]", "2.0") + CLASS.replace("Shape", "Other")
    module = types.ModuleType("notebook_of_a_test")
    sys.modules[module.__name__] = module
    for i, cell in enumerate((one, two)):
        file = tmp_path / f"cell{i}.py"  # Warp reads the source from where it was compiled
        file.write_text(cell)
        exec(compile(cell, str(file), "exec"), vars(module))
    shape, other = lw.make(module.Shape), lw.make(module.Other)
    for env in (shape, other):
        env.step()
    assert shape.eval.item() == 1.0
    assert torch.equal(shape.obs, shape.field("qpos")[:, :1])
    assert other.obs.item() == 2.0
    assert torch.equal(other.eval, other.reward)  # the evaluation of the first cell is none of its business
    del sys.modules[module.__name__]


@pytest.mark.parametrize("name", ["hopper.xml", "foo.bar", "./t", ""])
def test_what_is_no_task_is_said_so(name: str) -> None:
    with pytest.raises(ValueError, match="there is no task"):
        lw.make(name)


def test_other_librarys_words_are_understood() -> None:
    with pytest.raises(ValueError, match="no parameter 'num_envs': did you mean nworld"):
        lw.make("hopper", num_envs=4)


def test_an_observation_has_one_size_in_all_worlds() -> None:
    flags = [True, False]
    with pytest.raises(ValueError, match=r"obs of the task 'hopper' differs between worlds in \['position'\]"):
        lw.make("hopper", nworld=2, exclude_current_positions_from_observation=flags)
    env = lw.make("hopper", nworld=2)
    with pytest.raises(ValueError, match="would change the observation's parts"):
        env.set_params(exclude_current_positions_from_observation=flags)
    env.step()  # goes on with the parameters that it had
    assert env.get_obs().shape == (2, 11)


def test_buffers_are_written_into() -> None:
    env = lw.make("hopper", nworld=2)
    with pytest.raises(AttributeError, match=r"env.action is a buffer of fixed address: write into it"):
        env.action = torch.zeros(2, 3)
    env.step(torch.zeros(2, 3, requires_grad=True) + 1.0)
    assert not env.action.requires_grad


def test_a_file_in_the_current_folder_takes_no_tasks_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a model that is asked for comes from the current folder."""
    spec = lw.gymnasium_model("hopper.xml")
    spec.geom("torso_geom").density = 5000
    (tmp_path / "hopper.xml").write_text(spec.to_xml())
    own = lw.make("hopper").model.body_mass
    monkeypatch.chdir(tmp_path)
    assert (lw.make("hopper").model.body_mass == own).all()
    assert lw.make("hopper", model="hopper.xml").model.body_mass[1] > 2 * own[1]
