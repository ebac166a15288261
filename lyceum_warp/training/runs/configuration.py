"""Convert between a learner and the config.json of its run."""

import dataclasses
import inspect
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyceum_warp import algos
from lyceum_warp.algos import LIMIT, Distill, GaussianPolicy, Learner, Team
from lyceum_warp.binding import class_in_file, class_sources, made, spelled_task
from lyceum_warp.core import EnvOptions, Task
from lyceum_warp.engines import engine_name
from lyceum_warp.env import Env
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.validate import whole_number
from lyceum_warp.training.runs.checkpoints import network_of, read_checkpoint
from lyceum_warp.training.runs.folder import Run, policy_of
from lyceum_warp.training.runs.task_copy import fit_copy, json_value, run_env, table_copies

ALGORITHMS: dict[str, tuple[Any, Any]] = {
    "npg": (algos.NPG, algos.NPGConfig), "ppo": (algos.PPO, algos.PPOConfig), "sac": (algos.SAC, algos.SACConfig),
    "distill": (Distill, algos.DistillConfig),
}  # fmt: skip
"""Maps an algorithm's name in config.json to the classes of its learner and of its hyperparameters."""


def learner_classes(algorithm: str) -> tuple[Any, Any]:
    """Return the classes of an algorithm and of its hyperparameters.

    A class of the user's, ``path/to/file.py:Class``, has the hyperparameters that its constructor's argument ``config``
    is annotated with, or None.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: There is no such algorithm or class.
    """
    if algorithm in ALGORITHMS:
        return ALGORITHMS[algorithm]
    if ".py:" not in algorithm:
        raise ValueError(f"there is no algorithm {algorithm!r}: use {', '.join(ALGORITHMS)} or path/to/file.py:Class")
    kind = class_in_file(algorithm, Learner)
    hint = typing.get_type_hints(kind.__init__).get("config")
    return kind, next(filter(dataclasses.is_dataclass, (hint, *typing.get_args(hint))), None)


def describe(learner: Learner) -> dict[str, Any]:
    """Make the content of config.json. ``Configuration`` makes the same learner from it."""
    env, options = learner.env, learner.env.options
    names = ["horizon", "graphs", "fields", "dynamics", "fitted", "fitted_draws", "objects"]
    if learner.team.neighbours == 1:  # a run with several processes may be resumed with a different number of them
        names.append("nthread")
    entries = {name: value for name, value in options.given().items() if name in names}
    if options.cameras is not None:
        entries["cameras"] = [dataclasses.asdict(camera) for camera in options.cameras]
    if isinstance(options.model, str | Path):
        entries["model"] = str(Path(options.model).absolute()) if Path(options.model).is_file() else str(options.model)
    seed = {} if learner.seed == options.seed else {f"{learner.algorithm}_seed": learner.seed}
    task = env.task.definition
    weights = {name: float(env.given_params.get(name, weight)) for name, weight in task.rewards.items()}
    own = {"learner": type(learner), "network": type(getattr(learner.policy, "network", None))}
    classes = {
        name: f"{next(iter(files))}:{cls.__name__}" for name, cls in own.items() if (files := class_sources(cls))
    }
    return {
        "algorithm": learner.algorithm,
        "task": spelled_task(env.task.definition),
        "params": {name: json_value(name, value) for name, value in env.given_params.items()},
        "terms": {"rewards": weights, "ends": [*task.terminations, *task.truncations]},
        "physics": options.physics.given(),
        "engine": options.engine if isinstance(options.engine, str) else env.engine.name,
        "device": options.device or "cpu",
        "options": entries,
        **({} if env.task.fit is None else {"fit": env.task.fit.metadata}),
        "nworld": env.nworld * learner.team.size,
        "threads": torch.get_num_threads(),
        "seed": options.seed,
        **seed,
        **classes,
        learner.algorithm: learner.settings(),
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Configuration:
    """Configuration of a run: the task, the environment's options, and the algorithm with its hyperparameters."""

    task: str | None
    """The task's name or file. None if the task was defined in a notebook."""
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    options: EnvOptions
    """Options of the environment. ``nworld`` counts the worlds of all processes."""
    network: str | None = None
    """The class of a new policy's network, as path/to/file.py:Class."""
    algorithm: str
    hyperparameters: Any
    """The algorithm's hyperparameters. None for an algorithm that is not in ``ALGORITHMS``."""
    seed: int | None = None
    """Seed of the algorithm. None means the environment's seed."""
    threads: int = 1
    iterations: int = 100

    @classmethod
    def of(cls, run: Run) -> "Configuration":
        """Read a run's configuration. If the file of a table is missing or has changed, use the run's copy."""
        config = run.config
        try:
            options = EnvOptions(
                engine=config["engine"], device=config["device"], nworld=config["nworld"], seed=config["seed"]
            )  # fmt: skip
            name: str = config["algorithm"]
            return cls(
                task=config["task"],
                params=config["params"] | {table: str(copy) for table, copy in table_copies(run).items()},
                options=options.changed(config["physics"] | config["options"] | fit_copy(run)),
                algorithm=name,
                hyperparameters=ALGORITHMS[name][1](**config[name]) if name in ALGORITHMS else None,
                seed=config.get(f"{name}_seed"),
                threads=config["threads"],
                iterations=config.get("iterations", 100),
            )
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            text = f"{run.folder / 'config.json'} is not the configuration of a training run ({error})"
            raise ValueError(text) from error

    def learner(
        self,
        team: Team,
        *,
        run: Run | None = None,
        networks: tuple[Any, Any] = (None, None),
        teacher: Any = None,
        task: str | None = None,
    ) -> Learner:
        """Make the learner of one of the processes; ``teacher`` is an argument of ``Distill``, which needs no value.

        With a run, the learner uses the run's task, unless ``task`` names another task. Without a run, it uses the task
        of this configuration. New networks are made if none are given.
        """
        try:
            # OpenMP aborts the process if it cannot create the threads
            torch.set_num_threads(whole_number("threads", self.threads, low=1, high=1024))
            nworld = team.share(self.options.nworld)
            placement = {
                "nworld": nworld, "first_world": team.rank * nworld, "device": team.device or self.options.device,
            }  # fmt: skip
            options = self.options.changed(placement)
            engine = engine_name(options.engine, options.device)
            if options.nthread is None and team.neighbours > 1 and engine == "mujoco":
                options = options.changed({"nthread": max(1, cpu_cores() // team.neighbours)})
            if run is None:
                assert self.task is not None
                env = Env(self.task, options, self.params)
            else:
                # only rank 0 checks trust, because other machines may have no record of the run
                env = run_env(run, options, self.params, task=task, trust=not team.leads)
            seed = self.options.seed if self.seed is None else self.seed
            if self.network is not None:
                networks = self._new_policy(self.network, env, seed), None
            if teacher is not None:
                return Distill(env, networks[0], self.hyperparameters, teacher=teacher, seed=seed, team=team)
            kind, _ = learner_classes(self.algorithm)
            arguments = dict(zip(("policy", "value", "config"), (*networks, self.hyperparameters), strict=True))
            arguments = {name: value for name, value in arguments.items() if value is not None} | {"seed": seed}
            if team.size > 1 or "team" in inspect.signature(kind).parameters:
                arguments["team"] = team
            return made(kind, env, **arguments)
        except (ValueError, FileNotFoundError) as error:
            if run is not None:
                run.note_settings(error)
            raise

    def _new_policy(self, network: str, env: Env, seed: int) -> GaussianPolicy:
        """Make a policy with a network of the user's class."""
        sizes = env.obs_space.size, env.action_space.size
        config = self.hyperparameters
        options = {name: getattr(config, name) for name in ("log_std", "normalize") if hasattr(config, name)}
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            return GaussianPolicy(*sizes, network=made(class_in_file(network, nn.Module), *sizes), **options)


def learned_physics(run: Run, task: type[Task], which: str = "last") -> str:
    """Name the physics in which a run's policy has learned, with a change to exact physics."""
    first = algos.physics_text(task, Configuration.of(run).options.physics)
    number = run.config.get("exact_from")
    done = read_checkpoint(run.policy_file(which), parts=("iteration",))["iteration"]
    if number is None or done <= number:
        return first
    return f"{first} for {number} iterations, then {algos.EXACT} physics for {done - number}"


def saved_networks(run: Run, which: str | int | None = None) -> tuple[Any, Any, int]:
    """Load a learner's initial policy and value function from a run.

    The third result is the iteration at which they were saved.

    If ``which`` is None, the run is resumed. The learner then usually makes its networks from the hyperparameters, and
    this function returns None for the policy and for the value function. It returns the networks if the policy has
    another ``limit`` than ``LIMIT`` or a network of the user's, or if the run started from another run.
    """
    path = run.policy_file("last" if which is None else which)
    content = read_checkpoint(path, parts=("iteration", "policy"))
    limit = (content["policy"].get("shape") or {}).get("limit", LIMIT)
    if which is None and not {"from", "network"} & run.config.keys() and limit == LIMIT:
        return None, None, content["iteration"]
    value = network_of(content, path, "value") if "value" in content else None
    return policy_of(content, path), value, content["iteration"]
