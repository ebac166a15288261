"""MuJoCo Warp's substep and forward pass, made functions of the state alone."""

import mujoco_warp as mjw


def step(model: mjw.Model, data: mjw.Data) -> None:
    """Advance every world of a data by one substep."""
    _compute_velocities(model, data)
    mjw.step(model, data)


def forward(model: mjw.Model, data: mjw.Data) -> None:
    """Compute everything that follows from the states of a data."""
    _compute_velocities(model, data)
    mjw.forward(model, data)


def needs_velocities(model: mjw.Model) -> bool:
    """Whether constraints read the velocities of bodies before MuJoCo Warp computes them.

    ``mjw.make_constraint`` needs them for connect and weld constraints and runs before ``mjw.fwd_velocity``, so that it
    finds those of the last forward pass: of another state, or, after a fault, not-a-number. MuJoCo computes these
    constraints after the velocities.
    """
    return bool(model.eq_connect_adr.size or model.eq_wld_adr.size)


def _compute_velocities(model: mjw.Model, data: mjw.Data) -> None:
    if needs_velocities(model):
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)
        mjw.com_vel(model, data)
