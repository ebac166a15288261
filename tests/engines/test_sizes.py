import mujoco
import pytest
from conftest import SharedEnv, TaskFile

import lyceum_warp as lw
from lyceum_warp.core.model_fields import describe_model_field
from lyceum_warp.engines.warp import sizes
from lyceum_warp.engines.warp.sizes import probe_sizes


@pytest.fixture(autouse=True)
def unknown_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Probe every model, even if the tests' cache contains its sizes."""
    monkeypatch.setattr(sizes, "_cache", {})


WELDS = "".join(f'<weld body1="b{i}" active="false"/>' for i in range(8))
BALLS = "".join(f'<body name="b{i}" pos="{i} 0 1"><freejoint/><geom size=".1"/></body>' for i in range(8))
MOTOR = '<actuator><motor site="s"/></actuator>'
FLOATING = (
    f'<mujoco><option gravity="0 0 0"/><worldbody>{BALLS}<site name="s"/></worldbody>'
    f"<equality>{WELDS}</equality>{MOTOR}</mujoco>"
)

TASK = f'''
import mujoco
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    eq_active: Row[wp.bool]
    geom_size: Row[wp.vec3]


@wp.struct
class Params:
    welds: int = 8


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return 1.0


@wp.func
def initialize(s: World, p: Params):
    for i in range(p.welds):
        s.eq_active[i] = True


class Welded(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string("""{FLOATING}"""))
    obs = {{"x": 1}}
    horizon = 0
'''


def test_buffers_have_room_for_welds_that_a_task_activates(
    task_file: TaskFile, caplog: pytest.LogCaptureFixture
) -> None:
    env = lw.make(task_file("welded.py", TASK), engine="warp", nworld=2)
    assert env.engine.njmax >= 8 * 6  # type: ignore[attr-defined]
    for _ in range(2):
        env.step()
        assert (env.reward == 1).all() and not env.done_reason.any()
    assert not caplog.messages


def test_randomized_fields_that_add_contacts_log_a_warning(
    task_file: TaskFile, caplog: pytest.LogCaptureFixture
) -> None:
    drawing = TASK.replace("        s.eq_active[i] = True\n", "        s.geom_size[i][0] = 0.05\n")
    lw.make(task_file("drawing.py", drawing), engine="warp", nworld=2)
    (message,) = caplog.messages
    assert "measured on the model's own geom_size, which the task randomizes" in message
    caplog.clear()
    lw.make(task_file("drawing.py", drawing), engine="warp", nworld=2, nconmax=16, njmax=64)
    lw.make(task_file("drawing.py", drawing), nworld=2)
    assert not caplog.messages


def test_buffers_have_rows_for_every_limit_if_ranges_are_randomized() -> None:
    joints = "".join(
        f'<body pos="{i} 0 0"><joint range="-900 900" limited="true"/><geom size=".1"/></body>' for i in range(20)
    )
    model = mujoco.MjModel.from_xml_string(f'<mujoco><option gravity="0 0 0"/><worldbody>{joints}</worldbody></mujoco>')
    assert probe_sizes(model)[1] < 20 <= probe_sizes(model, [describe_model_field(model, "jnt_range")])[1]


def test_buffers_have_room_for_contacts_at_the_end_of_slow_servos() -> None:
    """Random velocities average out, so random controls do not bring this plate of 8 balls to the floor."""
    plate = "".join(f'<geom size=".1" pos="{i} 0 0"/>' for i in range(8))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
        <worldbody><geom type="plane" size="9 9 1"/>
            <body pos="0 0 .7"><joint name="z" type="slide" axis="0 0 1"/>{plate}</body></worldbody>
        <actuator><intvelocity joint="z" kp="1e5" kv="1e4" ctrlrange="-1 1" actrange="-1 1"/></actuator></mujoco>""")
    contacts, constraints = probe_sizes(model)
    assert contacts >= 8 and constraints >= 8 * 4


def test_buffers_of_panda_lift_have_room_for_a_million_random_steps(shared_env: SharedEnv) -> None:
    """A million random steps of the task on the C engine had at most 83 constraints."""
    assert probe_sizes(shared_env("panda_lift").model)[1] > 83
