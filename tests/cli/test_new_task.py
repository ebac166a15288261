import re
from pathlib import Path

import pytest
from arbitrary_models import ARM, BALL, MODEL_CHECKS, MODELS, PLUGINS, actuated, text
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import find_task
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.testing import check_task

RICH = text(
    ARM
    + BALL.format(z=0.1)
    + '<body name="target" mocap="true" pos=".3 0 .6"/>'
    + '<body name="swing" pos="1 0 1"><joint name="ball" type="ball"/><geom size=".1" pos="0 0 -.3"/></body>',
    '<tendon><spatial name="string"><site site="here"/><site site="tip"/></spatial></tendon>'
    + actuated(
        '<position name="slow" joint="hinge" kp="5" timeconst=".05" ctrlrange="-2 2"/>',
        '<motor tendon="string" ctrlrange="0 1"/>',
        '<motor joint="ball" gear="0 1 0 0 0 0" ctrlrange="-1 1"/>',
    )
    + '<sensor><gyro site="end"/><clock/><touch site="end"/><user dim="2"/></sensor>'
    '<keyframe><key name="home" qpos=".3 -.3  0 0 .1 1 0 0 0  1 0 0 0" ctrl=".5 0 0" mpos=".2 0 .5"/></keyframe>',
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def new(name: str, xml: str) -> Path:
    Path(f"{name}.xml").write_text(xml)
    assert cli.main(["new", name, "--model", f"{name}.xml"]) == 0
    return Path(f"{name}.py")


@pytest.mark.quick("warp")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_new_task_passes_check_task(engine: str, folder: Path) -> None:
    file = new("everything", RICH)
    check_task(str(file), engine=engine, nworld=2, horizon=6, frame_skip=1, checks=MODEL_CHECKS)


def test_new_task_observes_the_state_and_its_sensors(folder: Path) -> None:
    env = lw.make(str(new("everything", RICH)), nworld=2, seed=3)
    task = env.task.definition
    assert task.obs == {"position": 13, "velocity": 11, "activation": 1, "sensors": 4}
    assert (task.frame_skip, task.horizon, task.keyframe, task.action_range) == (4, 500, "home", (-1.0, 1.0))
    assert env.field("qpos", "hinge")[0] == pytest.approx(0.3)
    state = [env.field(name)[0].float() for name in ("qpos", "qvel", "act")]
    # gyro (3 numbers), clock, touch sensor, user sensor (2 numbers)
    measured = env.field("sensordata")[0]
    expected = [*(value for field in state for value in field.tolist()), *measured[:3].tolist(), measured[4].item()]
    assert env.obs[0].tolist() == pytest.approx(expected)
    assert env.obs[0, 13:24].abs().max() > 0  # worlds start with different velocities
    env.step()
    assert env.reward.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("model", [*MODELS.values(), *PLUGINS.values()], ids=[*MODELS, *PLUGINS])
def test_observations_of_a_new_task_have_the_sizes_of_the_model(model: str, folder: Path) -> None:
    task = BoundTask(find_task(new("walk", model)))
    sizes = {"position": task.model.nq, "velocity": task.model.nv, "activation": task.model.na}
    layout = dict(task.layouts.obs["policy"])
    assert layout.pop("sensors", 0) <= task.model.nsensordata
    assert all(sizes[part] == size for part, size in layout.items())
    assert task.timestep == pytest.approx(0.02)


def test_functions_in_comments_work_after_uncommenting(folder: Path) -> None:
    file = new("everything", RICH)
    head, body = file.read_text().split("# Three more functions that most tasks have:\n#\n")
    commented, tail = body.split("\n\n@lw.register")
    functions = re.sub(r"^# ?", "", commented, flags=re.MULTILINE)
    name = re.search(r'tip: int = lw\.site\(".*?"\)', head)
    assert name is not None
    head = head.replace("dt: float  #", f"{name[0]}\n    dt: float  #")
    file.write_text(f"{head}{functions}\n\n@lw.register{tail}")
    task = BoundTask(find_task(file))
    assert all(task.functions[name] is not None for name in ("evaluate", "terminated", "success"))
    assert task.params["tip"] == 0


def test_model_path_is_written_relative_to_the_task_file(folder: Path) -> None:
    for name in ("models", "tasks"):
        Path(name).mkdir()
    model = Path("models", 'my "$robot".xml')
    xml = text(ARM.replace('name="tip"', 'name="a &quot;tip&quot;"'))
    model.write_text(xml.replace('<site name="here" pos="0 0 2"/>', ""))
    for file, argument, source in (
        ("tasks/walk.py", str(model), '../models/my "$robot".xml'),
        ("stand.py", str(model.absolute()), str(model.absolute())),
    ):
        assert cli.main(["new", file, "--model", argument]) == 0
        assert find_task(file).model == source and BoundTask(find_task(file)).model.nu == 1
        assert r'lw.site("a \"tip\"")' in Path(file).read_text()


def test_model_of_a_package_or_of_menagerie_is_loaded_from_its_source(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Path("checkout", "leg", "scene.xml")
    robot.parent.mkdir(parents=True)
    robot.write_text(text(ARM))
    monkeypatch.setenv("MENAGERIE_ROOT", "checkout")
    assert cli.main(["new", "leg_walk", "--model", "menagerie:leg/scene.xml"]) == 0
    assert cli.main(["new", "hop", "--model", "gymnasium:hopper.xml"]) == 0
    shown = capsys.readouterr().out
    assert "leg_walk.py: 4 observations, 1 actions, 20 ms in a step" in shown
    assert shown.splitlines()[-1].startswith("then:       lyceum-warp train ")
    assert find_task("leg_walk.py").model == lw.menagerie_model("leg/scene.xml")
    assert find_task("hop.py").model == lw.gymnasium_model("hopper.xml")


@pytest.mark.parametrize(("name", "words"), [
    ("hopper", ["'hopper'", "choose another"]),
    ("2walk", ["'2walk'", "letters, digits and _"]),
    ("class", ["'class'"]),
    ("true", ["'true'"]),
    ("größe", ["'größe'"]),
    ("MyWalk", ["'MyWalk'", "use 'my_walk'"]),
    ("walk_2", ["'walk_2'", "use 'walk2'"]),
    ("world", ["'world'", "defines World"]),
    ("torch", ["'torch'", "hide the Python module"]),
    ("", ["'.py'"]),
    ("old", ["old.py exists"]),
    ("nowhere/walk", ["nowhere/walk.py"]),
])  # fmt: skip
def test_an_invalid_name_raises_a_one_line_error(
    name: str, words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("robot.xml").write_text(text(ARM))
    Path("old.py").write_text("mine")
    assert cli.main(["new", name, "--model", "robot.xml"]) == 2
    refused(capsys, *words)
    assert {path.name for path in folder.iterdir()} == {"robot.xml", "old.py"}
    assert Path("old.py").read_text() == "mine"


@pytest.mark.parametrize(("model", "words"), [
    ("absent.xml", ["absent.xml"]),
    ("gymnasium:hoper.xml", ["'hoper.xml'", "hopper.xml"]),
    ("broken.xml", ["broken.xml"]),
    ("meshless.xml", ["meshless.xml", "absent.stl"]),
    ("still.xml", ["still.xml", "no actuators"]),
    ("stuck.xml", ["stuck.xml", "no joints"]),
])  # fmt: skip
def test_an_invalid_model_raises_a_one_line_error(
    model: str, words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = (
        '<asset><mesh name="absent" file="absent.stl"/></asset><worldbody><geom type="mesh" mesh="absent"/></worldbody>'
    )
    Path("broken.xml").write_text("<mujoco>")
    Path("meshless.xml").write_text(f"<mujoco>{mesh}</mujoco>")
    Path("still.xml").write_text(text(ARM, ""))
    Path("stuck.xml").write_text(text("", actuated('<adhesion body="world" ctrlrange="0 1"/>')))
    assert cli.main(["new", "walk", "--model", model]) == 2
    refused(capsys, *words)
    assert not Path("walk.py").exists()
