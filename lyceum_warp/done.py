"""Why an episode ended, as bits.

Both engines report the same bits for the same fault. Only limits that one engine has differ: a C world that runs out
of its arena memory may report ENGINE_WARNING beside an overflow, and MuJoCo Warp reports an overflow of its contact
pool in every world that it touched.
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
    """A state or a control became not-a-number or absurd (beyond 1e10), or task memory not finite."""
    CONTACT_OVERFLOW = 8
    """More contacts than the engine had room for."""
    CONSTRAINT_OVERFLOW = 16
    """More constraints than the engine had room for."""
    ENGINE_WARNING = 32
    """Any other warning of the engine."""
    ACTION = 64
    """The action was not finite; it was applied as zero."""
    REWARD = 128
    """The reward was not finite."""
    OBSERVATION = 256
    """A number of the observation was not finite."""
    MODEL = 512
    """A model field was drawn that cannot be simulated, such as a negative mass."""


FAULTS = ~(Done.TERMINATED | Done.TRUNCATED)
"""The bits that are faults; the others are ordinary ends of an episode."""
