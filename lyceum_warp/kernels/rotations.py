"""Compute with unit quaternions in MuJoCo's order w, x, y, z, in Warp functions for tasks.

The functions do not normalise their arguments, because MuJoCo's fields hold unit quaternions. Warp's own quaternion
functions do not accept quaternions in MuJoCo's order.
"""

import warp as wp

from lyceum_warp.kernels.random import uniform


@wp.func
def quat_mul(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Multiply two quaternions. The product is the rotation by ``b``, followed by the rotation by ``a``.

    (w, v) = (a_w b_w - a_v . b_v, a_w b_v + b_w a_v + a_v x b_v), as mju_mulQuat.
    """
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_inverse(q: wp.vec4) -> wp.vec4:
    """Invert a rotation: return the conjugate (w, -x, -y, -z), as mju_negQuat does."""
    return wp.vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def quat_rotate(q: wp.vec4, v: wp.vec3) -> wp.vec3:
    """Rotate a vector from the frame with orientation q into the world frame.

    The result is v + 2 u x (w v + u x v) for q = (w, u), as mju_rotVecQuat computes it.
    """
    u = wp.vec3(q[1], q[2], q[3])
    return v + 2.0 * wp.cross(u, q[0] * v + wp.cross(u, v))


@wp.func
def quat_rotate_inverse(q: wp.vec4, v: wp.vec3) -> wp.vec3:
    """Rotate a vector from the world frame into the frame with orientation q, such as a body's own frame.

    The result is v - 2 u x (w v - u x v) for q = (w, u). It equals mju_rotVecQuat for the inverse of q.
    """
    u = wp.vec3(q[1], q[2], q[3])
    return v - 2.0 * wp.cross(u, q[0] * v - wp.cross(u, v))


@wp.func
def quat_from_axis_angle(axis: wp.vec3, angle: float) -> wp.vec4:
    """Make the rotation by an angle, in rad, about a unit axis.

    The result is (cos(angle / 2), sin(angle / 2) axis), as mju_axisAngle2Quat computes it.
    """
    s = wp.sin(0.5 * angle)
    return wp.vec4(wp.cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@wp.func
def quat_from_rotvec(r: wp.vec3) -> wp.vec4:
    """Make the rotation by |r| rad about r, for example an angular velocity times a duration."""
    angle = wp.length(r)
    scale = float(0.5)  # use the limit of sin(angle / 2) / angle
    if angle > 0.0:
        scale = wp.sin(0.5 * angle) / angle
    return wp.vec4(wp.cos(0.5 * angle), scale * r[0], scale * r[1], scale * r[2])


@wp.func
def quat_to_rotvec(q: wp.vec4) -> wp.vec3:
    """Convert a rotation to its rotation vector: axis times angle, at most pi rad.

    The result is 2 atan2(|u|, w) u / |u| for q = (w, u). If w < 0, -q replaces q. Both describe the same rotation.
    With dt = 1, mju_quat2Vel computes the same result.
    """
    u = wp.vec3(q[1], q[2], q[3])
    w = q[0]
    if w < 0.0:
        u = -u
        w = -w
    sine = wp.length(u)
    scale = float(2.0)  # use the limit of 2 atan2(|u|, w) / |u|
    if sine > 0.0:
        scale = 2.0 * wp.atan2(sine, w) / sine
    return scale * u


@wp.func
def quat_difference(a: wp.vec4, b: wp.vec4) -> wp.vec3:
    """Return the rotation vector r from b to a, in the frame of b, as mju_subQuat does: a = b quat_from_rotvec(r)."""
    return quat_to_rotvec(quat_mul(quat_inverse(b), a))


@wp.func
def quat_angle(a: wp.vec4, b: wp.vec4) -> float:
    """Return the angle between two orientations, from 0 to pi rad."""
    return wp.length(quat_difference(a, b))


@wp.func
def quat_to_mat(q: wp.vec4) -> wp.mat33:
    """Convert a rotation to its matrix, with the rotated axes as columns, as mju_quat2Mat."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip


@wp.func
def quat_from_euler(angles: wp.vec3) -> wp.vec4:
    """Make the rotation by three angles, in rad: about x, then about the new y, then about the new z.

    The result equals mju_euler2Quat with the sequence "xyz", and ``euler`` in MJCF with the default ``eulerseq``.
    """
    h = 0.5 * angles
    x = wp.vec4(wp.cos(h[0]), wp.sin(h[0]), 0.0, 0.0)
    y = wp.vec4(wp.cos(h[1]), 0.0, wp.sin(h[1]), 0.0)
    z = wp.vec4(wp.cos(h[2]), 0.0, 0.0, wp.sin(h[2]))
    return quat_mul(quat_mul(x, y), z)


@wp.func
def quat_to_euler(q: wp.vec4) -> wp.vec3:
    """Convert a rotation to the angles of ``quat_from_euler``, in rad; the second is from -pi / 2 to pi / 2.

    The angles of the matrix R are atan2(-R12, R22), atan2(R02, sqrt(R12^2 + R22^2)) and atan2(-R01, R00). If the second
    angle is a right angle, only the sum or the difference of the other two angles is defined. The first angle is then
    set to 0.
    """
    m = quat_to_mat(q)
    cosine = wp.sqrt(m[1, 2] * m[1, 2] + m[2, 2] * m[2, 2])
    y = wp.atan2(m[0, 2], cosine)
    if cosine < 1e-6:  # zero, up to rounding
        return wp.vec3(0.0, y, wp.atan2(m[1, 0], m[1, 1]))
    return wp.vec3(wp.atan2(-m[1, 2], m[2, 2]), y, wp.atan2(-m[0, 1], m[0, 0]))


@wp.func
def quat_random(rng: wp.array[wp.uint32]) -> wp.vec4:
    """Draw a rotation from the uniform distribution, and advance the stream.

    The result is (a sin t, a cos t, b sin s, b cos s), with a^2 = 1 - b^2 from U(0, 1) and angles t, s from U(0, 2 pi)
    (Shoemake 1992, "Uniform random rotations").
    """
    u = uniform(rng, 0.0, 1.0)
    t = uniform(rng, 0.0, 2.0 * wp.pi)
    s = uniform(rng, 0.0, 2.0 * wp.pi)
    a, b = wp.sqrt(1.0 - u), wp.sqrt(u)
    return wp.vec4(a * wp.sin(t), a * wp.cos(t), b * wp.sin(s), b * wp.cos(s))
