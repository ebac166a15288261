"""Make videos of a policy."""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from lyceum_warp.algos import evaluation_worlds
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.env import Curriculum, Env, Policy
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.viz.cameras import CameraChoice
from lyceum_warp.viz.video import Progress, write_video

NamedProgress: TypeAlias = Callable[[str, str, int, int], object]
"""A progress callback, called with a description, a unit, the units done so far, and the total number of units."""


def policy_video(
    env: Env, policy: Policy, path: Path, seed: int, *, curriculum: Curriculum | None = None,
    camera: CameraChoice = None, progress: NamedProgress | None = None,
) -> Path:  # fmt: skip
    """Run an episode of a policy in a new world, write a video of it, and return the video's path.

    By default, the episode begins at the curriculum that ``env`` has reached.
    """
    curriculum = curriculum or Curriculum.of(env)
    one = evaluation_worlds(env, 1, autoreset=False)
    with contextlib.ExitStack() as stack:
        if progress is None:
            running: Progress = stack.enter_context(LongWork("running an episode for the video", "steps"))
        else:
            running = functools.partial(progress, "running an episode", "steps")
        (episode,) = policy_episodes(one, policy, 1, seed=seed, curriculum=curriculum, progress=running)
    rendering = None if progress is None else functools.partial(progress, "rendering the video", "frames")
    return write_video(one, episode.states, path, camera=camera, progress=rendering)


def one_line(error: BaseException) -> str:
    """Return an error's message in one line."""
    return " ".join(str(error).split()) or type(error).__name__
