"""What the two ends of a window's connection share, beside frames and commands."""

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

from lyceum_warp.viewer.protocol import Command, Frame, Scene

Graphics: TypeAlias = Literal["web", "native"]

MAX_POINTS, MAX_MESSAGES = 20_000, 200
"""What a frame keeps of the frames before it that were not sent."""


@dataclasses.dataclass(frozen=True)
class Opening:
    """The first message to the window's process."""

    scene: Scene
    graphics: Graphics
    host: str
    """Address on which the page is served."""
    port: int | None
    """Port of the page; the first free one from 8080 on where it is None."""
    browser: bool
    """Whether to open the page in this machine's browser."""


@dataclasses.dataclass(frozen=True)
class Opened:
    """The window runs."""

    address: str = ""
    """The page's address with its secret; empty without a page."""
    instructions: tuple[str, ...] = ()
    """Lines to print."""


@dataclasses.dataclass(frozen=True)
class Failed:
    """The window ends because of an error."""

    reason: str
    refused: bool = False
    """Whether the caller's address or port is the reason."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """The window takes another frame."""


Reply: TypeAlias = Opened | Failed | Taken | Command


def latest(older: Frame | None, newer: Frame) -> Frame:
    """The newer frame, with the points and messages of one before it that was not shown."""
    if older is None or (older.samples is None and not older.messages):
        return newer
    samples = [part for part in (older.samples, newer.samples) if part is not None]
    return dataclasses.replace(
        newer,
        samples=np.concatenate(samples)[-MAX_POINTS:] if samples else None,
        messages=(older.messages + newer.messages)[-MAX_MESSAGES:],
    )
