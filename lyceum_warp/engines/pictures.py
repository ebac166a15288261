"""Render the pictures of all worlds with MuJoCo Warp's ray tracer, for both engines."""

from collections.abc import Iterable, Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from lyceum_warp.core.cameras import Camera
from lyceum_warp.core.model_fields import MESH_FIELDS, SEEN
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.warp.sizes import data_bytes
from lyceum_warp.engines.warp.varied_model import StaticGeoms, put_varied_model, set_meshes
from lyceum_warp.engines.warp.warp_engine import refusals
from lyceum_warp.kernels.pictures import unpack_rgb
from lyceum_warp.support.arrays import flat, torch_view

_FOLLOWING_MASSES = [int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM), int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM)]
"""Modes of cameras and lights that follow a centre of mass."""

_BOUNDS_BYTES = 160
"""Bytes per geom of a world for the hierarchy of bounding volumes."""

_PIXEL_BYTES = {"rgb": 7, "depth": 4, "segmentation": 8}


def picture_bytes(model: mujoco.MjModel, cameras: Iterable[Camera]) -> int:
    """Estimate the bytes per world of pictures, and of the data from which they are rendered."""
    pixels = sum(camera.width * camera.height * _PIXEL_BYTES[camera.kind] for camera in cameras)
    return pixels and pixels + _BOUNDS_BYTES * model.ngeom + data_bytes(model, 1, 1)


class Pictures:
    """Renders the current states of an engine's worlds.

    The poses are computed from ``qpos`` and the mocap bodies in a Data of its own. The fields of the engine do not
    change, and may be older than the state.

    Raises:
        ValueError: The model has no camera of a name, a camera has two sizes, or MuJoCo Warp does not support the
            model.
    """

    groups: dict[str, torch.Tensor]
    """The pictures by group, (nworld, height, width, channels)."""

    def __init__(self, engine: Engine, cameras: Sequence[Camera]) -> None:
        self.cameras, self._engine = cameras, engine
        model, nworld = engine.model, engine.nworld
        sizes = _sizes(model, cameras)
        kinds = {
            kind: [any((c.name, c.kind) == (name, kind) for c in cameras) for name in sizes]
            for kind in ("rgb", "depth", "segmentation")
        }
        seen = [field for name, field in engine.dynamics.items() if name in SEEN]
        with refusals(fix="use no cameras"), wp.ScopedDevice(engine.device):
            self._model = put_varied_model(model, seen, nworld)
            self._data = data = mjw.make_data(model, nworld=nworld, naconmax=1, njmax=1)
            self._context = context = mjw.create_render_context(
                model, nworld, list(sizes.values()), kinds["rgb"], kinds["depth"], kinds["segmentation"],
                cam_active=list(sizes), use_precomputed_rays="cam_fovy" not in engine.dynamics,
                render_skybox=bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()),
            )  # fmt: skip
        data.qpos = engine.arrays["qpos"]
        if model.nmocap:
            data.mocap_pos, data.mocap_quat = engine.arrays["mocap_pos"], engine.arrays["mocap_quat"].view(wp.quat)
        names = [field.name for field in seen if field.size and field.name not in MESH_FIELDS]
        self._rows = [(flat(engine.arrays[name]), flat(getattr(self._model, name))) for name in names]
        modes = [*(model.camera(name).mode[0] for name in sizes), *model.light_mode]
        masses = [mjw.com_pos] if np.isin(modes, _FOLLOWING_MASSES).any() else []
        self._parts = [mjw.kinematics, *masses, mjw.camlight, mjw.flex]
        self._static = StaticGeoms(model, engine.dynamics, engine.device)
        self._everyone = wp.full(nworld, True, dtype=bool, device=engine.device)
        self.groups, self._packed = {}, []
        addresses = {"rgb": context.rgb_adr, "depth": context.depth_adr, "segmentation": context.seg_adr}
        buffers = {"rgb": context.rgb_data, "depth": context.depth_data, "segmentation": context.seg_data}
        for camera in cameras:
            start = int(addresses[camera.kind].numpy()[list(sizes).index(camera.name)])
            pixels = buffers[camera.kind][:, start : start + camera.width * camera.height]
            if camera.kind == "rgb":
                colors = wp.zeros((nworld, 3 * pixels.shape[1] // 4), dtype=wp.uint32, device=engine.device)
                self._packed.append((pixels, colors))
                view = torch_view(colors).view(torch.uint8)
            else:
                view = torch_view(pixels)
            self.groups[camera.group] = view.view(nworld, camera.height, camera.width, -1)

    def render(self) -> None:
        """Render all pictures, by Warp launches only."""
        for source, target in self._rows:
            wp.copy(target, source)
        with wp.ScopedDevice(self._engine.device):
            set_meshes(self._model, self._engine.arrays, self._engine.model.nmesh, self._everyone)
            self._static.place(self._model, self._data, self._everyone)
            for part in self._parts:
                part(self._model, self._data)
            mjw.refit_bvh(self._model, self._data, self._context)
            mjw.render(self._model, self._data, self._context)
            for packed, colors in self._packed:
                wp.launch(unpack_rgb, (len(packed), packed.shape[1] // 4), [packed, colors])


def _sizes(model: mujoco.MjModel, cameras: Iterable[Camera]) -> dict[str, tuple[int, int]]:
    """Get the width and height of each camera's pictures, in the model's order."""
    names = [model.camera(i).name for i in range(model.ncam)]
    sizes: dict[str, tuple[int, int]] = {}
    for camera in cameras:
        if camera.name not in names:
            choices = ", ".join(repr(name) for name in names if name) or "none"
            raise ValueError(
                f"the model has no camera {camera.name!r}: it has {choices}; give a pose, as in "
                f"lw.Camera({camera.name!r}, pos=(2, 0, 1), lookat=(0, 0, 0)), to add one"
            )
        size = camera.width, camera.height
        if (first := sizes.setdefault(camera.name, size)) != size:
            raise ValueError(f"the pictures of the camera {camera.name!r} must have one size, not {first} and {size}")
    return {name: sizes[name] for name in names if name in sizes}
