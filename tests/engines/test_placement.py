import os
import types
from typing import Any

import mujoco
import pytest
import torch
import warp as wp
from toy_engine import ToyEngine

import lyceum_warp as lw
from lyceum_warp.engines import Engine, engine_name, memory, options_for_few_worlds, options_for_plant, placement
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.placement import find_device, open_engine, place_samples
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.support.machine import cpu_cores

ON_CPU = {"engine": "mujoco", "device": "cpu", "nconmax": None, "njmax": None, "deterministic": None}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return lw.gymnasium_model("hopper.xml").spec().compile()


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    device = types.SimpleNamespace(is_cpu=False, is_cuda=True, alias="cuda:0", free_memory=10**9)
    found = placement.find_device
    monkeypatch.setattr(placement, "find_device", lambda name: device if str(name).startswith("cuda") else found(name))
    return device


def test_find_device_accepts_names_and_torch_devices() -> None:
    assert find_device(None).is_cpu
    assert find_device(torch.device("cpu")).is_cpu  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no device 'tpu' on this machine; it has 'cpu'.*nvidia-smi"):
        find_device("tpu")


def test_engine_auto_depends_on_the_device() -> None:
    assert [engine_name("auto", device) for device in ("cpu", None, "cuda", "cuda:1")] == [
        "mujoco", "mujoco", "warp", "warp"
    ]  # fmt: skip
    assert engine_name("auto", wp.get_device("cpu")) == "mujoco"
    assert engine_name("warp", "cpu") == "warp" and engine_name("mujoco", "cuda") == "mujoco"
    assert engine_name(ToyEngine, "cpu") == "toy"


def test_open_engine_makes_the_named_engine(model: mujoco.MjModel) -> None:
    cpu = wp.get_device("cpu")
    for engine, wanted in (("auto", MujocoEngine), ("mujoco", MujocoEngine), ("warp", WarpEngine), (ToyEngine,) * 2):
        made = open_engine(engine, model, 2, cpu, [], nthread=None, deterministic=False)
        assert type(made) is wanted and made.nworld == 2
    for engine in ("bullet", None):
        with pytest.raises(ValueError, match=f"no engine {engine!r}: use one of 'auto', 'mujoco', 'warp'"):
            open_engine(engine, model, 2, cpu, [])  # type: ignore[arg-type]


def test_options_of_an_engine_are_read_from_its_signature(model: mujoco.MjModel) -> None:
    cpu = wp.get_device("cpu")

    class Curious(ToyEngine):
        def __init__(self, *args: Any, patience: int = 3, strict: bool = False) -> None:
            super().__init__(*args)
            self.given = patience, strict

    def any_options(*args: Any, **options: Any) -> Engine:
        engine = ToyEngine(*args)
        engine.given = options  # type: ignore[attr-defined]
        return engine

    def opened(engine: Any, **options: Any) -> Any:
        return open_engine(engine, model, 2, cpu, [], **options).given  # type: ignore[attr-defined]

    assert opened(Curious) == (3, False)
    assert opened(Curious, patience=5, strict=True, deterministic=True) == (5, True)
    assert opened(any_options, patience=None, njmax=8, strict=True) == {"njmax": 8, "strict": True}
    with pytest.raises(ValueError, match="the toy engine takes no njmax, nthread; it takes patience, strict"):
        opened(Curious, nthread=2, njmax=8)
    with pytest.raises(ValueError, match="the toy engine takes no nthread; it takes no options"):
        opened(ToyEngine, nthread=2)
    with pytest.raises(ValueError, match="the mujoco engine takes no njmax; it takes nthread"):
        opened("mujoco", njmax=64)
    with pytest.raises(ValueError, match="the warp engine takes no nthread; it takes nconmax, njmax"):
        opened("warp", nthread=2)


@pytest.mark.parametrize("engine", ["mujoco", "warp", ToyEngine])
def test_too_many_worlds_for_the_memory_raise_an_error_before_the_engine_is_made(
    engine: Any, model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpu = wp.get_device("cpu")
    each = open_engine(engine, model, 1, cpu, []).estimated_bytes
    assert each > 8 * mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value)
    monkeypatch.setattr(memory, "free_memory", lambda device: int(10.5 * each / 0.9))
    open_engine(engine, model, 10, cpu, [])
    open_engine(engine, model, 5, cpu, [], reserved=each)
    with pytest.raises(ValueError, match=r"11 worlds of hopper need about .* use nworld=10 at most"):
        open_engine(engine, model, 11, cpu, [])
    with pytest.raises(ValueError, match=r"6 worlds of hopper need about .* use nworld=5 at most"):
        open_engine(engine, model, 6, cpu, [], reserved=each)


def test_small_batches_move_to_the_cpu_only_with_engine_auto() -> None:
    assert options_for_few_worlds("auto", "cuda:0") == ON_CPU
    for engine, device in (("auto", "cpu"), ("auto", None), ("warp", "cuda:0"), ("mujoco", "cpu"), (ToyEngine, "cuda")):
        assert options_for_few_worlds(engine, device) == {}


def test_plant_moves_from_the_gpu_to_the_cpu(gpu: Any) -> None:
    """On the GPU, the planner would delay the plant's steps."""
    for engine, device in (("auto", "cuda:0"), ("warp", "cuda:0")):
        assert options_for_plant(engine, device) == ON_CPU
    for engine, device in (("auto", None), ("warp", "cpu"), ("mujoco", "cpu"), (ToyEngine, "cuda:0")):
        assert options_for_plant(engine, device) == {}


def test_engine_of_a_planner_depends_on_the_number_of_samples(gpu: Any) -> None:
    def chosen(
        samples: int,
        engine: str = "auto",
        device: str = "cuda:0",
        nthread: int = 2,
        noslip: bool = False,
        solver: dict[str, int | float] | None = None,
    ) -> Any:
        spec = mujoco.MjSpec()
        spec.option.noslip_iterations = 3 if noslip else 0
        return place_samples(engine, device, nthread=nthread, samples=samples, spec=lambda: spec, solver=solver)

    on_gpu = {"engine": "warp", "nthread": None}
    assert [chosen(n) for n in (79, 80)] == [ON_CPU, on_gpu]
    assert chosen(79, nthread=1) == on_gpu and chosen(1, engine="warp") == {}
    assert chosen(640, nthread=128) == on_gpu, "more than 16 cores were not measured"
    assert chosen(4096, device="cpu") == {}
    assert [chosen(n, noslip=True) for n in (160, 479, 480)] == [ON_CPU, ON_CPU, on_gpu]
    assert chosen(160, noslip=True, solver={"noslip_iterations": 0}) == on_gpu
    assert chosen(160, solver={"noslip_iterations": 3}) == ON_CPU


def test_c_engine_on_a_gpu_raises_an_error(model: mujoco.MjModel, gpu: Any) -> None:
    with pytest.raises(ValueError, match="runs on the CPU, not on 'cuda:0': use device='cpu' or engine='warp'"):
        open_engine("mujoco", model, 1, gpu, [])


def test_cpu_cores_counts_the_cores_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    assert cpu_cores() == 3
