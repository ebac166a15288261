import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw


@wp.struct
class Bodies:
    cvel: wp.array[wp.spatial_vector]
    com: wp.array[wp.vec3]
    pos: wp.array[wp.vec3]
    quat: wp.array[wp.vec4]


@wp.kernel
def velocities(b: Bodies, world: wp.array[wp.spatial_vector], local: wp.array[wp.spatial_vector]):
    i = wp.tid()
    world[i] = lw.body_velocity(b.cvel[i], b.com[i], b.pos[i])
    local[i] = lw.local_velocity(b.cvel[i], b.com[i], b.pos[i], b.quat[i])


def test_body_velocities_equal_those_of_mujoco() -> None:
    model = lw.gymnasium_model("humanoid.xml").spec().compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] += rng.uniform(-0.5, 0.5, model.nq)
    data.qvel[:] = rng.uniform(-5.0, 5.0, model.nv)
    mujoco.mj_forward(model, data)
    bodies = Bodies()
    fields = {"cvel": data.cvel, "com": data.subtree_com[model.body_rootid], "pos": data.xpos, "quat": data.xquat}
    for name, values in fields.items():
        setattr(bodies, name, wp.array(values, dtype=Bodies.vars[name].type.dtype, device="cpu"))
    found = [wp.zeros(model.nbody, dtype=wp.spatial_vector, device="cpu") for _ in range(2)]
    wp.launch(velocities, model.nbody, [bodies, *found], device="cpu")
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for local, out in enumerate(found):
        wanted = np.zeros((model.nbody, 6))
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, kind, body, wanted[body], local)
        assert np.abs(wanted).max() > 5.0
        np.testing.assert_allclose(out.numpy(), wanted, atol=2e-5)
