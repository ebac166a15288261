"""Export policies to ONNX or to torch's format, so that they run without this package."""

import contextlib
import copy
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from lyceum_warp.algos.common.networks import Normalizer
from lyceum_warp.algos.common.transfer import EXACT, physics_text, task_physics
from lyceum_warp.env.env import Env
from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.files import replaced
from lyceum_warp.support.settings import temporarily
from lyceum_warp.support.tensors import repeatable
from lyceum_warp.support.validate import described, first_sentence

_SUFFIXES = (".onnx", ".pt2")


def export_policy(
    policy: torch.nn.Module, path: str | Path, *, env: Env | None = None, physics: str | None = None
) -> Path:
    """Export a policy's ``act`` to a file that runs without this package.

    The exported file includes the normaliser. It maps float32 observations (n, nobs), with any n, to actions without
    noise. Unlike environments, it does not clip controls to the actuators' ranges.

    ===========  ======================================================================================
    ``.onnx``    input ``obs``, output ``action``; for ONNX Runtime, TensorRT, OpenVINO, ...
    ``.pt2``     ``torch.export.load(path).module()(obs)``, needs only torch; also for C++ (AOTInductor)
    ===========  ======================================================================================

    A policy with memory has a second input ``state`` (n, state_size), which is 0 when an episode begins, and a second
    output ``next_state``. For each camera, there is an input with the name of its group after ``obs``, such as
    ``camera`` (n, height, width, channels). A policy that sees only cameras has no input ``obs``.

    Example:
        >>> export_policy(load("runs/mine"), "policy.onnx")
        >>> session = onnxruntime.InferenceSession("policy.onnx")
        >>> (action,) = session.run(["action"], {"obs": obs})  # NumPy arrays, (n, nobs) and (n, nact)

    Args:
        policy: A module with the method ``act`` and the attribute ``nobs``.
        path: Path of the file; an existing file is replaced.
        env: An environment of the policy's task. With an environment, an ONNX file also contains the
            ``deployment_metadata``. Its memory tells how far the training's curricula had come.
        physics: Text of the metadata on the physics in which the policy has learned, if it is not that of ``env``.

    Returns:
        The file's path.

    Raises:
        ImportError: The extra ``export``, which ``.onnx`` requires, is not installed.
        ValueError: The file has an unsupported suffix, or the policy hides memory or cannot be exported.
    """
    if not (isinstance(policy, torch.nn.Module) and hasattr(policy, "act") and hasattr(policy, "nobs")):
        raise ValueError(f"policy must be a module with act and nobs, as lw.load(run) returns, not {described(policy)}")
    path = Path(path)
    check_export(path)
    nobs: Any = policy.nobs
    size = getattr(policy, "state_size", 0)
    alone = (_Remembering if size else _Acting)(copy.deepcopy(policy)).cpu().eval().requires_grad_(False)
    inputs, outputs = (["obs", "state"], ["action", "next_state"]) if size else (["obs"], ["action"])
    batch, pictures = {0: torch.export.Dim("batch")}, getattr(policy, "pictures", {})
    obs: Any = torch.zeros(2, nobs)
    if pictures:
        # an rgb picture has three channels, and a depth picture one
        kinds = {group: torch.uint8 if shape[-1] == 3 else torch.float32 for group, shape in pictures.items()}
        seen = tuple(torch.zeros(2, *shape, dtype=kinds[group]) for group, shape in pictures.items())
        obs = (obs, *seen) if nobs else seen
        inputs = [*(["obs"] if nobs else []), *pictures, "state"]
    example = (obs, torch.zeros(2, size))[: 2 if size else 1]
    shapes = (tuple(batch for _ in obs) if pictures else batch, batch)[: len(example)]
    try:
        with _quiet():
            repeatable(alone, *example)
            program: Any = torch.export.export(alone, example, dynamic_shapes=shapes)
            if path.suffix == ".onnx":
                program = torch.onnx.export(
                    program, input_names=inputs, output_names=outputs, dynamo=True, verbose=False
                )
                if env is not None:
                    metadata = deployment_metadata(policy, env, physics)
                    program.model.metadata_props.update({name: json.dumps(value) for name, value in metadata.items()})
    except Exception as error:  # torch raises many types of errors
        reason = first_sentence(error)
        raise ValueError(f"the policy's network cannot be exported to {path.suffix} ({reason})") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as temporary:
        if path.suffix == ".onnx":
            program.save(str(temporary), external_data=False)
        else:
            with temporary.open("wb") as file:
                torch.export.save(program, file)
    return path


def deployment_metadata(policy: torch.nn.Module, env: Env, physics: str | None = None) -> dict[str, Any]:
    """Describe a policy's inputs, outputs and timing, as needed on a robot or in another simulator.

    ================  ===================================================================================
    ``task``          name of the task
    ``timestep``      seconds between two actions
    ``substep``       seconds between two steps of the exact physics
    ``physics``       the physics in which the policy has learned, by default that of ``env``
    ``observations``  the parts of an observation in order: name, size, and the normaliser's offset and
                      scale of each column; the file applies them: (obs - offset) * scale
    ``cameras``       the cameras whose pictures the policy sees, if any; see ``lw.Camera``
    ``actions``       the parts of an action in order: name and size
    ``actuators``     names of the model's actuators, in order
    ``fit``           values and intervals of the fit (``lw.fit``) that ``env`` used, if any
    ================  ===================================================================================

    A task may add entries (``lw.Task.deployment``); ``walkers.deployment`` lists the entries of velocity tasks.
    """
    exact = env if task_physics(env)[1] == EXACT else env.replicate_few(1, physics=EXACT)
    task, model = env.task, exact.task.nominal  # a robot gets the commands of the model before the fit
    memory = {name: values.numpy(force=True) for name, values in {**env.shared, **env.lasting}.items()}
    parts = [{"name": name, "size": part.stop - part.start} for name, part in env.obs_space.parts.items()]
    normalizer: Any = getattr(policy, "normalizer", None)
    if isinstance(normalizer, Normalizer):
        for entry, part in zip(parts, env.obs_space.parts.values(), strict=True):
            entry |= {"offset": normalizer.shift[part].tolist(), "scale": normalizer.scale[part].tolist()}
    groups = getattr(policy, "groups", ("policy",))
    cameras = [vars(camera) for camera in task.cameras if camera.group in groups]
    return {
        "task": task.name,
        "timestep": env.timestep,
        "substep": model.opt.timestep,
        "physics": physics or physics_text(task.definition, env.options.physics),
        "observations": parts if "policy" in groups else [],
        **({"cameras": cameras} if cameras else {}),
        "actions": [{"name": name, "size": part.stop - part.start} for name, part in env.action_space.parts.items()],
        "actuators": [model.actuator(i).name or f"actuator_{i}" for i in range(model.nactuator)],
        **({} if task.fit is None else {"fit": task.fit.metadata}),
        **task.definition.deployment(model, SimpleNamespace(**task.params), memory),
    }


class _Acting(torch.nn.Module):
    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        action: torch.Tensor = self.policy.act(obs)
        return action


class _Remembering(_Acting):
    def forward(self, obs: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        outputs: tuple[torch.Tensor, torch.Tensor] = self.policy.act(obs, state)
        return outputs


def check_export(path: Path) -> None:
    """Check a file's suffix, and whether the packages for its format are installed."""
    if path.suffix not in _SUFFIXES:
        raise ValueError(f"{path} must end with {' or '.join(_SUFFIXES)}")
    if path.suffix == ".onnx":
        check_extra("export to ONNX", "export", "onnx", "onnxscript")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    logger = logging.getLogger("torch.onnx")
    with temporarily(logger.setLevel, logging.ERROR, logger.level), warnings.catch_warnings(action="ignore"):
        yield
