"""Compile the kernels of a task ahead of time: lyceum-warp compile."""

import dataclasses
from typing import Annotated, Any

import tyro

from lyceum_warp import algos, engines, env  # each name loads at its first use
from lyceum_warp.cli.arguments import EnvFlags, ParamWords, Physics, TaskWord
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.cli.train import Train

_WORLDS = 64
"""Number of worlds with which kernels are compiled; they do not depend on it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compile:
    """Compile the kernels of a task and its learner into Warp's cache, so that training starts without compiling.

    The flags are those of lyceum-warp train. Kernels do not depend on the number of worlds or on hyperparameters. With
    --arch, the machine needs no GPU, as in the build of a container. The environment variable WARP_CACHE_PATH moves
    Warp's cache to another folder.

    $ lyceum-warp compile go1_velocity --device cuda
    $ lyceum-warp compile go1_velocity --arch sm_90
    """

    USUAL = ("arch", "algorithm", "param", "engine", "device", "physics")

    task: TaskWord
    arch: Annotated[str | None, tyro.conf.arg(metavar="sm_NN")] = None
    """Compile for any GPU of this architecture, such as sm_90 for an H200. The machine may have another GPU or none."""
    algorithm: Annotated[str | None, tyro.conf.arg(metavar="npg|ppo|sac")] = None
    """npg, ppo or sac. The default is the algorithm that the task suggests."""
    param: ParamWords = ()
    place: Annotated[EnvFlags, tyro.conf.arg(name="world")] = EnvFlags()
    physics_options: Annotated[Physics, tyro.conf.arg(name="physics")] = Physics()

    def run(self) -> None:
        import warp as wp  # like torch, it takes long to import

        if self.arch and engines.engine_name(self.place.engine or "auto", self.place.device or "cuda") != "warp":
            raise ValueError("--arch is for GPUs, on which the Warp engine runs: omit --arch, or --device and --engine")
        train = Train(task=self.task, algorithm=self.algorithm, nworld=_WORLDS, param=self.param, env=self.place,
                      physics=self.physics_options)  # fmt: skip
        configuration = train.configuration(None, algos.Team())
        options, params = configuration.options, configuration.params
        changes: list[dict[str, Any]] = [{}]
        if train.suggested().exact_from is not None:
            changes.append({"physics": algos.EXACT})
        if self.arch is None:
            learner = configuration.learner(algos.Team(device=options.device))
            next(learner)
            for change in changes[1:]:
                learner.env.replicate(**change)
            algos.evaluation_worlds(learner.env, 1)
        else:
            more = algos.LEARNER_KERNELS
            for change in changes:
                env.compile_kernels(self.task, options.changed(change), params, arch=self.arch, kernels=more)
            # a run evaluates its policy on the C engine
            env.Env(self.task, options.changed({**engines.options_on_cores(), "nworld": 1}), params)
        say(f"the kernels of {self.task} are in {wp.config.kernel_cache_dir}")
        say_entries(next=f"lyceum-warp train {self.task}")
