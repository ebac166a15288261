"""Where a task's model comes from, and which messages say that it is not there."""

import importlib.util

import pytest

import lyceum_warp as lw


def test_gymnasium_robotics_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if "robotics" in name else find(name, *a))
    with pytest.raises(FileNotFoundError, match=r"gymnasium_robotics, .*: pip install 'lyceum-warp\[hand\]'"):
        lw.make("adroit_pen", engine="mujoco")


def test_a_model_that_gymnasium_robotics_lacks() -> None:
    with pytest.raises(FileNotFoundError, match=r"no model file 'adroit_hand/adroit_pan.xml'.* adroit_hand/adroit_pen"):
        lw.gymnasium_robotics_model("adroit_hand/adroit_pan.xml")
