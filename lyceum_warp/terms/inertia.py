"""Draw mass, centre of mass and inertia of a body together, so that they stay physically consistent.

They are consistent if and only if the pseudo-inertia matrix J (4 x 4) is positive definite. For an upper triangular
matrix U with a positive diagonal, J' = U J U^T is also positive definite. U has the log-Cholesky parameters of Rucker
and Wensing 2022, "Smooth parameterization of rigid-body inertia". It maps the body's mass affinely, x -> D x + t, and
scales its density.
"""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.kernels.random import uniform
from lyceum_warp.kernels.rotations import quat_from_mat, quat_mul, quat_to_mat


@wp.func
def symmetric_eigenvectors(matrix: wp.mat33) -> wp.mat33:
    """Compute the eigenvectors of a symmetric matrix, as the columns of a rotation, by Jacobi's method.

    Source: Golub and Van Loan, "Matrix computations", section 8.5. For a nearly diagonal matrix the result is close to
    the identity.
    """
    a = matrix
    vectors = wp.identity(n=3, dtype=float)
    for turn in range(int(15)):  # five sweeps over three planes converge to the precision of float32
        i = turn % 3
        k = (i + 1) % 3
        difference = a[i, i] - a[k, k]
        # at most 45 degrees
        angle = 0.5 * wp.atan2(wp.where(difference < 0.0, -2.0, 2.0) * a[i, k], wp.abs(difference))
        rotation = wp.identity(n=3, dtype=float)
        rotation[i, i] = wp.cos(angle)
        rotation[k, k] = wp.cos(angle)
        rotation[i, k] = -wp.sin(angle)
        rotation[k, i] = wp.sin(angle)
        a = wp.transpose(rotation) * a * rotation
        vectors = vectors * rotation
    return vectors


@wp.func
def change_inertia(
    body_mass: Row[float],
    body_ipos: Row[wp.vec3],
    body_inertia: Row[wp.vec3],
    body_iquat: Row[wp.vec4],
    body: int,
    density: float,
    stretch: wp.vec3,
    shear: wp.vec3,
    shift: wp.vec3,
):
    """Move each mass point x of a body to D x + t in the body's frame, and multiply all masses by exp(2 density).

    The matrix D is [[exp d1, s12, s13], [0, exp d2, s23], [0, 0, exp d3]], with (d1, d2, d3) = stretch, (s12, s13, s23)
    = shear and t = shift. With all parameters zero, the body does not change. Sources: Rucker and Wensing 2022, and
    mjlab 1.6.0, ``pseudo_inertia``, with density = alpha.
    """
    d = wp.mat33(
        wp.exp(stretch[0]), shear[0], shear[1], 0.0, wp.exp(stretch[1]), shear[2], 0.0, 0.0, wp.exp(stretch[2])
    )
    factor = wp.exp(2.0 * density)
    # compute second moments about the centre of mass in the principal axes, in which D becomes frame^T D frame
    inertia = body_inertia[body]
    moments = wp.vec3(0.5 * (inertia[0] + inertia[1] + inertia[2])) - inertia
    frame = quat_to_mat(body_iquat[body])
    local = wp.transpose(frame) * d * frame
    changed = factor * (local * wp.diag(moments) * wp.transpose(local))
    axes = symmetric_eigenvectors(changed)
    principal = wp.get_diag(wp.transpose(axes) * changed * axes)
    body_mass[body] = factor * body_mass[body]
    body_ipos[body] = d * body_ipos[body] + shift
    body_inertia[body] = wp.vec3(principal[1] + principal[2], principal[2] + principal[0], principal[0] + principal[1])
    body_iquat[body] = quat_mul(body_iquat[body], quat_from_mat(axes))


@wp.func
def draw_inertia(
    body_mass: Row[float],
    body_ipos: Row[wp.vec3],
    body_inertia: Row[wp.vec3],
    body_iquat: Row[wp.vec4],
    body: int,
    density: float,
    stretch: wp.vec3,
    shear: wp.vec3,
    shift: wp.vec3,
    rng: Row[wp.uint32],
):
    """Call ``change_inertia`` with parameters from U(-density, density), U(-stretch, stretch), and so on."""
    change_inertia(
        body_mass,
        body_ipos,
        body_inertia,
        body_iquat,
        body,
        uniform(rng, -density, density),
        uniform(rng, -stretch, stretch),
        uniform(rng, -shear, shear),
        uniform(rng, -shift, shift),
    )
