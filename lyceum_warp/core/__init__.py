"""Define the vocabulary: tasks, options, spaces, fields, model files, mirrors and reasons for an end."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
