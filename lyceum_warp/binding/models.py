"""Edit and compile a task's model, so that both engines simulate the same physics."""

import logging
import warnings
from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.core.fields import ON_DEMAND, SENSED
from lyceum_warp.core.model_fields import MOVED_INERTIA
from lyceum_warp.core.model_files import ModelSource, read_task_spec
from lyceum_warp.core.options import CONES, INTEGRATORS, JACOBIANS, PhysicsOptions
from lyceum_warp.core.task import Task
from lyceum_warp.models.actuators import unstable_servos
from lyceum_warp.support.mujoco_log import quiet

log = logging.getLogger(__name__)


def task_spec(task: type[Task], model: ModelSource | None = None) -> mujoco.MjSpec:
    """Load a task's model, or the given model, as an MjSpec, and apply ``edit_model`` of the task and its parents."""
    return edited(task, read_task_spec(task, model))


def edited(task: type[Task], spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Apply ``edit_model`` of a task and its parents to a copy of a spec."""
    copy = spec.copy()
    edits = [vars(owner)["edit_model"] for owner in reversed(task.__mro__) if "edit_model" in vars(owner)]
    for edit in (edit.__get__(None, task) for edit in edits):
        if "edit_model" in getattr(getattr(edit, "__code__", None), "co_names", ()):
            raise ValueError(
                "edit_model calls edit_model of another class, which would then run twice: remove the call, because "
                "the edits of all parents run first"
            )
        try:
            result: Any = edit(copy)
        except Exception as error:
            raise ValueError(
                f"edit_model fails on the model {spec.modelname!r}: {type(error).__name__}: {error}"
            ) from error
        if result is not None:
            raise ValueError(
                f"edit_model returns {type(result).__name__}: it must change the spec in place and return None"
            )
    return copy


def keyframe_state(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return a keyframe as an integration state with time 0, (integration_size,) float64."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name)
    if key < 0:
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) for i in range(model.nkey)]
        keyframes = ", ".join(repr(n) for n in names if n) or "none with a name"
        raise ValueError(f"the model has no keyframe {name!r}; it has {keyframes}")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, key)
    data.time = 0.0
    spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
    state = np.zeros(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    return state


def compile_model(
    spec: mujoco.MjSpec,
    fields: Collection[str],
    physics: PhysicsOptions,
    *,
    varied: Collection[str] = (),
    keep_meshes: bool = False,
) -> mujoco.MjModel:
    """Compile a model for both engines.

    - MuJoCo Warp has no PGS solver, so Newton replaces it. Newton converges to the same accelerations.
    - Sleep is turned off, because a saved state does not say which bodies are asleep.
    - MuJoCo computes some fields only for sensors. If such a field is read, a sensor is added after the model's own.
    - If no field is read that depends on sensors, all sensors are turned off.
    - If the energy is read, its computation is turned on.
    - If ``contact`` lists a pair of geoms twice, only the first entry is kept. MuJoCo would make the contact twice,
      and MuJoCo Warp once.

    Args:
        spec: The model. It is changed.
        fields: Names of the fields that will be read.
        physics: Options of the solver and the integrator that replace the model's own.
        varied: Names of the model fields that may differ between worlds.
        keep_meshes: Whether to compile meshes that no geom uses.
    """
    if spec.option.solver == mujoco.mjtSolver.mjSOL_PGS:
        spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
        log.info("%s asks for the PGS solver, which MuJoCo Warp lacks: Newton is used instead", spec.modelname)
    if spec.option.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        spec.option.enableflags &= ~mujoco.mjtEnableBit.mjENBL_SLEEP.value
        log.info("%s asks for sleep, which is not part of MuJoCo's state: it is turned off", spec.modelname)
    _remove_repeated_pairs(spec)
    if "energy" in fields:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    codes: dict[str, Mapping[str, Any]] = {"cone": CONES, "integrator": INTEGRATORS, "jacobian": JACOBIANS}
    for name in ("timestep", "impratio", *codes):
        if (value := getattr(physics, name)) is not None:
            setattr(spec.option, name, codes[name][value] if name in codes else value)
    if physics.discardvisual is not None:
        spec.compiler.discardvisual = physics.discardvisual
    if keep_meshes:
        spec.compiler.discardvisual = False
    for name, limit in (physics.solver or {}).items():
        setattr(spec.option, name, limit)
    for sensor in sorted({ON_DEMAND[name] for name in fields if name in ON_DEMAND}, key=int):
        body = spec.bodies[min(1, len(spec.bodies) - 1)]
        if not body.name:
            body.name = "lyceum_first_body"
        spec.add_sensor(type=sensor, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=body.name)
    if SENSED.isdisjoint(fields):
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    if not MOVED_INERTIA.isdisjoint(varied):
        for body in spec.bodies[1:]:
            body.simple = 0
    quiet()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo refuses the model: {' '.join(str(error).split())}") from error
    try:
        model.names.decode()
    except UnicodeDecodeError as error:  # each later use of the name would raise it
        name = model.names[: error.end].rsplit(b"\0", 1)[-1]
        raise ValueError(f"the name {name!r} is not UTF-8: save the model's file as UTF-8") from error
    for warning in caught:  # most warnings concern Gymnasium's XML, which users cannot change
        log.info("%s: %s", spec.modelname, warning.message)
    return model


def _remove_repeated_pairs(spec: mujoco.MjSpec) -> None:
    pairs: set[frozenset[str]] = set()
    for pair in list(spec.pairs):
        geoms = frozenset((pair.geomname1, pair.geomname2))
        if geoms in pairs:
            spec.delete(pair)
            log.info(
                "%s lists a pair of %s twice: the second entry is dropped",
                spec.modelname,
                " and ".join(sorted(geoms)),
            )
        pairs.add(geoms)


def warn_of_unstable_servos(model: mujoco.MjModel) -> None:
    """Log a warning if the model's substep is too long for one of its position servos."""
    if limits := unstable_servos(model):
        name = min(limits, key=lambda name: limits[name])
        others = f" and {len(limits) - 1} more" if len(limits) > 1 else ""
        log.warning(
            "the servo %r%s is unstable in substeps of more than %.2g ms, and a substep has %.3g ms: use "
            "integrator='discrete' or a shorter timestep",
            name, others, 1e3 * limits[name], 1e3 * model.opt.timestep,
        )  # fmt: skip
