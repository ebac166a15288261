"""Define the reasons why an episode ends, as bits.

Both engines report the same bits for the same fault, with two exceptions. On the C engine, a world that runs out of
arena memory may report ENGINE_WARNING as well as an overflow. On the Warp engine, every world whose contacts did not
fit reports an overflow of the shared contact pool.
"""

import enum

from lyceum_warp.support.docstrings import document_attributes


@document_attributes
class Done(enum.IntFlag):
    """Reasons why an episode ended, as bits; ``env.done_reason`` has the bits of each world."""

    TERMINATED = 1
    """The task's ``terminated`` returned True."""
    TRUNCATED = 2
    """The time limit was reached. ``env.truncated`` also includes faults."""
    NAN = 4
    """A state or a control is NaN or exceeds 1e10 in magnitude, or task memory is not finite."""
    CONTACT_OVERFLOW = 8
    """The contacts exceeded the engine's capacity."""
    CONSTRAINT_OVERFLOW = 16
    """The constraints exceeded the engine's capacity."""
    ENGINE_WARNING = 32
    """Any other engine warning."""
    ACTION = 64
    """The action was not finite and was replaced by zero."""
    REWARD = 128
    """The reward was not finite."""
    OBSERVATION = 256
    """The observation was not finite."""
    MODEL = 512
    """A value of a randomized model field cannot be simulated, for example a negative mass."""


FAULTS = ~(Done.TERMINATED | Done.TRUNCATED)
"""Bits of faults; the other two bits mark ordinary ends of an episode."""
