import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from training_runs import QUIET, metrics

from lyceum_warp import cli
from lyceum_warp.algos import Team
from lyceum_warp.algos.common import distributed
from lyceum_warp.training import Run

OPTIONS = ["--samples", "600", "--nworld", "12", "--hidden", "8", "--value-hidden", "8", "--mean-every", "1",
           "--mean-episodes", "2", "--rollout", "segments", "--normalize", "--time-orders", "2",
           "--fisher-fraction", "0.34", "--min-restarts", "10"]  # fmt: skip


def torchrun(
    *arguments: str, options: list[str], program: tuple[str, ...] = ("-m", "lyceum_warp.cli")
) -> subprocess.Popen[str]:
    """Start ``torchrun`` on the loopback interface."""
    command = [sys.executable, "-m", "torch.distributed.run", *options, *program, *arguments]
    environment = os.environ | {"GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip


def ended(processes: list[subprocess.Popen[str]]) -> list[tuple[int, str, str]]:
    try:
        outputs = [process.communicate(timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, *texts) for process, texts in zip(processes, outputs, strict=True)]


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def assert_equal_runs(one: Path, other: Path, *, tolerance: float) -> None:
    """Compare the last metrics and the checkpoints of two runs, up to rounding."""
    row, expected = metrics(one)[-1], metrics(other)[-1]
    for name in expected:
        bound = tolerance * (10.0 if name.startswith("mean_") else 1.0)  # episodes amplify rounding
        pair = [float(numbers[name] or "nan") for numbers in (row, expected)]
        np.testing.assert_allclose(*pair, rtol=bound, atol=bound, err_msg=name)
    state, wanted = (Run.open(folder).read()["state"] for folder in (one, other))
    assert torch.equal(state["generator"], wanted["generator"])
    close = dict(rtol=tolerance, atol=tolerance)
    for part in ("policy", "value") if "value" in wanted else ("policy",):
        for name, tensor in wanted[part].items():
            torch.testing.assert_close(state[part][name], tensor, **close)
    torch.testing.assert_close(state["returns"], wanted["returns"], **close, equal_nan=True)
    if tolerance < 1e-3:  # rounding errors may change the step at which a foot touches the ground
        torch.testing.assert_close(state["env"], wanted["env"], **close)


PPO = ["--algorithm", "ppo", "--nworld", "12", "--num-steps", "20", "--minibatches", "7", "--hidden", "8",
       "--value-hidden", "8", "--mean-every", "1", "--mean-episodes", "2"]  # fmt: skip
"""With these settings, PPO bootstraps unfinished episodes, normalises observations, and adapts its learning rate."""
DISTILL = ["--algorithm", "distill", "--teacher", "hopper", "--recurrent", "4", "--nworld", "12", "--num-steps", "20",
           "--gradient-length", "10", "--hidden", "8", "--mean-every", "1", "--mean-episodes", "2"]  # fmt: skip
SAC = ["--algorithm", "sac", "--nworld", "12", "--num-steps", "20", "--updates", "4", "--actor-every", "2", "--n-step",
       "2", "--batch", "64", "--warmup", "60", "--replay", "120", "--hidden", "8", "--value-hidden", "8",
       "--mean-every", "1", "--mean-episodes", "2"]  # fmt: skip
"""With these settings, SAC warms up, fills its replay buffer (after 10 steps), and normalises observations."""


@pytest.mark.quick("npg")
@pytest.mark.parametrize(
    ("settings", "tolerance"),
    # Adam amplifies rounding errors in small gradients
    [
        (OPTIONS, 2e-4),
        (PPO, 2e-3),
        ([*PPO, "--whiten-minibatches", "--std-type", "log"], 2e-3),
        (SAC, 2e-3),
        ([*PPO, "--recurrent", "4", "--whiten-minibatches"], 2e-3),
        (DISTILL, 2e-3),
    ],
    ids=["npg", "ppo", "whitened ppo", "sac", "recurrent ppo", "distill"],
)
def test_two_processes_make_the_same_update_as_one_process(
    settings: list[str], tolerance: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    two, one = tmp_path / "two", tmp_path / "one"
    arguments = ["train", "hopper", *settings, *QUIET, "--iterations", "1", "--out"]
    with pytest.MonkeyPatch.context() as patched:
        team = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "GLOO_SOCKET_IFNAME": "lo"}
        for name, value in (team | {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "1", "OMP_NUM_THREADS": "1"}).items():
            patched.setenv(name, value)
        environment = os.environ | {"RANK": "1", "LOCAL_RANK": "0"}
        command = [sys.executable, "-m", "lyceum_warp.cli", *arguments, str(two)]
        other = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
        patched.setenv("RANK", "0")
        code = cli.main([*arguments, str(two)])
    assert (code, ended([other])[0][:2]) == (0, (0, ""))
    assert "6 worlds each in 2 processes" in capfd.readouterr().out
    assert cli.main([*arguments, str(one)]) == 0
    assert Run.open(two).config == Run.open(one).config
    assert_equal_runs(two, one, tolerance=tolerance)
    for run in (one, two):
        assert cli.main(["train", "--resume", str(run), "--iterations", "2", *QUIET]) == 0
    assert_equal_runs(two, one, tolerance=5.0 * tolerance)


INTERRUPTED = """
import os, signal, sys
from lyceum_warp import NPG
from lyceum_warp.cli import main
from lyceum_warp.cli.train import Train

where, rank = sys.argv.pop(1), sys.argv.pop(1)
iterate = NPG.__next__

def interrupting(npg):
    iteration = iterate(npg)
    if npg.iteration == 2:
        signal.raise_signal(signal.SIGTERM)
    return iteration

def interrupted(*args, **words):
    signal.raise_signal(signal.SIGTERM)

if os.environ["RANK"] == rank:
    if where == "learning":
        NPG.__next__ = interrupting
    else:
        Train.configuration = interrupted
sys.exit(main())
"""


@pytest.mark.long
def test_all_processes_end_if_one_of_them_is_interrupted(tmp_path: Path) -> None:
    program, run = tmp_path / "interrupted.py", tmp_path / "learning"
    program.write_text(INTERRUPTED)
    arguments = ["train", "hopper", *OPTIONS, *QUIET, "--iterations", "100000", "--out"]
    options = ["--standalone", "--nproc-per-node=2"]
    processes = [
        torchrun(*arguments, str(tmp_path / where), options=options, program=(str(program), where, rank))
        for where, rank in (("learning", "1"), ("beginning", "0"))
    ]
    (code, out, error), (early, nothing, early_error) = ended(processes)
    assert code != 0 and early != 0
    assert "interrupted by SIGTERM after 2 of 100000 iterations; continue with" in out, (out, error)
    assert len(metrics(run)) == Run.open(run).read()["iteration"] == 2
    assert nothing == "" and not (tmp_path / "beginning").exists()
    assert "lyceum_warp/" not in error + early_error, (error, early_error)  # no traceback


@pytest.mark.long
def test_error_in_one_process_ends_all_processes(tmp_path: Path) -> None:
    launch = ["--standalone", "--nproc-per-node=2"]
    run, other = tmp_path / "run", tmp_path / "other"
    arguments = ["train", "hopper", *OPTIONS, *QUIET, "--iterations"]
    assert cli.main([*arguments, "1", "--out", str(run)]) == 0
    resume = ["train", "--resume", str(run), "--iterations", "2", *QUIET]
    processes = [torchrun(*command, options=launch) for command in ([*arguments, "1", "--out", str(run)], resume)]
    assert cli.main([*arguments, "2", "--out", str(other)]) == 0
    refused, resumed = ended(processes)
    code, out, error = refused
    assert code != 0 and out == "", refused
    assert error.count(f"lyceum-warp: {run} contains a run") == 1
    assert "lyceum_warp/algos" not in error  # the other rank prints no traceback
    code, out, error = resumed
    assert code == 0 and out.count("iteration    2/2") == 1, resumed
    assert_equal_runs(run, other, tolerance=2e-3)


def test_worlds_that_cannot_be_divided_evenly_raise_an_error() -> None:
    assert Team(0, 3).share(9) == 3
    with pytest.raises(ValueError, match="3 processes cannot share 8 worlds evenly: use a multiple of 3"):
        Team(0, 3).share(8)


def test_fewer_gpus_than_processes_raise_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for name, value in {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1"}.items():
        monkeypatch.setenv(name, value)
    refused = pytest.raises(ValueError, match="2 processes on this machine need one GPU each, but the machine has 1")
    with refused, distributed.join("cuda"):
        pass
