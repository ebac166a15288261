import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hidden_robots import ARM, log_of

import lyceum_warp as lw
from lyceum_warp.fitting import read_log

MODEL = mujoco.MjSpec.from_string(ARM).compile()
Log = dict[str, Any]


@pytest.fixture(scope="module")
def recorded() -> Log:
    return log_of(ARM, ["kp.*"], {}, lw.excitation([-0.8] * 2, [0.8] * 2, "walk", seconds=6.0, rate=100))


def swap(log: Log) -> Log:
    return log | {"qpos": log["qpos"][:, ::-1], "qvel": log["qvel"][:, ::-1]}


def with_value(name: str, row: int, value: float) -> Callable[[Log], Log]:
    def change(log: Log) -> Log:
        array = log[name].astype(float).copy()
        array[row] = value
        return log | {name: array}

    return change


WRONG: dict[str, tuple[Callable[[Log], Log], str]] = {
    "swapped joints": (swap, r"'qpos\[0\]' follows the control of 'qpos\[1\]'.*swapped\?"),
    "swapped velocities": (lambda log: log | {"qvel": log["qvel"][:, ::-1]}, "moves by the velocity of.*swapped"),
    "degrees": (lambda log: log | {"qpos": np.degrees(log["qpos"]) * 20}, "convert degrees to radians"),
    "degrees per second": (lambda log: log | {"qvel": np.degrees(log["qvel"])}, "convert both to the same units"),
    "milliseconds": (lambda log: log | {"time": 1e3 * log["time"]}, "convert 'time' to seconds"),
    "repeated times": (with_value("time", 5, 0.0), "finite numbers that increase"),
    "another robot": (
        lambda log: log | {"qpos": np.hstack([log["qpos"]] * 2)},
        "has 4 numbers per time.*another robot",
    ),
    "another joint": (lambda log: {**log, "qpos.elbo": log["qpos"][:, 1]}, "did you mean elbow"),
    "another field": (lambda log: {**log, "qpo": log["qpos"]}, "the column 'qpo' is unknown: did you mean qpos"),
    "no controls": (lambda log: {k: v for k, v in log.items() if k != "ctrl"}, "add the column 'ctrl.shoulder'"),
    "NaN in controls": (with_value("ctrl", 7, np.nan), "'ctrl' is not finite in row 7"),
    "NaN in one control": (
        lambda log: (
            {k: v for k, v in log.items() if k != "ctrl"}
            | {
                f"ctrl.{name}": np.where(np.arange(600) == 7, np.nan, log["ctrl"][:, 1])
                for name in ("shoulder", "elbow")
            }
        ),
        "'ctrl.shoulder' is not finite in row 7",
    ),
    "a column of NaN": (lambda log: log | {"qvel": np.full_like(log["qvel"], np.nan)}, "has no numbers"),
    "infinite": (with_value("qvel", 3, np.inf), "infinite"),
    "a constant": (lambda log: log | {"qvel": np.zeros_like(log["qvel"])}, "is always 0.*connected"),
    "too short": (lambda log: {k: v[:5] for k, v in log.items()}, "must be at least 20"),
    "no time": (lambda log: {k: v for k, v in log.items() if k != "time"}, "no column 'time'"),
    "actions without a task": (lambda log: log | {"action": log["ctrl"]}, "takes 'ctrl', not 'action'"),
    "lengths": (lambda log: log | {"qvel": log["qvel"][1:]}, r"'qvel' has shape \(599, 2\) for 600 times"),
    "words": (lambda log: log | {"qvel": [["fast", "slow"]] * 600}, "values that are no numbers"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_log_gets_one_clear_answer(case: str, recorded: Log) -> None:
    change, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        read_log(change(recorded), MODEL)


def test_csv_npz_and_arrays_are_the_same_log(recorded: Log, tmp_path: Path) -> None:
    names = ["time", "ctrl.shoulder", "ctrl.elbow", "qpos.shoulder", "qpos.elbow", "qvel.shoulder", "qvel.elbow"]
    table = np.column_stack([recorded[name] for name in ("time", "ctrl", "qpos", "qvel")])
    with (tmp_path / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([names, *table.tolist()])
    np.savez(tmp_path / "log.npz", **recorded)
    logs = [read_log(source, MODEL) for source in (recorded, tmp_path / "log.csv", tmp_path / "log.npz")]
    for log in logs:
        assert np.array_equal(log.takes[0].measured, logs[0].takes[0].measured)
        assert np.array_equal(log.takes[0].control, logs[0].takes[0].control)
    assert [column.name for column in logs[1].columns] == names[3:]


def test_gaps_and_several_recordings_become_takes(recorded: Log) -> None:
    late = recorded | {"time": recorded["time"] + 2.0 * (np.arange(600) >= 200)}
    read = read_log([late, recorded], MODEL)
    assert [len(take.time) for take in read.takes] == [200, 400, 600]
    assert "1 gaps, the longest of 2.01 s" in read.notes[0]


def test_recordings_may_order_their_columns_differently(recorded: Log) -> None:
    read = read_log([recorded, dict(reversed(recorded.items()))], MODEL)
    assert np.array_equal(read.takes[0].measured, read.takes[1].measured)
    with pytest.raises(ValueError, match=r"take 1 measures other quantities.*: qvel\[0\], qvel\[1\]"):
        read_log([recorded, {name: values for name, values in recorded.items() if name != "qvel"}], MODEL)


def test_saved_episode_is_a_log(tmp_path: Path) -> None:
    env = lw.make("cartpole", seed=1, autoreset=False)
    episode = lw.control(env, lw.PredictiveSampling("cartpole", samples=4, horizon=4), steps=30)
    episode.save(tmp_path / "episode.npz")
    for source in (episode, tmp_path / "episode.npz"):
        take = read_log(source, env.model).takes[0]
        assert take.measured.shape == (31, 4)
        assert np.allclose(take.control[:30, 0], episode.actions.numpy().clip(-1, 1)[:, 0])


def test_damaged_files_name_the_file(tmp_path: Path) -> None:
    (tmp_path / "log.npz").write_bytes(b"PK\x03\x04 no archive")
    (tmp_path / "log.csv").write_text("time,qpos\n0,1\n1\n")
    for name, message in (("log.npz", "is no log"), ("log.csv", "Line #3 .got 1 columns")):
        with pytest.raises(ValueError, match=message) as error:
            read_log(tmp_path / name, MODEL)
        assert name in str(error.value)
    with pytest.raises(FileNotFoundError, match="there is no log"):
        read_log(tmp_path / "none.csv", MODEL)
