"""Encode the pictures that cameras give to a policy, for the page."""

import base64
import time
from collections.abc import Callable, Mapping

import numpy as np
import torch

from lyceum_warp.core import Camera
from lyceum_warp.support.images import png

PERIOD = 0.25
"""Seconds between two pictures of a camera, because each one is sent to all pages."""
MOST_PIXELS = 256
"""Larger pictures are thinned to at most this width and height."""


class PictureMaker:
    """Makes the pictures of the displayed world while the user wants to see them."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self.shown = False
        self._cameras, self._next, self._sent = cameras, 0.0, False

    def due(self, picture_of: Callable[[str], torch.Tensor]) -> tuple[tuple[str, str], ...] | None:
        """Return captions and data URLs; nothing to hide the last pictures, or None to leave them as they are.

        Args:
            picture_of: A function that returns the picture of a group of observations, (height, width, channels).
        """
        now, sent = time.perf_counter(), self._sent
        self._sent = self.shown
        if not self.shown:
            return () if sent else None
        if now < self._next:
            return None
        self._next = now + PERIOD
        pictures = []
        for group, camera in self._cameras.items():
            pixels, text = colours(camera.kind, picture_of(group).cpu().numpy())
            address = "data:image/png;base64," + base64.b64encode(png(pixels)).decode()
            pictures.append((f"{group}: {camera.kind} {camera.width} × {camera.height}{text}", address))
        return tuple(pictures)


def colours(kind: str, picture: np.ndarray) -> tuple[np.ndarray, str]:
    """Return colours, (height, width, 3) uint8, and the end of the caption.

    In a picture of distances, near is bright. Each object of a segmentation has its own colour. Black pixels show
    nothing.
    """
    step = -(-max(picture.shape[:2]) // MOST_PIXELS)
    picture = picture[::step, ::step]
    if kind == "rgb":
        return picture, ""
    if kind == "depth":
        seen = picture > 0
        if not seen.any():
            return np.zeros((*picture.shape[:2], 3), np.uint8), ", nothing visible"
        near, far = picture[seen].min(), picture[seen].max()
        grey = np.where(seen, 255 - 205 * (picture - near) / max(far - near, 1e-6), 0)
        return grey.astype(np.uint8).repeat(3, axis=2), f", {near:.3g} (bright) to {far:.3g} m"
    number = picture[..., 0] + 7919 * picture[..., 1]  # of the id and the type
    hashed = np.stack([number * factor % 197 + 58 for factor in (37, 101, 173)], axis=-1)
    seen = picture[..., :1] >= 0
    return np.where(seen, hashed, 0).astype(np.uint8), f", {len(np.unique(number[seen[..., 0]]))} objects"
