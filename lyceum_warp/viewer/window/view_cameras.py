"""The camera of the view: free, flying, tracking, or one of the model."""

from typing import Any

import mujoco
import numpy as np

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.window.model_values import ModelValues
from lyceum_warp.viewer.window.studio import ux


class ViewCameras:
    """Chooses the camera of the view.

    Args:
        viewer: Studio's viewer, whose camera is set. Its model may come later.
        values: The model that is shown, which has the cameras.

    """

    def __init__(self, viewer: Any, values: ModelValues) -> None:
        self.viewer, self.values = viewer, values
        self.state = ux.UxState()
        """What studio keeps of the choice."""

    def choose(self, index: int) -> None:
        """Choose studio's free, flying or tracking camera, or a camera of the model."""
        self.state.camera_index = ux.set_camera(self.values.model, self.viewer.camera, index)

    def change(self, by: int) -> None:
        """Go to the next camera, or to one before."""
        indices = self.indices()
        self.choose(indices[(indices.index(self.state.camera_index) + by) % len(indices)])

    def indices(self) -> list[int]:
        """The cameras that can be chosen, in the order of the panel."""
        return [ux.TUMBLE_CAMERA_IDX, ux.FREE_CAMERA_IDX, ux.TRACKING_CAMERA_IDX, *range(self.values.model.ncam)]

    def name(self, index: int) -> str:
        """What the panel calls a camera."""
        fixed = {ux.TUMBLE_CAMERA_IDX: "free", ux.FREE_CAMERA_IDX: "flying", ux.TRACKING_CAMERA_IDX: "tracking"}
        return fixed.get(index) or self.values.model.camera(index).name or f"camera {index}"

    def reset(self) -> None:
        """Look at the whole model; follow the body that a camera of the model follows."""
        model, camera = self.values.model, self.viewer.camera
        mujoco.mjv_defaultFreeCamera(model, camera)
        self.state.camera_index = ux.TUMBLE_CAMERA_IDX
        tracking = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
        for mode, body in zip(model.cam_mode, model.cam_bodyid, strict=True):
            if int(mode) in tracking:
                self.track(int(body))
                camera.elevation = -20
                camera.distance = 3 * self.size_of(int(body))
                return

    def size_of(self, body: int) -> float:
        """The size of a body with all that is attached to its root, metres."""
        model, data = self.values.model, mujoco.MjData(self.values.model)
        mujoco.mj_kinematics(model, data)
        moving = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
        if not moving.any():
            return float(model.stat.extent)
        sizes = model.geom_rbound[moving, None]
        low, high = (data.geom_xpos[moving] - sizes).min(0), (data.geom_xpos[moving] + sizes).max(0)
        return float(np.linalg.norm(high - low))

    def track(self, body: int) -> None:
        """Follow a body."""
        self.choose(ux.TRACKING_CAMERA_IDX)
        self.viewer.camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
        self.viewer.camera.trackbodyid = body
        self.viewer.camera.fixedcamid = -1

    def view(self) -> protocol.Camera:
        """The camera of the view."""
        camera = self.viewer.camera
        x, y, z = (float(value) for value in camera.lookat)
        return protocol.Camera(
            lookat=(x, y, z),
            distance=float(camera.distance),
            azimuth=float(camera.azimuth),
            elevation=float(camera.elevation),
            tracked_body=int(camera.trackbodyid) if camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING else -1,
            fixed=int(camera.fixedcamid) if camera.type == mujoco.mjtCamera.mjCAMERA_FIXED else -1,
        )
