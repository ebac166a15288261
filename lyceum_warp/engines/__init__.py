"""Physics behind one contract: the C engine (mujoco.batch) and the Warp engine (mujoco_warp)."""

import importlib

import mujoco
import torch
import warp as wp

from lyceum_warp.engines.base import Engine, EngineFactory
from lyceum_warp.fields import Field, Stage, describe, elements
from lyceum_warp.validate import whole_number

_ENGINES = {
    "mujoco": ("lyceum_warp.engines.c.mujoco_engine", "MujocoEngine"),
    "warp": ("lyceum_warp.engines.warp.warp_engine", "WarpEngine"),
}

_FLAGS = {"deterministic", "unroll"}
"""Options that are given to an engine only if they are True."""

ON_CPU_CORES = {"engine": "mujoco", "device": "cpu", "nconmax": None, "njmax": None}
"""Options of an environment that a GPU was meant for, and which is better off on the CPU: what was said of the Warp
engine has nothing to say there."""


def find_device(device: str | None) -> wp.Device:
    """The Warp device of a name.

    Raises:
        ValueError: There is no such device on this machine.
    """
    name, error = str(device or "cpu"), None
    if wp.is_cuda_available() or not name.startswith("cuda"):  # without a driver, Warp would print before it fails
        try:
            found = wp.get_device(name)
        except (ValueError, RuntimeError) as cause:
            error = cause
        else:
            if found.is_cuda and not torch.cuda.is_available():
                raise ValueError(
                    f"Warp has the device {name!r}, but torch {torch.__version__} is built without CUDA or does not "
                    "see it: install a CUDA build of torch"
                )
            return found
    names = ", ".join(repr(d.alias) for d in wp.get_devices())
    raise ValueError(
        f"there is no device {name!r} on this machine; it has {names} (for a GPU, check that nvidia-smi shows it "
        "and that its driver is recent enough for Warp)"
    ) from error


def open_engine(
    engine: "str | EngineFactory", model: mujoco.MjModel, nworld: int, device: wp.Device, **options: int | bool | None
) -> Engine:
    """Make an engine by name, or by a factory of your own.

    Args:
        engine: "mujoco", "warp", "auto" (Warp on CUDA, MuJoCo's C engine on the CPU), or a callable with the
            signature of an engine class.
        model: The compiled model.
        nworld: Number of worlds.
        device: Where it runs.
        options: Engine options: ``nthread`` of the C engine, ``nconmax``, ``njmax``, ``deterministic`` and ``unroll``
            of the Warp engine. None leaves an engine its default.

    Raises:
        ValueError: There is no such engine, or it refuses the model, the device or an option.
    """
    if engine == "auto":
        engine = "mujoco" if device.is_cpu else "warp"
    given: dict[str, int | bool] = {
        key: whole_number(key, value, low=0 if key == "nthread" else 1)
        for key, value in options.items()
        if value is not None and key not in _FLAGS
    }
    if engine != "mujoco":  # which is deterministic anyway, and has nothing to unroll
        given |= {key: True for key in _FLAGS if options.get(key)}
    if not callable(engine):
        if engine not in _ENGINES:
            raise ValueError(f"there is no engine {engine!r}: use one of 'auto', {', '.join(map(repr, _ENGINES))}")
        module, attribute = _ENGINES[engine]
        known = {"mujoco": {"nthread"}, "warp": {"nconmax", "njmax", *_FLAGS}}[engine]
        if unknown := given.keys() - known:
            names = sorted(known - _FLAGS)
            raise ValueError(f"the {engine} engine takes no {', '.join(sorted(unknown))}; it takes {names}")
        return getattr(importlib.import_module(module), attribute)(model, nworld, device, **given)
    return engine(model, nworld, device, **given)


__all__ = [
    "ON_CPU_CORES",
    "Engine",
    "EngineFactory",
    "Field",
    "Stage",
    "describe",
    "elements",
    "find_device",
    "open_engine",
]
