"""Draw the picture of terrain.md: MUJOCO_GL=egl python docs/terrain_picture.py."""

from pathlib import Path

import mujoco
from PIL import Image

import lyceum_warp as lw

KINDS = ("slope_up", "slope_down", "stairs_up", "stairs_down", "steps", "rough", "waves", "stones")

spec = mujoco.MjSpec()
lw.Terrain(dict.fromkeys(KINDS, 1), levels=4, border=1.0, resolution=0.05).add_to(spec)
spec.geom("terrain").rgba = [0.62, 0.58, 0.5, 1.0]
spec.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[0.6, 0.5, -0.8], diffuse=[0.8, 0.8, 0.8])
spec.add_texture(type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, rgb1=[1, 1, 1],
                 rgb2=[1, 1, 1], width=8, height=8)  # fmt: skip
model = spec.compile()
model.vis.global_.offwidth, model.vis.global_.offheight = 1280, 620
model.vis.map.zfar = 1000.0
view = mujoco.MjvCamera()
view.lookat = [0.0, -2.0, 0.0]
view.distance, view.azimuth, view.elevation = 52.0, 90.0, -42.0
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 620, 1280) as renderer:
    renderer.update_scene(data, view)
    picture = Image.fromarray(renderer.render()[140:540])
picture.save(Path(__file__).parent / "images" / "terrain.jpg", quality=80)
