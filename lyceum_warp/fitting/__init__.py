"""Fit model fields to logs of a robot, and report what a log determines."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
