import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import TaskFile
from tiny_task import TINY
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.controllers import check_episode, episode_env, load_episodes


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", autoreset=False, horizon=5, success_distance=0.2, dynamics=["body_mass"])


@pytest.fixture(scope="module")
def episodes(env: lw.Env) -> list[lw.Trajectory]:
    return [lw.control(env, towards, seed=seed) for seed in (1, 2)]


@pytest.fixture
def folder(episodes: list[lw.Trajectory], tmp_path: Path) -> Path:
    for number, episode in enumerate(episodes):
        episode.save(tmp_path / "run" / f"episode-{number:03d}.npz")
    return tmp_path / "run"


def test_several_files_and_folders_are_loaded_in_order(folder: Path, episodes: list[lw.Trajectory]) -> None:
    first, second = sorted(folder.iterdir())
    for given, expected in ((folder, [first, second]), (str(second), [second]), ([second, first], [second, first])):
        assert list(load_episodes(given)) == expected
    loaded = load_episodes(folder)
    assert torch.equal(loaded[second].states, episodes[1].states)
    assert torch.equal(loaded[first].part("qpos"), episodes[0].states[:, slice(*episodes[0].state_parts["qpos"])])
    with pytest.raises(ValueError, match="no part 'qpoz': they have time, qpos"):
        loaded[first].part("qpoz")


def test_episode_env_restores_and_continues_episodes(folder: Path) -> None:
    loaded = load_episodes(folder)
    made = episode_env(loaded)
    assert (made.nworld, made.autoreset, made.horizon) == (1, False, 5)
    assert made.task.params["success_distance"] == pytest.approx(0.2) and "body_mass" in made.state_space.parts
    for episode in loaded.values():
        made.set_state(episode.states[2:3])
        made.step(episode.actions[2:3])
        assert torch.equal(made.get_state()[0], episode.states[3])
    assert episode_env(loaded, horizon=7).horizon == 7


def test_episode_env_finds_the_task_file(task_file: TaskFile, tmp_path: Path) -> None:
    file = task_file("tiny_of_episodes.py", TINY)
    env = lw.make(f"{file}:Tiny", autoreset=False, horizon=3)
    path = lw.control(env, lambda state, obs: torch.zeros(3)).save(tmp_path / "mine.npz")
    made = episode_env(load_episodes(path))
    assert made.task.name == "tiny" and made.task.definition is env.task.definition
    gone = dataclasses.replace(lw.Trajectory.load(path), source={"task": "/nowhere/tiny.py:Tiny"})
    with pytest.raises(FileNotFoundError, match=r"/nowhere/tiny.py, does not exist any more: pass a file"):
        episode_env(gone)
    assert episode_env(gone, task=file).task.name == "tiny"
    notebook = dataclasses.replace(gone, source={"task": None})
    with pytest.raises(ValueError, match="'tiny' was defined in a notebook or a script: pass a file"):
        episode_env(notebook)
    unknown = dataclasses.replace(gone, source={}, task="nonesuch")
    with pytest.raises(ValueError, match="there is no task 'nonesuch': .*; pass a file that defines the task"):
        episode_env(unknown)
    with pytest.raises(ValueError, match="is an episode of the task 'tiny', not of the task 'point_mass'"):
        episode_env(gone, task="point_mass")


def test_episodes_of_two_tasks_raise_an_error(folder: Path, tmp_path: Path) -> None:
    other = lw.control(lw.make("cartpole", autoreset=False, horizon=3), lambda state, obs: torch.zeros(1))
    path = other.save(tmp_path / "other.npz")
    first = min(folder.iterdir())
    message = f"{path} is an episode of the task 'cartpole', but {first} is an episode of the task 'point_mass'"
    with pytest.raises(ValueError, match=message):
        load_episodes([folder, path])


def test_episode_of_another_model_raises_an_error(folder: Path, env: lw.Env, tmp_path: Path) -> None:
    first = min(folder.iterdir())
    plain = lw.make("point_mass", autoreset=False, horizon=3)
    path = lw.control(plain, towards).save(tmp_path / "plain.npz")
    with pytest.raises(ValueError, match=f"{path} has a different model than {first}: its states have no body_mass"):
        load_episodes([first, path])
    with pytest.raises(
        ValueError, match=rf"a different model than {path}: its states have body_mass of \d+ numbers, not 0"
    ):
        load_episodes([path, first])
    with pytest.raises(ValueError, match=r"mine does not fit the current task 'point_mass', whose states have no bo"):
        check_episode(plain, lw.Trajectory.load(first), "mine")


def test_files_that_cannot_be_read_raise_a_one_line_error(folder: Path, tmp_path: Path) -> None:
    newer, empty = tmp_path / "newer.npz", tmp_path / "empty"
    np.savez(newer, info=np.array(json.dumps({"format": 2})))
    empty.mkdir()
    for given, kind, message in (
        (tmp_path / "none.npz", FileNotFoundError, f"^there is no file {tmp_path / 'none.npz'}$"),
        (empty, FileNotFoundError, f"there is no episode in the folder {empty}: it contains no .npz file"),
        (newer, ValueError, rf"{newer} has format 2, and this lyceum_warp reads formats up to 1"),
    ):
        with pytest.raises(kind, match=message) as caught:
            load_episodes([folder, given])
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="there is no episode to load"):
        load_episodes([])


def test_task_file_that_other_users_can_write_is_not_executed(
    episodes: list[lw.Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, ran = tmp_path / "tasks", tmp_path / "ran"
    folder.mkdir(mode=0o755)
    file = folder / "evil.py"
    file.write_text(f"open({str(ran)!r}, 'w').close()\nraise ValueError('it ran')\n")
    episode = dataclasses.replace(episodes[0], source={"task": f"{file}:PointMass"})
    advice = f"if you trust the file, pass it as the task, with --task {file}:PointMass"
    for place, mode, reason in ((file, 0o646, "it"), (folder, 0o777, f"its folder {folder}")):
        before = place.stat().st_mode
        place.chmod(mode)
        with pytest.raises(ValueError, match=f"run as code, and {reason} can be written by other users: {advice}"):
            episode_env(episode)
        place.chmod(before)
    real = os.getuid()
    if real:
        monkeypatch.setattr(os, "getuid", lambda: real + 1)
    else:
        os.chown(file, 12345, -1)
    with pytest.raises(ValueError, match=f"it belongs to another user: {advice}"):
        episode_env(episode)
    assert not ran.exists()
    with pytest.raises(ValueError, match="it ran"):
        episode_env(episode, task=f"{file}:PointMass")
    assert ran.exists()


def test_task_name_that_is_not_a_string_raises_an_error(episodes: list[lw.Trajectory], tmp_path: Path) -> None:
    path = dataclasses.replace(episodes[0], source={"task": ["a"]}).save(tmp_path / "episode.npz")
    with pytest.raises(ValueError, match=r"episode.npz is broken.*source has \['a'\] as its task"):
        load_episodes(path)
