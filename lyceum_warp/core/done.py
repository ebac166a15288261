"""Define a bit for each reason why an episode ends.

Both engines report the same bits for the same fault, except in two cases. On the C engine, a world without enough arena
memory may report ENGINE_WARNING as well as an overflow. On the Warp engine, all worlds share a pool of contacts. Every
world whose contacts did not fit reports an overflow.
"""

import enum


class Done(enum.IntFlag):
    """Reasons why an episode ended, as bits. ``env.done_reason`` has each world's bits."""

    TERMINATED = 1
    """The task's ``terminated`` returned True."""
    TRUNCATED = 2
    """The time limit was reached, or the task's ``truncated`` returned True. ``env.truncated`` also includes faults."""
    NAN = 4
    """A state or a control is NaN or at least 1e10 in magnitude, or task memory is not finite."""
    CONTACT_OVERFLOW = 8
    """There were more contacts than the engine has room for."""
    CONSTRAINT_OVERFLOW = 16
    """There were more constraints than the engine has room for."""
    ENGINE_WARNING = 32
    """Any other engine warning."""
    ACTION = 64
    """The action was not finite and was replaced by zero."""
    REWARD = 128
    """The reward was NaN or at least 1e10 in magnitude."""
    OBSERVATION = 256
    """An observation was NaN or at least 1e10 in magnitude."""
    MODEL = 512
    """A randomized model field has a value that MuJoCo cannot simulate, such as a negative mass."""


FAULTS = ~(Done.TERMINATED | Done.TRUNCATED)
"""Bits of faults."""
