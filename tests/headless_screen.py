"""Run the viewer's panel without a browser or a window."""

from typing import Any

import mujoco
import numpy as np
from mujoco.studio import launch_thread, messages, ux, viewer_protocol

from lyceum_warp.viewer.protocol import Frame, Scene, Status
from lyceum_warp.viewer.session.frames import model_bytes
from lyceum_warp.viewer.window.panel import Panel
from lyceum_warp.viewer.window.studio import imgui, implot

ROBOT = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <camera name="side" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <body name="ball" pos="0 0 1">
      <freejoint/>
      <geom name="ball" size=".1"/>
      <camera name="track" mode="trackcom" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    </body>
    <body name="goal" mocap="true" pos="1 0 1"><geom name="goal" size=".05" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""


def robot() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ROBOT)


def scene_of(model: mujoco.MjModel, **changes: Any) -> Scene:
    values: dict[str, Any] = dict(
        title="ball", model=model_bytes(model), nworld=8, modes=("passive", "controller", "playback"),
        controllers=("policy", "mppi"), episodes=("first", "second"), curves=("reward", "eval"),
    )  # fmt: skip
    return Scene(**values | changes)


def state_of(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def status_of(**changes: Any) -> Status:
    values: dict[str, Any] = dict(
        mode="passive", controller="policy", episode=None, world=3, step=7, steps=100, time=0.07, paused=False,
        speed=1.0, measured_speed=0.9, plan_ms=2.5, backwards=False, video=None,
    )  # fmt: skip
    return Status(**values | changes)


def frame_of(model: mujoco.MjModel, data: mujoco.MjData, status: Status | None = None, **changes: Any) -> Frame:
    values: dict[str, Any] = dict(state=state_of(model, data), model_fields={}, status=status or status_of())
    return Frame(**values | changes)


class HeadlessViewer(viewer_protocol.Viewer):
    def prepare_next_frame(self) -> bool:
        return True

    def sync(self) -> None:
        pass

    def get_drop_file(self) -> str:
        return ""

    def upload_image(self, *arguments: Any) -> int:
        return 0


class Bench:
    """The viewer's panel without a window. ``sent`` contains the messages of the panel."""

    instructions = ("viewer: http://here",)

    def __init__(self, model: mujoco.MjModel, scene: Scene) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        context, plots = imgui.CreateContext(), implot.CreateContext()
        imgui.SetCurrentContext(context)
        for module in (ux, implot):
            module.set_imgui_context(context)
            module.set_implot_context(plots)
        io = imgui.GetIO()
        io.DisplaySize = imgui.Vec2(1280, 800)
        io.BackendFlags = int(io.BackendFlags) | int(imgui.BackendFlags.RendererHasTextures)
        self.sent: list[Any] = []
        self.given: Frame | None = None
        self.models: list[mujoco.MjModel] = []
        self.send, self.offer = self.sent.append, lambda file: None
        self.told: list[str] = []
        self.tell, self.inputs = self.told.append, 0
        self.panel = Panel(scene, model, self, self, self)
        here, _ = launch_thread.make_thread_endpoints()
        config = viewer_protocol.ViewerConfig()
        self.viewer = HeadlessViewer(config, here, model=model, plugins=[self.panel])
        self.viewer.dispatch(viewer_protocol.ViewerInitEvent(viewer=self.viewer))

    def show_model(self, model: mujoco.MjModel) -> None:
        self.models.append(model)

    def take(self) -> Frame | None:
        given, self.given = self.given, None
        return given

    def show(self, status: Status) -> None:
        self.draw(frame_of(self.model, self.data, status))
        self.sent.clear()

    def draw(self, frame: Frame | None = None) -> list[Any]:
        self.given, before = frame, len(self.sent)
        imgui.NewFrame()
        self.viewer.dispatch(messages.UpdateEvent())
        self.viewer.dispatch(messages.BuildGuiEvent())
        imgui.Render()
        return self.sent[before:]
