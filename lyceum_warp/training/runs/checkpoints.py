"""Read and write checkpoints and saved policies."""

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyceum_warp import algos
from lyceum_warp.algos import GaussianPolicy, ValueFunction
from lyceum_warp.env import Curriculum
from lyceum_warp.support.files import replaced, unknown_format
from lyceum_warp.support.validate import first_sentence

FORMAT = 1
"""Format of run folders. The number increases when older releases cannot read new files."""

_FIX = "restore the file from a copy, or train again into another folder"

_CLASSES: dict[str, type[nn.Module]] = {"policy": GaussianPolicy, "value": ValueFunction}
"""The default class of each network. A file stores the name of any other class."""


def policy_content(
    iteration: int, policy: nn.Module, value: nn.Module | None = None, curriculum: Curriculum | None = None
) -> dict[str, Any]:
    """Make the content of a policy's file, with copies of the networks on the CPU."""
    content: dict[str, Any] = {"lyceum_warp": FORMAT, "iteration": iteration}
    if curriculum is not None and (memory := {name: dict(rows) for name, rows in vars(curriculum).items() if rows}):
        content["curriculum"] = memory
    for name, network in (("policy", policy), ("value", value)):
        if network is not None:
            content[name] = {
                "shape": getattr(network, "shape", None),
                "state": {key: tensor.detach().cpu().clone() for key, tensor in network.state_dict().items()},
            }
            if not isinstance(network, _CLASSES[name]):
                kind = type(network)
                content[name]["class"] = f"{kind.__module__}.{kind.__qualname__}"
    return content


def write_content(path: Path, content: Mapping[str, Any], **options: Any) -> None:
    """Replace the file of a policy or a checkpoint atomically."""
    buffer = io.BytesIO()  # Python's writes raise OSError on a full disk, unlike torch's
    torch.save(content, buffer)
    with replaced(path, **options) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def network_of(content: Mapping[str, Any], path: Path, name: str, network: nn.Module | None = None) -> nn.Module:
    """Make a network from a file's content, or load the file's weights into ``network``.

    ``name`` is "policy" or "value".
    """
    if name not in content:
        raise ValueError(f"{path} has no value function: its algorithm learns none, or the file is from rsl_rl")
    saved = content[name]
    fix = _FIX if network is None else "pass a policy with the same structure as the run's policy"
    try:
        if network is None:
            if "like" in saved:
                raise ValueError(f"rsl_rl saved this policy without its activation: pass policy={saved['like']}")
            with torch.device("meta"):  # compare shapes before allocating memory
                _new_network(name, saved).load_state_dict(saved["state"], assign=True)
            if infinite := [part for part, tensor in saved["state"].items() if not tensor.isfinite().all()]:
                raise ValueError(f"its {name}'s {infinite[0]!r} is not finite: {_FIX}")
            network = _new_network(name, saved)
        network.load_state_dict(saved["state"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except (KeyError, TypeError, AttributeError, RuntimeError, NotImplementedError) as error:
        text = " ".join(str(error).split())[:300]
        raise ValueError(f"{path} contains no {name} of lyceum_warp that fits ({text}): {fix}") from error
    return network


def _new_network(name: str, saved: Mapping[str, Any]) -> nn.Module:
    """Make a network with the class and shape in a file. The class must be part of this package."""
    kind: Any = _CLASSES[name]
    spelling, shape = saved.get("class"), saved["shape"]
    if spelling is not None:
        # The file could name any module, and importing a module runs its code. Release 0.2.0 had other module names.
        class_name = spelling.rpartition(".")[2]
        public = spelling.startswith("lyceum_warp.") and shape is not None
        kind = getattr(algos, class_name, None) if public else None
        if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
            fix = f": give one, as in lw.load(run, policy={class_name}(...))" if name == "policy" else ""
            raise ValueError(f"the {name} has a custom class, {spelling}{fix}")
    network: nn.Module = kind.like(shape) if hasattr(kind, "like") else kind(**shape)
    return network


def read_checkpoint(
    path: Path, device: str | torch.device = "cpu", *, parts: tuple[str, ...] = ("iteration", "policy", "state")
) -> dict[str, Any]:
    """Read a checkpoint or a saved policy. Code in the file is never run.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The checkpoint is broken, was not written by lyceum_warp, or was written by a newer release.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint {path}: train the run first")
    device = torch.device(device)
    try:
        data = io.BytesIO(path.read_bytes())
        with zipfile.ZipFile(data) as archive:
            # torch does not check all checksums, and ignores entries that are marked as folders
            folders = (record.filename for record in archive.infolist() if record.external_attr & 0x10)
            if (name := archive.testzip() or next(folders, None)) is not None:
                raise ValueError(f"the record {name} is corrupt")
        data.seek(0)
        content = torch.load(data, map_location=device, weights_only=True)
    except OSError:
        raise
    except Exception as error:  # zipfile and torch raise many types of errors
        raise ValueError(
            f"the checkpoint {path} is damaged, or was not written by lyceum_warp ({first_sentence(error)}): {_FIX}"
        ) from error
    if isinstance(content, dict) and not content.keys().isdisjoint(("actor_state_dict", "student_state_dict")):
        content = _from_rsl_rl(content, path)
    if not isinstance(content, dict) or "lyceum_warp" not in content:
        entries = f" (it has {', '.join(map(repr, list(content)[:4]))})" if isinstance(content, dict) else ""
        raise ValueError(f"{path} was not written by lyceum_warp{entries}: pass the policy of a run, such as policy.pt")
    if not isinstance(number := content["lyceum_warp"], int) or number != FORMAT:
        raise unknown_format(path, number, FORMAT)
    if missing := set(parts) - content.keys():
        raise ValueError(f"the checkpoint {path} lacks {', '.join(sorted(missing))}: {_FIX}")
    if wrong := [name for name, value in content.items() if not _KINDS.get(name, lambda value: True)(value)]:
        raise ValueError(f"the checkpoint {path} has an invalid value for {wrong[0]}: {_FIX}")
    if "state" in content and content["state"].get("iteration", content["iteration"]) != content["iteration"]:
        raise ValueError(f"the policy and the state in the checkpoint {path} are from different iterations: {_FIX}")
    return content


_KINDS: dict[str, Callable[[Any], bool]] = {
    "iteration": lambda value: type(value) is int and value >= 0,
    "policy": lambda value: isinstance(value, dict) and isinstance(value.get("shape"), dict | None),
    "state": lambda value: isinstance(value, dict) and type(value.get("iteration", 0)) is int,
    "score": lambda value: isinstance(value, dict) and isinstance(value.get("value"), int | float),
}  # fmt: skip


def _from_rsl_rl(saved: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Convert a checkpoint of rsl_rl 5, with an actor or a student, to the content of a policy's file."""
    actor = dict(saved.get("actor_state_dict") or saved["student_state_dict"])
    rows, units = getattr(actor.get("rnn.rnn.weight_hh_l0"), "shape", (0, 0))
    units = units if rows == 3 * units else 0  # an LSTM has more rows
    layers, state = "network.network." if units else "network.", {}
    for name in [name for name in actor if name.startswith(("mlp.", "rnn.") if units else "mlp.")]:
        new = name.replace("mlp.", layers).replace("rnn.rnn.", "network.cell.").removesuffix("_l0")
        state[new] = actor.pop(name)
    try:
        std = actor.pop("distribution.std_param", None)
        state["log_std"] = actor.pop("distribution.log_std_param") if std is None else std.log()
        if normalize := "obs_normalizer.count" in actor:
            names = ("_mean", "_var", "_std")
            mean, var, std = (actor.pop(f"obs_normalizer.{name}").squeeze(0).double() for name in names)
            count, scale = actor.pop("obs_normalizer.count").double(), 1.0 / (std + 0.01)  # rsl_rl's eps
            parts = {"count": count, "mean": mean, "square": count * var, "shift": mean.float(), "scale": scale.float()}
            state |= {f"normalizer.{name}": part for name, part in parts.items()}
        if actor:
            raise KeyError(next(iter(actor)))
        first = state["network.cell.weight_ih" if units else "network.0.weight"]
        sizes = [len(x) for name, x in state.items() if name.startswith(layers) and name.endswith(".bias")]
    except KeyError as error:
        kinds = "MLP and GRU actors with a Gaussian"
        raise ValueError(f"{path} is from rsl_rl: only {kinds} can be loaded ({error})") from error
    more = f", recurrent={units}" if units else ""
    more += ", normalize=True, limit=math.inf" if normalize else ""
    like = f"lw.GaussianPolicy({first.shape[1]}, {sizes[-1]}, {tuple(sizes[:-1])}, activation='elu'{more})"
    return {"lyceum_warp": FORMAT, "iteration": saved["iter"], "policy": {"shape": None, "state": state, "like": like}}
