"""Name the reasons why an episode ends, as bits.

Both engines report the same bits for the same fault, except for their own limits: a world of the C engine that runs out
of arena memory may report ENGINE_WARNING beside an overflow, and MuJoCo Warp reports an overflow of the contact pool in
every world whose contacts did not fit.
"""

import enum

from lyceum_warp.support.docstrings import document_attributes


@document_attributes
class Done(enum.IntFlag):
    """Why an episode ended; ``env.done_reason`` holds these bits for each world."""

    TERMINATED = 1
    """The task's ``terminated`` returned True."""
    TRUNCATED = 2
    """The time limit was reached. ``env.truncated`` also includes faults."""
    NAN = 4
    """A state or a control is not-a-number or beyond 1e10, or task memory is not finite."""
    CONTACT_OVERFLOW = 8
    """More contacts than the engine had room for."""
    CONSTRAINT_OVERFLOW = 16
    """More constraints than the engine had room for."""
    ENGINE_WARNING = 32
    """Any other warning of the engine."""
    ACTION = 64
    """The action was not finite, and was applied as zero."""
    REWARD = 128
    """The reward was not finite."""
    OBSERVATION = 256
    """The observation was not finite."""
    MODEL = 512
    """A drawn model field cannot be simulated, such as a negative mass."""


FAULTS = ~(Done.TERMINATED | Done.TRUNCATED)
"""The bits that are faults; the others are ordinary ends of an episode."""
