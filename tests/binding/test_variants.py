import subprocess
import sys
from pathlib import Path

import pytest
import terms_task
import tiny_task
import torch
from terms_task import Terms
from terms_variant import Same, Variant

import lyceum_warp as lw
from lyceum_warp.testing import check_task

ENGINES = pytest.mark.parametrize("engine", ["mujoco", "warp"])


@ENGINES
def test_variant_has_the_terms_of_its_parent_and_additional_terms(engine: str) -> None:
    parent, env = (lw.make(task, nworld=3, engine=engine, seed=2, horizon=0) for task in (Terms, Variant))
    assert env.task.params["target"] == 0.1 and env.task.params["border"] == parent.task.params["border"]
    assert list(env.state_space.parts)[-3:] == ["pushes", "work", "metrics"]
    work = torch.zeros(3)
    for _ in range(5):
        action = torch.full((3, 1), 0.05)
        x = env.field("qpos")[:, 0].clone()
        parent.step(action)
        env.step(action)
        work += action[:, 0] * (env.field("qpos")[:, 0] - x) + 0.001 * env.time
        torch.testing.assert_close(env.metrics["lasting"], 0.5 * env.timestep * 2.0 * work, atol=1e-7, rtol=1e-4)
        torch.testing.assert_close(env.metrics["change"], parent.metrics["change"] * 2 / 3, rtol=1e-4, atol=1e-7)
        assert torch.equal(env.metrics["effort"], parent.metrics["effort"])
    total = sum(env.metrics[name] for name in Variant.rewards)
    torch.testing.assert_close(env.reward, total, rtol=1e-5, atol=1e-7)


def test_variants_share_kernels_and_do_not_change_their_parents() -> None:
    before = lw.make(Terms).task.kernels
    assert lw.make(Variant).task.kernels is lw.make(Same).task.kernels is not before
    assert lw.make(Terms).task.kernels is before


@ENGINES
def test_variant_passes_check_task(engine: str) -> None:
    check_task(Variant, engine=engine, steps=30)


PARENT = tiny_task.changed(
    ("    dt: float", "    dt: float\n    place: int = 0"),
    ("@wp.func", """@wp.func
def scaled(x: float, s: World) -> float:
    return x

@wp.func
def joint(s: World, p: Params) -> float:
    return scaled(s.qpos[p.place], s)

@wp.func"""),
    ("obs[0] = s.qpos[0]", "obs[0] = joint(s, p)"),
    ("class Tiny", "class Parent"),
)  # fmt: skip

CHILD = """
import warp as wp
import lyceum_warp as lw
import variant_parent as parent

@wp.struct
class World(parent.World):
    qvel: wp.array[float]

@wp.func
def tripled(x: float, s: World) -> float:
    return 3.0 * parent.scaled(x, s) + s.qvel[0]

tripled.replaces = parent.scaled

class Child(parent.Parent):
    pass
"""


def child(folder: Path, *changes: tuple[str, str]) -> Path:
    source = CHILD
    for old, new in changes:
        assert old in source, old
        source = source.replace(old, new)
    (folder / "variant_parent.py").write_text(PARENT)
    return tiny_task.write(folder, source, "child.py")


def test_variant_in_a_file_replaces_a_helper_function_of_its_parent(tmp_path: Path) -> None:
    env = lw.make(child(tmp_path))
    parent = lw.make(tmp_path / "variant_parent.py")
    state = env.get_state()
    env.state_space.split(state)["qpos"][0, 0] = 0.25
    env.state_space.split(state)["qvel"][0, 0] = 0.5
    env.set_state(state)
    parent.set_state(state)
    assert (env.obs.item(), parent.obs.item()) == (1.25, 0.25)


def test_variant_in_another_folder_finds_the_model_file_of_its_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = "<body><freejoint/><geom size='.1'/></body>"
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    far = PARENT.replace("hopper.xml", "robot.xml").replace("class Parent", "class Far")
    (tmp_path / "far_parent.py").write_text(f"{far}    actions = {{'x': 1}}\n\n"
        "@wp.func\ndef control(s: World, action: Row[float], p: Params, ctrl: Row[float]):\n    pass\n")  # fmt: skip
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "variants"
    folder.mkdir()
    file = tiny_task.write(folder, "import far_parent\n\nclass Near(far_parent.Far):\n    horizon = 5\n", "near.py")
    assert lw.make(file).model.nq == 7


BASE = tiny_task.changed(
    ("    qpos: Row[float]", "    qpos: Row[float]\n    count: Row[float] = lw.memory()"),
    ("@wp.func", """@wp.struct
class Seen:
    x: Row[float] = lw.part()

@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.count[0] = s0.count[0] + 1.0

@wp.func
def observe_critic(s: World, p: Params, obs: Seen):
    obs.x[0] = 1.0

@wp.func"""),
    ("obs: Row[float]", "obs: Seen"), ("obs[0] = ", "obs.x[0] = "), ('    obs = {"x": 1}', """
    @staticmethod
    def edit_model(spec):
        spec.option.timestep *= 0.5"""),
)  # fmt: skip

SIDE = """
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row
import merged_base as base

@wp.struct
class World(base.World):
    side: Row[float] = lw.memory()

@wp.struct
class Params(base.Params):
    side_gain: float = 2.0

@wp.struct
class Seen(base.Seen):
    side: Row[float] = lw.part()

@wp.func
def observe(s: World, p: Params, obs: Seen):
    base.observe(s, p, obs)
    obs.side[0] = p.side_gain * s.side[0]

@wp.func
def observe_critic(s: World, p: Params, obs: Seen):
    base.observe_critic(s, p, obs)
    obs.side[0] = 0.5

@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    base.advance(s0, action, s1, p, rng)
    s1.side[0] = 10.0 * s1.count[0]

class Side(base.Tiny):
    @staticmethod
    def edit_model(spec):
        assert spec.option.timestep < 0.002
        spec.option.timestep *= 0.5
"""

MERGED = """
import warp as wp
import lyceum_warp as lw
import merged_left, merged_right

@wp.struct
class World(merged_left.World):
    own: wp.array[float] = lw.memory()

class Merged(merged_left.Side, merged_right.Side):
    pass
"""


def test_parents_with_own_structs_and_functions_are_merged(tmp_path: Path) -> None:
    tiny_task.write(tmp_path, BASE, "merged_base.py")
    for name in ("left", "right"):
        tiny_task.write(tmp_path, SIDE.replace("side", name), f"merged_{name}.py")
    env = lw.make(tiny_task.write(tmp_path, MERGED, "merged.py"), right_gain=3.0)
    assert list(env.obs_space.parts) == ["x", "right", "left"]
    for _ in range(2):
        env.step(torch.zeros(1, 3))
    memory = {name: env.state_space.split(env.get_state())[name].item() for name in ("count", "left", "right", "own")}
    assert memory == {"count": 2.0, "left": 20.0, "right": 20.0, "own": 0.0}
    assert env.obs[0, 1:].tolist() == [60.0, 40.0]
    assert env.obs_groups["critic"].tolist() == [[1.0, 0.5, 0.5]]
    assert env.model.opt.timestep == 0.002 / 8


MISTAKES = {
    "other arguments": (
        [("def tripled(x: float, s: World)", "def tripled(x: float)"), ("parent.scaled(x, s) + s.qvel[0]", "x")],
        r"joint \(variant_parent\.py, line \d+\): 'return scaled.*overload for 'tripled'.*float32",
    ),
    "structs that do not extend": (
        [("class World(parent.World):\n    qvel", "class World:\n    qpos: wp.array[float]\n    qvel"),
         ("\ntripled.replaces = parent.scaled\n", "")],
        r"takes World from .*parent\.py, but the task uses World from .*child\.py: .*"
        r"class World\(variant_parent\.World\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_variant_raises_a_one_line_error(changes: list[tuple[str, str]], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        lw.make(child(tmp_path, *changes))
    assert "\n" not in str(caught.value)


def test_error_in_a_copied_function_names_the_line_of_the_original(tmp_path: Path) -> None:
    file = child(tmp_path)
    parent = tmp_path / "variant_parent.py"
    parent.write_text(PARENT.replace("scaled(s.qpos[p.place], s)", "scaled(s.qpos[p.place], s)\n\n").replace(
        "    obs[0] = joint", "    s.qpos[0] = 1.0\n    obs[0] = joint"))  # fmt: skip
    with pytest.raises(ValueError, match=r"observe writes s\.qpos \(variant_parent\.py, line \d+\)"):
        lw.make(file)


@pytest.mark.long
def test_kernel_module_of_a_variant_has_the_same_hash_in_every_process() -> None:
    program = (
        f"import sys; sys.path[:0] = {[str(Path(terms_task.__file__).parent)]}\n"
        "import lyceum_warp as lw\nfrom terms_variant import Variant\n"
        "print(lw.make(Variant).task.kernels.judge.module.hash_module().hex())"
    )
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert lw.make(Variant).task.kernels.judge.module.hash_module().hex() == other[-1]
