"""Unpack the pictures of MuJoCo Warp's renderer."""

import warp as wp


@wp.func
def _turned(color: wp.uint32) -> wp.uint32:
    """Return the bytes red, green, blue, 0."""
    byte = wp.uint32(0xFF)
    return ((color >> wp.uint32(16)) & byte) | (color & (byte << wp.uint32(8))) | ((color & byte) << wp.uint32(16))


@wp.kernel(enable_backward=False)
def unpack_rgb(packed_in: wp.array2d[wp.uint32], rgb_out: wp.array2d[wp.uint32]):
    """Unpack colours from the bytes blue, green, red, alpha; launched over (nworld, pixels / 4).

    Four pixels make three whole words.
    """
    w, i = wp.tid()
    first, second = _turned(packed_in[w, 4 * i]), _turned(packed_in[w, 4 * i + 1])
    third, fourth = _turned(packed_in[w, 4 * i + 2]), _turned(packed_in[w, 4 * i + 3])
    rgb_out[w, 3 * i] = first | (second << wp.uint32(24))
    rgb_out[w, 3 * i + 1] = (second >> wp.uint32(8)) | (third << wp.uint32(16))
    rgb_out[w, 3 * i + 2] = (third >> wp.uint32(16)) | (fourth << wp.uint32(8))
