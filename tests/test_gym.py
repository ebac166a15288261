import subprocess
import sys

import gymnasium
import pytest
from conftest import TaskFile
from full_task import Full
from tiny_task import TINY

from lyceum_warp.binding import package_task_names
from lyceum_warp.gym import GymnasiumVectorEnv, register

OURS = {id: spec for id, spec in gymnasium.registry.items() if id.startswith("lyceum/")}


def test_every_task_of_the_package_has_an_id() -> None:
    tasks = {spec.kwargs["task"] for spec in OURS.values()}
    assert tasks >= set(package_task_names()) and "lyceum/HalfCheetah-v0" in OURS and "lyceum/Walker2d-v0" in OURS


@pytest.mark.long
def test_registration_imports_no_task_and_prints_no_warning() -> None:
    program = """
import sys, warnings
warnings.simplefilter("error")
import lyceum_warp.gym
assert not [name for name in sys.modules if name.startswith("lyceum_warp.tasks.")], sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_register_returns_the_id_of_a_task_class() -> None:
    assert register(Full) == register(Full) == "lyceum/Full-v0"
    envs = gymnasium.make_vec("lyceum/Full-v0", num_envs=2, noise=0.25)
    assert isinstance(envs, GymnasiumVectorEnv)
    assert envs.env.given_params == {"noise": 0.25} and envs.spec is not None and envs.spec.kwargs["noise"] == 0.25


def test_register_returns_the_id_of_a_task_file(task_file: TaskFile) -> None:
    id = register(task_file("tiny_of_gymnasium.py", TINY))
    assert id == "lyceum/Tiny-v0"
    assert gymnasium.make_vec(id, num_envs=3).single_observation_space.shape == (1,)


def test_registering_an_unknown_task_raises_an_error() -> None:
    with pytest.raises(ValueError, match="there is no task 'hoper': did you mean hopper"):
        register("hoper")
    with pytest.raises(gymnasium.error.NameNotFound, match="Hopper"):
        gymnasium.make("lyceum_warp.gym:lyceum/Hoper-v0")
