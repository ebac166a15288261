import mujoco
import numpy as np
from varied_task import ball

from lyceum_warp.viz.render import change_model


def test_changed_model_has_the_poses_of_a_compiled_model() -> None:
    spec = ball()
    spec.body("ball").add_camera(name="tracking", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=[0, -2, 0])
    model = spec.compile()
    spec.body("arm").pos = [0.3, 0, 0.9]
    spec.geom("arm").mass = 5.0
    spec.geom("ball").size = [0.5, 0, 0]
    spec.option.gravity = [0, 0, -1.0]
    wanted = spec.compile()
    fields = {name: getattr(wanted, name).ravel().copy() for name in ("body_pos", "body_mass", "geom_size")}
    change_model(mujoco, model, fields | {"gravity": np.array([0, 0, -1.0]), "density": np.array([2.0])})
    assert (model.opt.gravity[2], model.opt.density) == (-1.0, 2.0)
    data = [mujoco.MjData(m) for m in (model, wanted)]
    for m, d in zip((model, wanted), data, strict=True):
        mujoco.mj_forward(m, d)
    for name in ("geom_xpos", "cam_xpos", "subtree_com"):
        np.testing.assert_allclose(getattr(data[0], name), getattr(data[1], name), atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(model.geom_size, wanted.geom_size)
