"""Find a task's terms and their arguments by name, and generate the functions that compute them.

A term is a function. Its arguments are found by name, like fixtures in pytest. A name refers to the state, the action,
the result of another function, a parameter, or a field. The generated text calls each function once, and terms share
the results.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import warp as wp

from lyceum_warp.binding.sources import is_struct, overloads, run_source, source_of
from lyceum_warp.core.task import Row, Task
from lyceum_warp.support.suggestions import did_you_mean

_STEP = {"s0": "s0", "action": "action", "s1": "s1", "s": "s1", "p": "p"}
"""Maps each possible argument of a reward term or metric to a variable of the generated text."""

_STATE = {"s": "s", "s1": "s", "p": "p"}
"""Maps each possible argument of an end to a variable of the generated text."""

_ENDS = {"terminations": "terminated", "truncations": "truncated"}
"""Maps each attribute with functions that end an episode to the function that combines them."""

_OWN = ("weights", "metrics", "total")
"""Names that terms cannot have, because the generated text uses them."""

_HEAD = "s0: World, action: Row[float], s1: World, p: Params, weights: Row[float]"


class Terms:
    """The terms of a task: ``rewards``, the ends of episodes, and the metrics that have a function of their own."""

    def __init__(
        self,
        task: type[Task],
        lookup: Callable[[str], wp.Function | None],
        written: Mapping[str, wp.Function | None],
        world: Any,
        params: Any,
    ) -> None:
        self.lookup, self._world, self._params = lookup, world, params
        self.weights = self._checked_weights(task.rewards)
        self.ends = {name: self._names(name, getattr(task, name)) for name in _ENDS}
        self._reward, self._measure = written["reward"], written["measure"]
        functions = self._names("metrics", task.metrics, written=self._measure is not None)
        for attribute, kind in (("rewards", "reward"), ("rewards", "measure"), *_ENDS.items()):
            if getattr(task, attribute) and written[kind]:
                raise ValueError(f"there are {attribute} and a function {kind}: remove one of them")
        self.functions: dict[str, wp.Function] = {}
        self.text = ""
        """The source of the generated functions."""
        self.combined = {_ENDS[attribute] for attribute, names in self.ends.items() if names}
        """Names of the generated functions that end an episode."""
        ends = [name for names in self.ends.values() for name in names]
        self.metrics = (*self.weights, *task.metrics, *ends)
        if self.weights or ends or functions:
            self.text = self._written_text((*functions, *ends), len(task.metrics) - len(functions))

    def generated(self, module: str, file: str) -> dict[str, wp.Function]:
        """Generate those of ``reward``, ``score``, ``terminated`` and ``truncated`` that the task does not define.

        ``reward`` computes a transition's reward with given weights. ``score`` also writes the metrics. ``module``
        names their module, and ``file`` names the generated text in error messages.
        """
        if not self.text:
            return {}
        scope: dict[str, Any] = {"wp": wp, "Row": Row, "World": self._world, "Params": self._params}
        scope |= {"__name__": module, **self.functions}
        scope |= {"reward": self._reward, "measure": self._measure}
        run_source(self.text, file, scope)
        names = {"score", *self.combined, *(["reward"] if self.weights else [])}
        return {name: scope[name] for name in names}

    def _checked_weights(self, rewards: Any) -> dict[str, float]:
        if not isinstance(rewards, Mapping):
            raise ValueError(
                f"rewards must be a dict of names and weights, such as {{'upright': 1.0}}, not {rewards!r}"
            )
        for term, weight in rewards.items():
            if not isinstance(weight, int | float) or not math.isfinite(weight):
                raise ValueError(f"the weight of {term!r} must be a number, not {weight!r}")
        self._names("rewards", tuple(rewards))
        if rewards and "dt" not in self._params.vars:
            raise ValueError("rewards are multiplied by dt: add dt: float to Params")
        if taken := [term for term in rewards if term in self._params.vars]:
            raise ValueError(
                f"{taken[0]!r} is the name of a term and of a parameter: set_params would not know which one to set, "
                "so rename one"
            )
        return {term: float(weight) for term, weight in rewards.items()}

    def _names(self, attribute: str, names: Any, *, written: bool = False) -> tuple[str, ...]:
        """Check and return the names in an attribute.

        If ``written`` is True, a function of the task computes all of them, so return ().
        """
        if not isinstance(names, tuple | list) or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"{attribute} must be names, as ('x', 'y'), not {names!r}")
        for name in () if written else names:
            if self.lookup(name) is None:
                more = ", or write measure" if attribute == "metrics" else ""
                raise ValueError(
                    f"{attribute} has {name!r}, but there is no such function: write it as a @wp.func in the task's "
                    f"file, or import it there{more}"
                )
        return () if written else tuple(names)

    # text

    def _written_text(self, metrics: tuple[str, ...], first: int) -> str:
        """Generate the text. ``first`` is the number of metrics that ``measure`` writes."""
        parts = []
        if self.weights:
            body = _Body(self, _STEP)
            total = _total(f"weights[{i}] * {body.value(term, float)}" for i, term in enumerate(self.weights))
            parts.append(body.function(f"reward({_HEAD}) -> float", [*total, "return p.dt * total"]))
        body = _Body(self, _STEP)
        lines = ["measure(s0, action, s1, p, metrics)"] if self._measure else []
        summands = {f"metrics[{i}]": f"weights[{i}] * {body.value(term, float)}" for i, term in enumerate(self.weights)}
        lines += [f"{place} = p.dt * {value}" for place, value in summands.items()]
        start = len(self.weights) + first
        for i, metric in enumerate(metrics, start):
            lines.append(f"metrics[{i}] = {body.number(metric)}")
        if self.weights:
            lines += [*_total(summands.values()), "return p.dt * total"]
        else:
            lines.append("return reward(s0, action, s1, p)" if self._reward else "return 0.0")
        parts.append(body.function(f"score({_HEAD}, metrics: Row[float]) -> float", lines))
        for attribute, names in self.ends.items():
            if names:
                body = _Body(self, _STATE)
                any_end = " or ".join(body.value(name, bool) for name in names)
                parts.append(body.function(f"{_ENDS[attribute]}(s: World, p: Params) -> bool", [f"return {any_end}"]))
        return "\n\n".join(parts)

    # names

    def choose(self, name: str, variables: Mapping[str, str], within: tuple[str, ...] = ()) -> tuple[wp.Function, Any]:
        """Return a function's first overload whose arguments can all be found, and its result type.

        Args:
            name: The function's name.
            variables: The text for each name that refers to a state, the action or Params.
            within: The chain of functions that need this function's result, for the detection of cycles.
        """
        if name in within:
            raise ValueError(f"terms depend on each other in a cycle: {' needs '.join((*within, name))}")
        function = self.lookup(name)
        assert function is not None
        errors = []
        for overload in overloads(function):
            try:
                for argument in overload.input_types:
                    self.source_of(overload, argument, variables, (*within, name))
            except ValueError as error:
                errors.append(error)
            else:
                return overload, self._result(overload)
        raise errors[0]

    def source_of(
        self, function: wp.Function, name: str, variables: Mapping[str, str], within: tuple[str, ...]
    ) -> tuple[Literal["expression", "function", "default"], str]:
        """Find where an argument's value comes from: an expression, a function of the same name, or the default."""
        source: Literal["expression", "function"] = "expression"
        if name in variables:
            text = variables[name]
            kind: Any = {"p": self._params, "action": Row[float]}.get(name, self._world)
        elif name not in _OWN and self.lookup(name) is not None:
            source, text, kind = "function", name, self.choose(name, variables, within)[1]
        elif name in self._params.vars:
            text, kind = f"p.{name}", self._params.vars[name].type
        elif name in self._world.vars:
            text, kind = f"{variables['s']}.{name}", self._world.vars[name].type
        elif name in function.defaults:
            return "default", name
        else:
            raise ValueError(self._unknown(function, name, variables))
        if not _fits(expected := function.input_types[name], kind):
            raise ValueError(
                f"{self.place(function)} takes {name} as {_spelled(expected)}, but {text} is {_spelled(kind)}"
            )
        return source, text

    def _unknown(self, function: wp.Function, name: str, variables: Mapping[str, str]) -> str:
        place = self.place(function)
        if name in _STEP:
            return f"{place} takes {name}, but the end of an episode depends only on the state: it may take s and p"
        if name in _OWN:
            return f"{place} takes {name}, which is a name of the generated text: rename it"
        names = {*variables, *self._params.vars, *self._world.vars, *source_of(function).scope} - {name}
        hint = did_you_mean(name, names)
        return (
            f"{place} takes {name}, which is not a function of the task, a parameter or a field of World"
            f"{hint and f': {hint}'}"
        )

    def _result(self, function: wp.Function) -> Any:
        kind = function.adj.arg_types.get("return")
        if kind is None:
            raise ValueError(f"{self.place(function)} has no type for its result: add one, as -> float")
        return kind

    def place(self, function: wp.Function) -> str:
        """Name a function and its line, for messages."""
        source = source_of(function)
        return f"{source.name} ({source.place(source.tree)})"


class _Body:
    """The body of a generated function, which calls each function once."""

    def __init__(self, terms: Terms, variables: Mapping[str, str]) -> None:
        self._terms, self._variables = terms, variables
        self._lines: list[str] = []
        self._values: dict[str, tuple[wp.Function, Any]] = {}

    def value(self, name: str, *types: type) -> str:
        """Return the variable that holds a function's result."""
        if name not in self._values:
            function, kind = self._terms.choose(name, self._variables)
            arguments, named = [], False
            for argument in function.input_types:
                source, text = self._terms.source_of(function, argument, self._variables, (name,))
                text = self.value(text) if source == "function" else text
                if source == "default":
                    named = True  # after an omitted argument, Warp requires keyword arguments
                else:
                    arguments.append(f"{argument}={text}" if named else text)
            self._lines.append(f"{name}_ = {name}({', '.join(arguments)})")
            self._values[name] = function, kind
            term = self._terms.lookup(name)
            assert term is not None
            self._terms.functions[name] = term
        function, kind = self._values[name]
        if types and not any(_fits(one, kind) for one in types):
            raise ValueError(
                f"{self._terms.place(function)} returns {_spelled(kind)}, but must return "
                f"{' or '.join(one.__name__ for one in types)}"
            )
        return f"{name}_"

    def number(self, name: str) -> str:
        value = self.value(name, float, bool)
        return f"wp.where({value}, 1.0, 0.0)" if _fits(bool, self._values[name][1]) else value

    def function(self, signature: str, lines: list[str]) -> str:
        return f"@wp.func\ndef {signature}:\n" + "\n".join(f"    {line}" for line in (*self._lines, *lines)) + "\n"


def _total(values: Iterable[str]) -> list[str]:
    first, *others = values
    return [f"total = {first}", *(f"total += {value}" for value in others)]


def _fits(expected: Any, kind: Any) -> bool:
    if is_struct(expected) or is_struct(kind):
        return expected is kind or expected is Any
    return "Any" in wp.types.type_repr(expected) or bool(wp.types.types_equal(expected, kind))


def _spelled(kind: Any) -> str:
    return str(kind.key) if is_struct(kind) else str(wp.types.type_repr(kind))
