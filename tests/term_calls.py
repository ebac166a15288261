"""Call functions of ``lyceum_warp.terms`` in many worlds at once."""

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp import terms
from lyceum_warp.binding import is_row, overloads
from lyceum_warp.binding.sources import run_source

N = 256
MODULE = wp.Module("term_calls", None)
"""All kernels are in one Warp module, so that Warp compiles them together."""


def kernel_of(function: wp.Function, number: int) -> wp.Kernel:
    kinds = {
        argument: wp.array(dtype=kind.dtype, ndim=2) if is_row(kind) else wp.array(dtype=kind, ndim=1)
        for argument, kind in function.input_types.items()
    }
    line = f"function({', '.join(f'{argument}[world]' for argument in kinds)})"
    if (result := function.func.__annotations__.get("return")) is not None:
        kinds["out"] = wp.array(dtype=result, ndim=1)
        line = f"out[world] = {line}"
    name = f"call_{function.key}_{number}"
    arguments = ", ".join(f"{argument}: kinds['{argument}']" for argument in kinds)
    scope = {"wp": wp, "function": function, "kinds": kinds}
    run_source(f"def {name}({arguments}):\n    world = wp.tid()\n    {line}\n", f"<{name}>", scope)
    return wp.Kernel(scope[name], module=MODULE, options={"enable_backward": False})


KERNELS = {
    name: [(each, kernel_of(each, i)) for i, each in enumerate(overloads(getattr(terms, name)))]
    for name in terms.__all__
}


@dataclasses.dataclass
class Call:
    """The return values (N, ...) of a function, and its arguments after the call."""

    result: np.ndarray
    after: dict[str, np.ndarray]


def call(name: str, overload: int = 0, **values: Any) -> Call:
    """Call a function in N worlds. An argument is one value for all worlds, or one entry per world.

    Each world has its own ``rng``. If several overloads accept the arguments, ``overload`` selects one.
    """
    matching = [
        (function, kernel) for function, kernel in KERNELS[name] if {*function.input_types} - {"rng"} == {*values}
    ]
    function, kernel = matching[overload]
    values["rng"] = np.arange(7, 7 + N)[:, None]
    arrays = {}
    for argument, kind in function.input_types.items():
        dtype = kind.dtype if is_row(kind) else kind
        axes = 1 + is_row(kind) + len(getattr(dtype, "_shape_", ()))
        value = np.asarray(values[argument])
        value = np.broadcast_to(value, (N, *value.shape[value.ndim - axes + 1 :]))
        arrays[argument] = wp.array(value, dtype=dtype, device="cpu")
    result = function.func.__annotations__.get("return")
    out = [] if result is None else [wp.zeros(N, dtype=result, device="cpu")]
    wp.launch(kernel, N, [*arrays.values(), *out], device="cpu")
    after = {argument: array.numpy() for argument, array in arrays.items()}
    return Call(out[0].numpy() if out else np.empty(0), after)
