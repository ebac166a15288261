import pytest
import torch

import lyceum_warp as lw

NWORLD, STEPS = 16384, 10_000


@pytest.mark.gpu
@pytest.mark.long
def test_worlds_with_faults_restart_and_leave_others_unchanged() -> None:
    env = lw.make("half_cheetah", nworld=NWORLD, device="cuda", seed=0)
    generator = torch.Generator("cuda").manual_seed(0)
    broken = torch.randperm(NWORLD, generator=generator, device="cuda")[: NWORLD // 100]
    moments = torch.randint(STEPS, broken.shape, generator=generator, device="cuda")
    victims = {t: broken[moments == t] for t in moments.unique().tolist()}
    qvel = env.field("qvel")
    elsewhere = torch.zeros((), dtype=torch.int64, device="cuda")
    missed, unfit = torch.zeros_like(elsewhere), torch.zeros_like(elsewhere)
    for t in range(STEPS):
        worlds = victims.get(t)
        if worlds is not None:
            qvel[worlds] = torch.nan
        env.action.uniform_(-1.0, 1.0, generator=generator)
        env.step()
        faulted = (env.done_reason & int(lw.Done.NAN)) != 0
        unfit += (~torch.isfinite(env.obs)).sum()
        if worlds is not None:
            missed += (~faulted[worlds]).sum() + (env.episode_step[worlds] != 0).sum()
            faulted[worlds] = False
        elsewhere += (faulted | (env.done_reason > int(lw.Done.NAN))).sum()
    assert (missed.item(), elsewhere.item(), unfit.item()) == (0, 0, 0)
    counts = env.fault_counts
    assert counts.pop("nan") == len(broken)
    assert not any(counts.values())
