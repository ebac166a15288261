import importlib
import shutil
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from training_runs import QUIET, TINY, env_of, metrics, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import find_task
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.env import Env
from lyceum_warp.training import Run, task_copy

TASK = Path(__file__).parents[2] / "data" / "runs_0_2" / "task_file" / "task"
SOURCE, SCENE, PART = ((TASK / name).read_text() for name in ("slide.py", "robot/scene.xml", "robot/parts/block.xml"))

SMALL = lw.NPGConfig(samples=40, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(TASK, tmp_path / "mine", ignore=shutil.ignore_patterns("tables", "__pycache__"))
    np.save(tmp_path / "mine" / "goal.npy", np.array([0.3, 0.4]))
    return tmp_path


def trained(folder: Path) -> Path:
    out, table = folder / "run", folder / "mine" / "goal.npy"
    arguments = ["train", str(folder / "mine" / "slide.py"), "--out", str(out), "--param", f"goal={table}", *TINY]
    assert cli.main([*arguments, *QUIET, "--iterations", "2"]) == 0
    return out


def returns(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    assert cli.main(["eval", *arguments, "--episodes", "2"]) == 0
    output = capsys.readouterr()
    print(output.err)
    return next(line for line in output.out.splitlines() if line.strip().startswith("return"))


def test_run_resumes_after_its_task_was_moved(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = trained(folder)
    before = returns(capsys, str(out))
    assert cli.main(["train", "--resume", str(out), "--iterations", "3", *QUIET]) == 0
    expected = metrics(out)
    shutil.rmtree(out)
    trained(folder)
    (folder / "mine").rename(folder / "moved")
    assert returns(capsys, str(out)) == before
    assert cli.main(["train", "--resume", str(out), "--iterations", "3", *QUIET]) == 0
    gone, copy = folder / "mine" / "slide.py", out / "task" / "slide.py"
    refused(capsys, f"{gone} does not exist any more: the run's own copy is used, {copy}")
    assert metrics(out) == expected
    warm = ["train", "--from", str(out), "--out", str(folder / "warm"), "--iterations", "1", *QUIET]
    assert cli.main(warm) == 0
    assert Run.open(folder / "warm").config["from"]["run"] == str(out)


URDF = """<robot name="arm"><mujoco><compiler meshdir="../meshes" strippath="true"/></mujoco>
<link name="base"/><link name="tip"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><mesh filename="package://arm/block.obj"/></geometry></collision></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="tip"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["attached", "urdf", "python"])
def test_run_copies_all_files_of_a_model(kind: str, folder: Path) -> None:
    robot = folder / "mine" / "robot"
    (robot / "arm.urdf").write_text(URDF)
    (robot / "whole.xml").write_text(
        '<mujoco><asset><model name="a" file="scene.xml"/></asset><worldbody><frame>'
        '<attach model="a" body="slider" prefix="a_"/></frame></worldbody></mujoco>'
    )
    (robot / "parts" / "block.xml").write_text(PART.replace("<body>", '<body name="slider">'))
    given: Any = {"attached": robot / "whole.xml", "urdf": robot / "arm.urdf"}.get(kind)
    if kind == "python":
        given = mujoco.MjSpec.from_file(str(robot / "scene.xml"))
    motor = """
    @staticmethod
    def edit_model(spec):
        for joint in spec.joints[: not spec.actuators]:
            spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
"""
    (folder / "mine" / "slide.py").write_text(f"import mujoco\n{SOURCE}{motor}")
    kept, files = task_copy(lw.make(str(folder / "mine" / "slide.py"), nworld=1, model=given))
    names = {
        "attached": {"robot/whole.xml", "robot/scene.xml", "robot/parts/block.xml"},
        "urdf": {"robot/arm.urdf"},
        "python": {"robot/model.xml"},
    }[kind]
    assert files.keys() == names | {"meshes/block.obj", "slide.py"}
    assert kept["model"] == {"attached": "robot/whole.xml", "urdf": "robot/arm.urdf", "python": "robot/model.xml"}[kind]


@pytest.mark.parametrize("moved", [False, True])
def test_run_started_from_another_run_uses_the_model_copy_of_that_run(
    moved: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, robot, warm = trained(folder), folder / "mine" / "robot", folder / "warm"
    masses = Env(str(folder / "mine" / "slide.py")).model.body_mass
    if moved:
        robot.rename(folder / "mine" / "other")
        line = "the model of the task 'slide' is no longer where it was"
    else:
        part = robot / "parts" / "block.xml"
        part.write_text(PART.replace('type="mesh"', 'type="mesh" mass="9"'))
        line = "the model of the task 'slide' has changed since the run began"
    capsys.readouterr()
    arguments = ["train", "--from", str(out), "--out", str(warm), *QUIET, "--iterations"]
    assert cli.main([*arguments, "1"]) == 0
    refused(capsys, f"{line}: the run's own copy is used, {out / 'task' / 'robot' / 'scene.xml'}")
    env = env_of(warm)
    assert np.array_equal(env.model.body_mass, masses)
    assert cli.main(["train", "--resume", str(warm), "--iterations", "2", *QUIET]) == 0
    if not moved:
        arguments[4] = str(folder / "new")
        assert cli.main([*arguments, "1", str(folder / "mine" / "slide.py")]) == 0
        env = env_of(folder / "new")
        assert env.model.body_mass[-1] == 9.0


def test_run_saves_a_model_that_was_made_in_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = lw.gymnasium_model("hopper.xml").spec()
    spec.option.gravity = [0.0, 0.0, -30.0]
    env = lw.make("hopper", nworld=2, model=spec, horizon=20)
    lw.train(lw.NPG(env, config=SMALL), tmp_path / "run", 1)
    before = returns(capsys, str(tmp_path / "run"))
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2", "--task", "hopper"]) == 0
    assert before not in capsys.readouterr().out
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--iterations", "2", *QUIET]) == 0


def test_resuming_in_python_reports_a_changed_task_and_model(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, table, out = folder / "mine" / "slide.py", folder / "mine" / "goal.npy", folder / "run"

    def train(run: Path | Run, iterations: int) -> None:
        env = lw.make(str(file), nworld=2, goal=table, horizon=10)
        lw.train(lw.NPG(env, config=SMALL), run, iterations)

    train(out, 1)
    assert Run.open(out).config["params"] == {"goal": str(table)}
    train(Run.open(out), 2)
    assert not caplog.messages
    part = folder / "mine" / "robot" / "parts" / "block.xml"
    part.write_text(PART.replace('type="slide"', 'type="slide" damping="9"'))
    file.write_text(SOURCE.replace("-wp.abs(", "7.0 - wp.abs("))
    train(Run.open(out), 3)
    changed = "has changed since the run began: the new version is used"
    assert caplog.messages == [f"{file} {changed}", f"the model of the task 'slide' {changed}"]


def test_relative_path_of_a_table_does_not_depend_on_the_working_directory(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(folder / "mine")
    env = lw.make("slide.py", nworld=2, goal="goal.npy", horizon=10)
    lw.train(lw.NPG(env, config=SMALL), folder / "run", 1)
    monkeypatch.chdir(folder)
    np.save("goal.npy", np.array([9.0, 0.4]))
    assert np.allclose(env_of(folder / "run").task.params["goal"], [0.3, 0.4]) and not caplog.messages
    monkeypatch.chdir(folder / "mine")
    np.save("goal.npy", np.array([9.0, 0.4]))
    env = lw.make("slide.py", nworld=2, goal="goal.npy", horizon=10)
    lw.train(lw.NPG(env, config=SMALL), Run.open(folder / "run"), 2)
    (message,) = caplog.messages
    assert message == f"{folder / 'mine' / 'goal.npy'} has changed since the run began: the new version is used"


def test_eval_of_a_run_from_a_notebook_needs_a_given_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lw.train(lw.NPG(lw.make("point_mass", nworld=2), config=SMALL), tmp_path / "run", 1)
    Run.open(tmp_path / "run").amend(task=None)
    assert cli.main(["eval", str(tmp_path / "run")]) == 2
    refused(
        capsys,
        "its task 'point_mass'",
        "was started by a notebook",
        "pass a file that only defines the task (eval --task my_task.py",
    )
    assert cli.main(["eval", str(tmp_path / "run"), "--task", "point_mass", "--episodes", "2"]) == 0


LOCAL = """
import warp as wp

@wp.func
def squared(x: float) -> float:
    return x * x
"""
EDITED = SOURCE.replace("import warp as wp", "import warp as wp\nfrom slide_terms import squared", 1).replace(
    "-wp.abs(s1.qpos[0] - p.goal[0])", "-squared(s1.qpos[0] - p.goal[0])"
)
EDITS = [
    lambda text: "# a new first line\n" * 7 + text,
    lambda text: text[: len(text) // 2],
    lambda text: f"{text}\nthis is not Python",
    lambda text: "",
    None,
]
"""Changes of a task's files during training. The value None deletes the file."""


def test_a_run_copies_the_source_that_it_started_with(folder: Path) -> None:
    mine = folder / "mine"
    original = {mine / "slide.py": EDITED, mine / "slide_terms.py": LOCAL}
    for file, text in original.items():
        file.write_text(text)

    def run(name: str, edits: list[Any]) -> list[dict[str, str]]:
        env = lw.make(str(mine / "slide.py"), nworld=2)
        pending = iter(edits)

        def edit(*_: Any) -> None:
            for change in [next(pending)] if edits else []:
                for file, text in original.items():
                    file.unlink(missing_ok=True) if change is None else file.write_text(change(text))
            if edits:
                env.replicate(nworld=1).step()

        edit()
        lw.train(lw.NPG(env, config=SMALL), folder / name, len(EDITS) - 1, callbacks=[edit])
        for file, text in original.items():
            assert (folder / name / "task" / file.name).read_text() == text
        return metrics(folder / name)

    edited = run("edited", EDITS)
    for file, text in original.items():
        file.write_text(text)
    assert edited == run("unedited", [])


READING = (
    (
        SOURCE.replace(
            "import warp as wp\n",
            "import os\nfrom pathlib import Path\n\nimport numpy as np\nimport slide_data\nimport warp as wp\n\n"
            "HERE = Path(__file__).parent\nSCALE = os.environ.get('SCALE', HERE / 'clips/scale.npy')\n",
            1,
        )
        .replace("    dt: float\n", "    scale: float = float(np.load(SCALE))\n", 1)
        .replace("    goal:", "    offset: float = slide_data.OFFSET\n    goal:", 1)
        .replace("-wp.abs(s1.qpos[0] - p.goal[0])", "p.offset - p.scale * wp.abs(s1.qpos[0] - p.goal[0])")
    )
    + """
    @staticmethod
    def edit_model(spec):
        spec.option.gravity[2] = float((HERE / "gravity.txt").read_text())
"""
)


@pytest.fixture
def reading(folder: Path) -> Path:
    """A task that reads a file at its import, one in a module that it imports, and one in ``edit_model``."""
    mine = folder / "mine"
    (mine / "slide.py").write_text(READING)
    (mine / "slide_data.py").write_text(
        "import os\n\nwith open(os.path.join(os.path.dirname(__file__), 'offset.csv')) as file:\n"
        "    OFFSET = float(file.read())\n"
        "if os.path.exists('/proc/meminfo'):\n    open('/proc/meminfo').close()\n"  # a file of the kernel is no data
    )
    (mine / "clips").mkdir()
    np.save(mine / "clips" / "scale.npy", 2.0)
    (mine / "offset.csv").write_text("5.0")
    (mine / "gravity.txt").write_text("-3.0")
    (mine / "unread.txt").write_text("x")
    return folder


CHANGES: dict[str, tuple[str, str] | None] = {
    "goal.npy": None,
    "clips/scale.npy": None,
    "offset.csv": ("5.0", "-9.0"),
    "gravity.txt": ("-3.0", "-9.0"),
    "slide_data.py": ("float(", "7.0 + float("),
    "robot/parts/block.xml": ('type="mesh"', 'type="mesh" mass="9"'),
}
"""Changes of a parameter's table, of files that the task reads, of a module that it imports, and of its model. The
value None multiplies an array by 3."""


def test_run_uses_its_own_copies_of_changed_or_moved_files(
    reading: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    out, mine = trained(reading), reading / "mine"
    assert not caplog.messages and not (out / "task" / "unread.txt").exists()
    before = returns(capsys, str(out))
    for name, change in CHANGES.items():
        file = mine / name
        original = file.read_bytes()
        np.save(file, 3.0 * np.load(file)) if change is None else file.write_text(original.decode().replace(*change))
        assert returns(capsys, str(out)) == before
        subject = "the model of the task 'slide'" if file.suffix == ".xml" else str(file)
        text = f"{subject} has changed since the run began: the run's own copy is used"
        assert caplog.messages[-1].startswith(text)
        if name not in ("gravity.txt", "robot/parts/block.xml"):  # these hardly affect the returns
            option = ["--param", f"goal={file}"] if name == "goal.npy" else ["--task", str(mine / "slide.py")]
            assert returns(capsys, str(out), *option) != before
        file.write_bytes(original)
    mine.rename(reading / "moved")
    assert returns(capsys, str(out)) == before
    assert cli.main(["train", "--resume", str(out), "--iterations", "3", *QUIET]) == 0
    assert not list(out.rglob("__pycache__"))


def test_changed_data_is_read_again(reading: Path) -> None:
    mine = reading / "mine"

    def values() -> tuple[float, float, float]:
        task = BoundTask(find_task(mine / "slide.py"))
        return task.params["scale"], task.params["offset"], task.model.opt.gravity[2]

    assert values() == (2.0, 5.0, -3.0)
    np.save(mine / "clips" / "scale.npy", 4.0)
    (mine / "offset.csv").write_text("6.00")
    (mine / "gravity.txt").write_text("-7.0")
    assert values() == (4.0, 6.0, -7.0)


@pytest.mark.parametrize("where", ["outside", "relative", "changed"])
def test_run_names_data_that_it_cannot_copy(
    where: str, reading: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = reading / "mine"
    monkeypatch.chdir(mine)
    inside = mine / "clips" / "scale.npy"
    path = {"outside": reading / "scale.npy", "relative": Path("clips/scale.npy"), "changed": inside}[where]
    np.save(path, 2.0)
    monkeypatch.setenv("SCALE", str(path))
    env = lw.make(str(mine / "slide.py"), nworld=2)
    if where == "changed":
        np.save(path, 3)
    lw.train(lw.NPG(env, config=SMALL), reading / "run", 1)
    (message,) = caplog.messages
    assert message.startswith(f"the run has no copy of {path}, which the task 'slide' reads: ")
    assert {file.name for file in (reading / "run" / "task").rglob("*") if file.is_file()} >= {"offset.csv"}
    assert not list((reading / "run").rglob("scale.npy"))


def test_data_of_an_imported_class_is_copied(reading: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(reading / "mine")
    for name in ("slide", "slide_data"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    slide: Any = importlib.import_module("slide")
    files = task_copy(lw.make(slide.Slide, nworld=1))[1]
    assert files.keys() >= {"clips/scale.npy", "offset.csv", "gravity.txt", "slide_data.py"}
