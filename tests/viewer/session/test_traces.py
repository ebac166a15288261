import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.viewer.session.drivers import PlanView, WorldControl
from lyceum_warp.viewer.session.traces import TraceRollouts, trace_point

ARM = """<mujoco><worldbody><body name="base"><body name="upper"><joint name="a" axis="0 1 0"/><geom size=".1"/>
<body name="hand" pos="0 0 1"><joint name="b" axis="0 1 0"/><geom size=".1"/>{site}</body></body></body>
<body name="ball" pos="1 0 0"><freejoint/><geom size=".1"/></body></worldbody>
<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("task", "field", "name"),
    [
        ("hopper", "subtree_com", "torso"), ("humanoid", "subtree_com", "torso"), ("reach", "site_xpos", "finger"),
        ("cartpole", "xipos", "pole"),
    ],
)  # fmt: skip
def test_default_trace_point_is_the_centre_of_mass_or_the_end_of_an_arm(
    shared_env: SharedEnv, task: str, field: str, name: str
) -> None:
    model = shared_env(task).model
    index = (model.site if field == "site_xpos" else model.body)(name).id
    assert trace_point(model) == (field, index)


def test_trace_point_may_be_a_site_a_body_or_the_choice_of_the_task() -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(site='<site name="tip" pos="0 0 1"/>'))
    assert trace_point(model) == ("site_xpos", 0)
    bare = mujoco.MjModel.from_xml_string(ARM.format(site=""))
    assert trace_point(bare) == ("xipos", bare.body("hand").id)
    assert trace_point(model, "ball") == ("xpos", model.body("ball").id)
    with pytest.raises(ValueError, match="no site and no body 'nose' to trace: it has tip, base, upper, hand, ball"):
        trace_point(model, "nose")


def test_traces_equal_the_paths_of_the_samples(shared_env: SharedEnv) -> None:
    plant = lw.make("reach", autoreset=False, fields=["site_xpos"])
    mppi = lw.MPPI("reach", samples=6, horizon=5)
    control = WorldControl("mppi", mppi, plant)
    assert control.look() is None
    plant.rand_reset(3)
    start = plant.get_state()
    control.action(0, start[0], plant.obs[0], wait=True)
    view = control.look()
    assert view is not None
    best = int(mppi.returns.argmax())
    assert torch.equal(view.samples[:, 0], mppi.sampled[:, best])
    traces = TraceRollouts(mppi, plant)(view)
    assert traces.paths.shape == (7, 6, 3)
    rewards = []
    for path, actions in zip(
        traces.paths[[0, 3, 6]], (view.samples[:, 0], view.samples[:, 3], view.actions), strict=True
    ):
        plant.set_state(start)
        site = plant.field("site_xpos", "finger")[0]
        np.testing.assert_array_equal(path[0], site)
        for point, action in zip(path[1:], actions, strict=True):
            plant.step(action[None])
            np.testing.assert_allclose(point, site, atol=1e-6)
            rewards.append(plant.reward.item())
    qpos = plant.get_state()[0, plant.state_space.parts["qpos"]]
    np.testing.assert_allclose(traces.final[plant.state_space.parts["qpos"]], qpos, atol=1e-6)
    np.testing.assert_allclose(traces.rewards, rewards[-5:], rtol=1e-5)  # the plan is the last path
    assert control.look() is None  # unchanged


def test_traces_are_computed_without_events() -> None:
    paths = []
    for pushes in ([0.015 * step for step in range(1, 5)], [1e6]):
        plant = lw.make("humanoid_stand", autoreset=False, push_times=pushes, push_impulse=[10.0, 10.0])
        view = PlanView(plant.get_state()[0], torch.zeros(4, plant.action_space.size), torch.zeros(4, 0, 17))
        paths.append(TraceRollouts(object(), plant)(view).paths)
    np.testing.assert_array_equal(*paths)
