from lyceum_warp.viz.cameras import (
    CameraChoice as CameraChoice,
    FreeCamera as FreeCamera,
    find_camera as find_camera,
)
from lyceum_warp.viz.extra import NoVideoError as NoVideoError
from lyceum_warp.viz.ghosts import (
    REFERENCE as REFERENCE,
    reference_states as reference_states,
)
from lyceum_warp.viz.moments import draw_moments as draw_moments
from lyceum_warp.viz.page import show as show, write_page as write_page, write_states as write_states
from lyceum_warp.viz.pictures import WorldPictures as WorldPictures
from lyceum_warp.viz.policy_videos import (
    NamedProgress as NamedProgress,
    one_line as one_line,
    policy_video as policy_video,
)
from lyceum_warp.viz.render import (
    Shot as Shot,
    change_model as change_model,
    owner_of as owner_of,
)
from lyceum_warp.viz.style import (
    ACCENT as ACCENT,
    LINE as LINE,
    STYLES as STYLES,
    finish_axes as finish_axes,
    new_figure as new_figure,
    save_figure as save_figure,
)
from lyceum_warp.viz.video import (
    Recorder as Recorder,
    check_video as check_video,
    write_video as write_video,
)
