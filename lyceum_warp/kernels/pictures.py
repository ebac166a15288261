"""Unpack the pictures of MuJoCo Warp's renderer."""

import warp as wp


@wp.kernel(enable_backward=False)
def unpack_rgb(packed_in: wp.array2d[wp.uint32], rgb_out: wp.array3d[wp.uint8]):
    """Unpack colours from the bytes blue, green, red, alpha; launched over (nworld, pixels)."""
    w, i = wp.tid()
    color = packed_in[w, i]
    rgb_out[w, i, 0] = wp.uint8((color >> wp.uint32(16)) & wp.uint32(0xFF))
    rgb_out[w, i, 1] = wp.uint8((color >> wp.uint32(8)) & wp.uint32(0xFF))
    rgb_out[w, i, 2] = wp.uint8(color & wp.uint32(0xFF))
