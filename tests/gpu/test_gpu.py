import contextlib
import gc
import math
from collections.abc import Callable, Iterator

import pytest
import torch
import warp as wp
from metered_task import Metered
from table_task import Follow

import lyceum_warp as lw
from lyceum_warp.engines.deterministic.deterministic_engine import DeterministicEngine
from lyceum_warp.engines.deterministic.sort_memory import ScratchSizes
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.testing import check_task

pytestmark = pytest.mark.gpu

CUDA = "cuda:0"


@contextlib.contextmanager
def nothing_waits() -> Iterator[None]:
    """Raise an exception in every call that waits for the device."""
    patch = pytest.MonkeyPatch()

    def forbid(name: str) -> Callable[..., None]:
        def forbidden(*args: object, **kwargs: object) -> None:
            raise AssertionError(f"{name} waits for the device")

        return forbidden

    copy = wp.copy

    def checked_copy(dest: wp.array, src: wp.array, *args: object, **kwargs: object) -> None:
        assert dest.device == src.device, f"a copy from {src.device} to {dest.device} waits for the device"
        copy(dest, src, *args, **kwargs)  # type: ignore[arg-type]

    for name in ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"):
        patch.setattr(wp, name, forbid(f"wp.{name}"))
    patch.setattr(wp.array, "numpy", forbid("numpy()"))
    patch.setattr(wp.array, "list", forbid("list()"))
    patch.setattr(wp, "copy", checked_copy)
    patch.setattr(torch.cuda, "synchronize", forbid("torch.cuda.synchronize"))
    mode = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(mode)
        patch.undo()


def memory() -> tuple[int, int]:
    torch.cuda.synchronize()
    wp.synchronize_device(CUDA)
    return wp.get_mempool_used_mem_current(CUDA), torch.cuda.memory_allocated()


@pytest.mark.parametrize("task", ["hopper", "half_cheetah", "humanoid", "reach"])
def test_steps_neither_wait_for_the_device_nor_allocate_memory(task: str) -> None:
    env = lw.make(task, nworld=256, device=CUDA)
    generator = torch.Generator(CUDA).manual_seed(0)
    actions = 2 * torch.rand(16, *env.action.shape, generator=generator, device=CUDA) - 1
    mask = torch.zeros(256, dtype=torch.bool, device=CUDA)
    mask[::3] = True
    state = env.get_state()

    def round_of(steps: int) -> None:
        for t in range(steps):
            env.step(actions[t % 16])
            if t % 10 == 0:
                env.rand_reset(t)
                env.rand_reset(mask=mask)
                env.get_state(out=state)
                env.reset(mask)
                env.set_state(state, mask, check=False)
                env.set_state(state, check=False)

    round_of(30)  # captures every graph
    before = memory()
    with nothing_waits():
        round_of(10_000 if task == "hopper" else 1000)
    assert memory() == before
    assert torch.isfinite(env.obs).all()
    assert env.episode_step.max() > 0


def run(env: lw.Env, steps: int) -> list[torch.Tensor]:
    generator = torch.Generator(CUDA).manual_seed(1)
    results = []
    env.rand_reset(3)
    for _ in range(steps):
        env.step(2 * torch.rand(env.action.shape, generator=generator, device=CUDA) - 1)
        results += [env.get_state(), env.obs.clone(), env.reward.clone(), env.done_reason.clone()]
    return results


@pytest.mark.parametrize("task", ["hopper", "humanoid", "half_cheetah"])
def test_deterministic_graphs_equal_direct_launches(task: str) -> None:
    replayed, direct = (
        lw.make(task, nworld=512, device=CUDA, deterministic=True, graphs=graphs) for graphs in (True, False)
    )
    for a, b in zip(run(replayed, 20), run(direct, 20), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("task", ["hopper", "humanoid", "half_cheetah"])
def test_deterministic_runs_are_equal_bit_for_bit(task: str) -> None:
    env = lw.make(task, nworld=8192, device=CUDA, deterministic=True)
    first = run(env, 50)
    for a, b in zip(first, run(env, 50), strict=True):
        assert torch.equal(a, b)


def test_memory_use_of_the_deterministic_mode_matches_the_estimate() -> None:
    def free() -> int:
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.synchronize()
        return torch.cuda.mem_get_info(CUDA)[0]

    few = lw.make("hopper", nworld=256, device=CUDA, deterministic=True)
    few.step()  # the first call allocates memory that does not depend on the number of worlds
    engine = few.engine
    assert isinstance(engine, DeterministicEngine)
    sizes = ScratchSizes.probe(engine._captured_step)
    plain = WarpEngine.bytes_per_world(engine.model, engine.fields.values(), nconmax=engine.nconmax, njmax=engine.njmax)
    most = min(sizes.most, int(0.8 * free() / (plain + sizes.each)))
    for nworld in (16384, most):
        before = free()
        env = lw.make("hopper", nworld=nworld, device=CUDA, deterministic=True)
        made = free()
        for _ in range(3):
            env.step()
        env.rand_reset()
        env.rand_reset()
        estimated, taken = sizes.bytes_of(nworld) + nworld * plain, before - free()
        assert 0.8 * estimated < taken < 1.2 * estimated, (nworld, estimated, taken)
        assert made - free() < 0.1 * taken
        del env
    with pytest.raises(ValueError, match=r"nworld=\d+ at most"):
        lw.make("hopper", nworld=int(1.3 * most), device=CUDA, deterministic=True)
    occupied = torch.empty(free() - int(2e9), dtype=torch.uint8, device=CUDA)
    with pytest.raises(ValueError, match=r"32768 worlds of hopper need about .* nworld=\d+ at most"):
        lw.make("hopper", nworld=32768, device=CUDA, deterministic=True)
    del occupied


@pytest.mark.parametrize("deterministic", [False, True])
def test_restarting_worlds_get_the_fields_of_a_full_forward_pass(deterministic: bool) -> None:
    env, other = (lw.make("humanoid", nworld=512, device=CUDA, deterministic=deterministic) for _ in range(2))
    other.engine.partial_refresh = False  # type: ignore[attr-defined]
    seen = 0
    for t in range(200):
        env.step(0.4 * torch.ones_like(env.action))
        if t < 5 or not (done := env.done.clone()).any():
            continue
        other.set_state(env.get_state())
        other.engine.refresh(wp.full(512, True, dtype=bool, device=CUDA))
        for field in env.engine.snapshots:
            found, wanted = (e.field(field.name)[done] for e in (env, other))
            torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3 * float(wanted.abs().max() + 1))
        seen += int(done.sum())
        if seen > 300:
            break
    assert seen > 0


def test_fault_of_one_humanoid_does_not_change_the_other_worlds() -> None:
    from lyceum_warp.testing import CHECKS

    checks = [check for check in CHECKS if check.__name__ in ("check_bad_state", "check_bad_action")]
    check_task("humanoid", engine="warp", device=CUDA, nworld=4, deterministic=True, steps=50, checks=checks)


def test_evaluation_with_few_worlds_runs_on_the_cpu() -> None:
    env = lw.make("hopper", nworld=8, device=CUDA, deterministic=True, nconmax=16, integrator="euler")
    few = env.replicate_few(2, autoreset=False)
    assert (few.engine.name, few.device.is_cpu, few.nworld, few.autoreset) == ("mujoco", True, 2, False)
    assert few.model.opt.integrator == env.model.opt.integrator
    assert lw.make("hopper", device=CUDA, engine="warp").replicate_few(2).device.is_cuda
    npg = lw.NPG(lw.make("point_mass", nworld=64, device=CUDA), config=lw.NPGConfig(samples=256, mean_every=1))
    assert math.isfinite(next(npg).mean_return or math.nan)


def test_graphs_read_changed_tables_on_the_device() -> None:
    env = lw.make(Follow, nworld=64, device=CUDA)
    for motion in ([[0.0, 1.0], [0.5, 2.0]], [[4.0, 5.0], [6.0, 7.0]], [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]):
        env.set_params(motion=torch.tensor(motion, device=CUDA))
        env.reset()
        for row in [*motion, motion[-1]]:
            assert env.obs[:, 1].unique().tolist() == [row[0]]
            env.step()
    env.set_params(gain=torch.arange(64))
    env.step()
    assert env.obs[:, 1].unique().tolist() == [3.0]


def test_rollout_with_groups_and_metrics_does_not_wait_for_the_device() -> None:
    env = lw.make(Metered, nworld=64, device=CUDA)
    rollout = lw.Rollout(env, 50, groups=("critic",))
    policy = lw.GaussianPolicy(1, 1).to(CUDA)
    noise = torch.randn(rollout.action.shape, device=CUDA)
    for _ in range(2):
        rollout.collect(policy, noise)
    with nothing_waits():
        rollout.collect(policy, noise)
    assert torch.equal(rollout.obs_groups["critic"][..., 0], rollout.obs[..., 0])
    efforts, sums = rollout.action[..., 0].square(), rollout.episode_metrics["effort"]
    goes_on = ~rollout.done[:-1]
    torch.testing.assert_close((sums[1:] - sums[:-1])[goes_on], efforts[1:][goes_on], rtol=1e-4, atol=1e-4)
