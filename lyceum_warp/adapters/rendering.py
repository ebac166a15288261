"""How the adapters' environments are drawn."""

from lyceum_warp.env import Env

RENDER_MODES = ["rgb_array"]
"""What ``render_mode`` may be, beside None."""


def check_render_mode(render_mode: str | None) -> None:
    """Check that a way to render is known.

    Raises:
        ValueError: It is not.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"there is no render_mode {render_mode!r}: use 'rgb_array', or None for no pictures")


def frame_rate(env: Env) -> int:
    """Pictures per second at which a picture of every step shows the simulation's own speed."""
    return max(1, round(1 / env.timestep))
