"""Render the pictures of all worlds with MuJoCo Warp's ray tracer, for both engines."""

from collections.abc import Iterable, Sequence

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from lyceum_warp.core.cameras import Camera
from lyceum_warp.core.model_fields import MESH_FIELDS, SEEN
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.warp.forward import POSES
from lyceum_warp.engines.warp.sizes import data_bytes
from lyceum_warp.engines.warp.varied_model import StaticGeoms, put_varied_model, set_meshes
from lyceum_warp.engines.warp.warp_engine import WarpEngine, refusals
from lyceum_warp.kernels.pictures import unpack_rgb
from lyceum_warp.support.arrays import flat, torch_view

_BOUNDS_BYTES = 160
"""Bytes per geom of a world for the hierarchy of bounding volumes."""

_PIXEL_BYTES = {"rgb": 7, "depth": 4, "segmentation": 8}


def picture_bytes(model: mujoco.MjModel, cameras: Iterable[Camera], engine: str) -> int:
    """Estimate the bytes per world of pictures, and of the data from which they are rendered."""
    pixels = sum(camera.width * camera.height * _PIXEL_BYTES[camera.kind] for camera in cameras)
    data = 0 if engine == WarpEngine.name else data_bytes(model, 1, 1)
    return pixels and pixels + _BOUNDS_BYTES * model.ngeom + data


class Pictures:
    """Renders the current states of an engine's worlds.

    The Warp engine computes the poses in its own Data, and its next step skips them. For other engines, the poses are
    computed in another Data.

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
        with refusals(fix="use no cameras"), wp.ScopedDevice(engine.device):
            self._poses = engine if isinstance(engine, WarpEngine) else _Poses(engine)
            self._context = context = mjw.create_render_context(
                model, nworld, list(sizes.values()), kinds["rgb"], kinds["depth"], kinds["segmentation"],
                cam_active=list(sizes), use_precomputed_rays="cam_fovy" not in engine.dynamics,
                render_skybox=bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()),
            )  # fmt: skip
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
        self._poses.pose()
        with wp.ScopedDevice(self._engine.device):
            mjw.refit_bvh(self._poses.m, self._poses.d, self._context)
            mjw.render(self._poses.m, self._poses.d, self._context)
            for packed, colors in self._packed:
                wp.launch(unpack_rgb, (len(packed), packed.shape[1] // 4), [packed, colors])


class _Poses:
    """Computes the poses in the states of an engine other than the Warp engine, in a Data of its own."""

    def __init__(self, engine: Engine) -> None:
        model, seen = engine.model, [field for name, field in engine.dynamics.items() if name in SEEN]
        self._engine = engine
        self.m = put_varied_model(model, seen, engine.nworld)
        self.d = mjw.make_data(model, nworld=engine.nworld, naconmax=1, njmax=1)
        self.d.qpos = engine.arrays["qpos"]
        if model.nmocap:
            self.d.mocap_pos, self.d.mocap_quat = engine.arrays["mocap_pos"], engine.arrays["mocap_quat"].view(wp.quat)
        names = [field.name for field in seen if field.size and field.name not in MESH_FIELDS]
        self._rows = [(flat(engine.arrays[name]), flat(getattr(self.m, name))) for name in names]
        self._static = StaticGeoms(model, engine.dynamics, engine.device)
        self._everyone = wp.full(engine.nworld, True, dtype=bool)

    def pose(self) -> None:
        for source, target in self._rows:
            wp.copy(target, source)
        with wp.ScopedDevice(self._engine.device):
            set_meshes(self.m, self._engine.arrays, self._engine.model.nmesh, self._everyone)
            self._static.place(self.m, self.d, self._everyone)
            for part in POSES:
                part(self.m, self.d)


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
