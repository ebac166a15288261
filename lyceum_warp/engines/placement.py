"""Choose where worlds run: find devices by name, resolve engine="auto", and make the engine."""

import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.core.fields import Field
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.core.options import EnvOptions
from lyceum_warp.engines.base import Engine, EngineFactory
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.warp_log import start_warp

_ENGINES = {
    "mujoco": ("lyceum_warp.engines.c.mujoco_engine", "MujocoEngine"),
    "warp": ("lyceum_warp.engines.warp.warp_engine", "WarpEngine"),
}
_DETERMINISTIC = "lyceum_warp.engines.deterministic.deterministic_engine", "DeterministicEngine"

_SAMPLES_PER_CORE = 40
"""With fewer samples per CPU core than this, the C engine plans faster than an H100. Measured on 16 cores, the
break-even points are 27 samples per core on adroit_pen without noslip, 41 on reach and 58 on half_cheetah
(bench/README.md)."""

_MOST_CORES = 16
"""A machine with more CPU cores is treated like one with this many, because larger machines were not measured."""

_NOSLIP = 6
"""The noslip solver, which is slow on a GPU, raises the break-even point by this factor."""


def find_device(device: str | None) -> wp.Device:
    """Find a Warp device by name.

    Raises:
        ValueError: This machine has no such device.
    """
    name, error, remarks = str(device or "cpu"), None, start_warp()
    if wp.is_cuda_available() or not name.startswith("cuda"):  # without a driver, Warp would print a message
        try:
            warp_device = wp.get_device(name)
        except (ValueError, RuntimeError) as cause:
            error = cause
        else:
            if warp_device.is_cuda and not torch.cuda.is_available():
                raise ValueError(
                    f"Warp has the device {name!r}, but torch {torch.__version__} is built without CUDA or does not "
                    "find the device: install a CUDA build of torch"
                )
            return warp_device
    names = ", ".join(repr(d.alias) for d in wp.get_devices())
    reason = f"; {remarks[0]}" if remarks and name.startswith("cuda") else ""
    raise ValueError(
        f"there is no device {name!r} on this machine; it has {names} (for a GPU, check that nvidia-smi shows it "
        f"and that its driver is recent enough for Warp{reason})"
    ) from error


def engine_name(engine: str | EngineFactory, device: str | wp.Device | None) -> str:
    """Return the name of an engine; "auto" becomes "warp" on a CUDA device and "mujoco" on the CPU."""
    if callable(engine):
        return str(getattr(engine, "name", getattr(engine, "__name__", engine)))
    if engine == "auto":
        return "warp" if str(device or "cpu").startswith("cuda") else "mujoco"
    return engine


def open_engine(
    engine: str | EngineFactory, model: mujoco.MjModel, nworld: int, device: wp.Device, fields: Iterable[Field],
    dynamics: Iterable[ModelField] = (), initial: np.ndarray | None = None, *, reserved: int = 0, **options: Any,
) -> Engine:  # fmt: skip
    """Make an engine from its name, or from a class or factory of your own.

    Args:
        engine: "mujoco", "warp", "auto", or a callable with the signature of ``base.Engine``.
        model: The compiled model.
        nworld: Number of worlds.
        device: The device of the worlds.
        fields: The fields to provide, from ``fields.describe``.
        dynamics: The model fields that differ between worlds, from ``model_fields.describe_model_field``.
        initial: The initial state for resets; None for the model's initial state.
        reserved: The bytes per world that the caller allocates.
        options: Options of the engine; None stands for the default. An unknown option is ignored if its value is True
            or False.

    Raises:
        ValueError: The engine does not exist, the worlds do not fit into memory, or the engine does not support the
            model, the device, an option, or model fields that differ between worlds.
    """
    fields, dynamics = list(fields), list(dynamics)
    factory, kwargs = _resolved(engine, device, options)
    needed = 0
    if hasattr(factory, "bytes_per_world"):
        needed = int(factory.bytes_per_world(model, fields, dynamics, **kwargs))
        check_fit(needed + reserved, nworld, device, model=_model_name(model))
    made = factory(model, nworld, device, fields, dynamics, initial, **kwargs)
    made.estimated_bytes = needed
    return made


def options_for_few_worlds(engine: str | EngineFactory, device: str | wp.Device | None) -> dict[str, Any]:
    """Return the options to change for an environment with few worlds, as in an evaluation.

    On a GPU, few worlds take nearly as long as thousands. With engine="auto", few worlds therefore run on the C engine.
    """
    return options_on_cores() if engine == "auto" and engine_name(engine, device) == "warp" else {}


def options_for_plant(engine: str | EngineFactory, device: str | wp.Device | None) -> dict[str, Any]:
    """Return the options to change for a world that a planner controls in real time.

    On a GPU, the world's steps would wait for the planner's launches.
    """
    name = device.alias if isinstance(device, wp.Device) else device
    on_gpu = engine in ("auto", "warp") and find_device(name).is_cuda
    return options_on_cores() if on_gpu else {}


def place_samples(
    engine: str | EngineFactory, device: str | None, *, nthread: int | None, samples: int,
    spec: Callable[[], mujoco.MjSpec], solver: Mapping[str, int | float] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Choose the engine for a planner's samples, and return the options that this choice changes.

    With engine="auto" on a GPU, the choice depends on the number of samples, and on whether the noslip solver runs.

    Raises:
        ValueError: This machine has no such device.
    """
    if engine != "auto" or not find_device(device).is_cuda:
        return {}

    def has_noslip() -> bool:
        iterations = (solver or {}).get("noslip_iterations")
        return (spec().option.noslip_iterations if iterations is None else iterations) > 0

    enough = _SAMPLES_PER_CORE * min(_MOST_CORES, nthread or cpu_cores())
    if samples >= enough and (samples >= _NOSLIP * enough or not has_noslip()):
        return {"engine": "warp", "nthread": None}
    return options_on_cores()


def options_on_cores() -> dict[str, Any]:
    """Return the options that move an environment to the C engine. Options that the C engine lacks become None."""
    names = _options_of(_engine_class("mujoco", find_device("cpu"), False)) or []
    defaults = EnvOptions().for_engine()
    unused = {name: None for name, default in defaults.items() if default is None and name not in names}
    return {"engine": "mujoco", "device": "cpu", **unused}


def _resolved(
    engine: str | EngineFactory, device: wp.Device, options: dict[str, Any]
) -> tuple[EngineFactory, dict[str, Any]]:
    name = engine_name(engine, device.alias)
    factory = engine if callable(engine) else _engine_class(name, device, bool(options.get("deterministic")))
    kwargs = {key: value for key, value in options.items() if value is not None and value is not False}
    names = _options_of(factory)
    if names is None:
        return factory, kwargs
    if unknown := sorted(key for key, value in kwargs.items() if key not in names and value is not True):
        takes = f"it takes {', '.join(names)}" if names else "it takes no options"
        raise ValueError(f"the {name} engine takes no {', '.join(unknown)}; {takes}")
    return factory, {key: value for key, value in kwargs.items() if key in names}


def _engine_class(name: str, device: wp.Device, deterministic: bool) -> type[Engine]:
    if name not in _ENGINES:
        raise ValueError(f"there is no engine {name!r}: use one of 'auto', {', '.join(map(repr, _ENGINES))}")
    module, attribute = _ENGINES[name]
    if name == "warp" and deterministic and device.is_cuda:
        module, attribute = _DETERMINISTIC
    engine: type[Engine] = getattr(importlib.import_module(module), attribute)
    return engine


def _options_of(factory: EngineFactory) -> list[str] | None:
    """Return the names of an engine's options, or None if the engine accepts any."""
    parameters = inspect.signature(factory).parameters.values()
    if any(parameter.kind == parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return [parameter.name for parameter in parameters if parameter.kind == parameter.KEYWORD_ONLY]


def _model_name(model: mujoco.MjModel) -> str:
    name = model.names[: model.names.index(b"\0")].decode(errors="replace")
    return "" if name == "MuJoCo Model" else name
