"""Test whether a robot follows every clip."""

from collections.abc import Callable, Iterator

import torch

import lyceum_warp as lw


class Tracks(lw.Gate):
    pass
