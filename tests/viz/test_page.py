import base64
import html
import json
import re
import zlib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import SharedEnv
from headless_screen import state_of

import lyceum_warp as lw
from lyceum_warp.viz import write_states
from lyceum_warp.viz.cameras import camera_values
from lyceum_warp.viz.page import write_page

SHAPES = """
<mujoco>
  <asset>
    <mesh name="mesh" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <hfield name="ground" nrow="3" ncol="4" size="2 2 1 .1" elevation="0 0 0 0 0 1 1 0 0 0 0 0"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 .1"/><geom type="hfield" hfield="ground"/><geom type="mesh" mesh="mesh"/>
    <geom type="sphere" size=".1" group="4"/>
    <body pos="1 2 3">
      <freejoint/>
      {}
    </body>
  </worldbody>
</mujoco>
"""


def content(file: Path) -> dict[str, Any]:
    found = re.search(r"^const data = (.*);$", file.read_text(), re.MULTILINE)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    kinds = {"poses": np.float32, "indices": np.uint32, "vertices": np.dtype("3f4, 4i1, 4u1")}
    return data | {n: np.frombuffer(zlib.decompress(base64.b64decode(data[n])), kind) for n, kind in kinds.items()}


def test_page_contains_the_poses_of_the_states(shared_env: SharedEnv, tmp_path: Path) -> None:
    env = shared_env("hopper")
    env.reset()
    states = env.get_state().repeat(5, 1)
    data = content(write_page(env, states, tmp_path / "hopper.html"))
    rows = data["poses"].reshape(-1, env.model.nbody, 7)
    reference = mujoco.MjData(env.model)
    reference.qpos[:] = states[0, env.state_space.parts["qpos"]]
    mujoco.mj_kinematics(env.model, reference)
    np.testing.assert_allclose(rows[0, :, :3], reference.xpos, atol=1e-6)
    assert data["followed"] == env.model.body("torso").id
    with pytest.raises(ValueError, match="states must have the shape"):
        write_page(env, states[:, :-1], tmp_path / "hopper.html")


def test_surfaces_have_the_sizes_of_their_geoms(tmp_path: Path) -> None:
    sizes = {"sphere": (0.3,), "capsule": (0.1, 0.4), "cylinder": (0.2, 0.5), "box": (0.1, 0.2, 0.3),
             "ellipsoid": (0.1, 0.2, 0.3)}  # fmt: skip
    reach = {"sphere": (0.3,) * 3, "capsule": (0.1, 0.1, 0.5), "cylinder": (0.2, 0.2, 0.5)}
    for kind, size in sizes.items():
        geom = f'<geom type="{kind}" size="{" ".join(map(str, size))}" rgba="1 0 0 1"/>'
        model = mujoco.MjModel.from_xml_string(SHAPES.format(geom))
        camera, state = camera_values(model), state_of(model, mujoco.MjData(model))
        data = content(write_states(model, [state], tmp_path / "page.html", dt=1.0, title="</title>", camera=camera))
        assert "</title></title>" not in (tmp_path / "page.html").read_text()
        world, (first, count) = data["ranges"]
        assert world[0] == 0 and first == world[1] == 6 + 36 + 12 and count > 0  # the hidden sphere is not counted
        corners = data["vertices"][data["indices"][first : first + count]]
        np.testing.assert_allclose(np.abs(corners["f0"]).max(0), reach.get(kind, size), atol=1e-6)
        normals = corners["f1"][:, :3] / 127
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=0.02)
        assert ((normals * corners["f0"]).sum(1) > 0).all() and (corners["f2"] == [255, 0, 0, 255]).all()


def test_show_embeds_the_page_of_an_episode(shared_env: SharedEnv, tmp_path: Path) -> None:
    env = shared_env("point_mass")
    states = env.get_state()[:1].repeat(3, 1)
    shown = lw.show(env, states, height=200)._repr_html_()
    frame = re.fullmatch(r'<iframe srcdoc="([^"]*)" style=".* height: 200px; .*"></iframe>', shown, re.DOTALL)
    assert frame is not None
    assert html.unescape(frame[1]) == write_page(env, states, tmp_path / "page.html").read_text()
    with pytest.raises(ValueError, match="states"):
        lw.show(env, states[:, :-1])
