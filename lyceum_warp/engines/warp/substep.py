"""Make MuJoCo Warp's substep and forward pass functions of the state alone, and leave out what is already done."""

import functools
import inspect
import types
from collections.abc import Callable, Collection
from typing import Any

import mujoco_warp as mjw
from mujoco_warp._src import forward as upstream

Part = Callable[[mjw.Model, mjw.Data], None]
"""A part of a forward pass, in every world of a data."""

POSITION: tuple[Part, ...] = (mjw.kinematics, mjw.com_pos, mjw.camlight, mjw.flex, mjw.tendon)
"""The parts that a substep and a forward pass begin with; they are functions of positions alone."""


def step(model: mjw.Model, data: mjw.Data, done: Collection[Part] = ()) -> None:
    """Advance every world of a data by one substep.

    Args:
        model: MuJoCo Warp's model.
        data: Its data.
        done: Parts of ``POSITION`` that are already computed for the data's state.
    """
    _without(frozenset(done))["step"](model, data)


def forward(model: mjw.Model, data: mjw.Data) -> None:
    """Compute everything that follows from the states of a data."""
    _without(frozenset())["forward"](model, data)


def inertia(model: mjw.Model, data: mjw.Data) -> None:
    """Compute the inertia matrix, with the armature of tendons and of the actuators that pull at them."""
    mjw.crb(model, data)
    upstream.smooth.tendon_armature(model, data)


@functools.cache
def _without(done: frozenset[Part]) -> dict[str, Callable[..., None]]:
    """MuJoCo Warp's own functions, in whose first forward pass some parts are left out.

    They are copies whose global names stand for other functions, so that whatever else MuJoCo Warp does in a step is
    done here, too, and so that nothing changes for other users of its module.

    ``mjw.make_constraint`` reads the velocities of bodies for connect and weld constraints, and MuJoCo Warp computes
    them only later: it finds the last forward pass's, of another state, or, after a fault, not-a-number. Here they
    follow the positions, in every stage of a Runge-Kutta step.
    """
    smooth = types.SimpleNamespace(**vars(upstream.smooth) | {part.__name__: _nothing for part in done})
    positions = _copy("fwd_kinematics", smooth=smooth)

    def fwd_kinematics(model: mjw.Model, data: mjw.Data) -> None:
        positions(model, data)
        if model.eq_connect_adr.size or model.eq_wld_adr.size:
            mjw.com_vel(model, data)

    fwd_position = _copy("fwd_position", fwd_kinematics=fwd_kinematics)
    whole = _copy("_forward", fwd_position=fwd_position)
    forward = _copy("forward", _forward=whole)
    stage = _without(frozenset())["_forward"] if done else whole
    step = _copy("step", forward=forward, rungekutta4=_copy("rungekutta4", _forward=stage))
    return {"_forward": whole, "forward": forward, "step": step}


def _copy(function: str, **names: Any) -> Callable[..., Any]:
    """A copy of a function of MuJoCo Warp's, in which some of its global names stand for other objects."""
    inner: Any = inspect.unwrap(getattr(upstream, function))
    if unknown := names.keys() - set(inner.__code__.co_names):
        raise ImportError(f"{function} of this mujoco_warp uses no {min(unknown)}: use mujoco-warp 4.0")
    return types.FunctionType(inner.__code__, inner.__globals__ | names, function, inner.__defaults__)


def _nothing(model: mjw.Model, data: mjw.Data) -> None:
    """Do nothing: the part is already done."""
