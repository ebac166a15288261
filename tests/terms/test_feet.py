import numpy as np
from term_calls import N, call

DT, SUBSTEP, SKIP = 0.02, 0.005, 4


def test_contact_sequences_determine_foot_timers_and_swings() -> None:
    rng = np.random.default_rng(1)
    touching = rng.random((N, 200)) < 0.5
    touching = np.repeat(touching, rng.integers(1, 5), axis=1)[:, :200]
    height = rng.uniform(0.0, 0.2, (N, 200 // SKIP))
    rows = {name: np.zeros((N, 3)) for name in ("contact_time", "air_time", "peak_height", "swing_height")}
    contact, air, peak, last_peak = (np.zeros(N) for _ in range(4))
    landings = 0
    for k in range(200):
        clocks = {name: rows[name] for name in ("contact_time", "air_time")}
        after = call("run_clocks", foot=1, touching=touching[:, k], substep_dt=SUBSTEP, **clocks).after
        rows |= {name: after[name] for name in clocks}
        contact, air = np.where(touching[:, k], contact + 1, 0), np.where(touching[:, k], 0, air + 1)
        for name, substeps in {"contact_time": contact, "air_time": air}.items():
            np.testing.assert_allclose(rows[name][:, 1], SUBSTEP * substeps, atol=1e-5)
        if k % SKIP == SKIP - 1:
            now = height[:, k // SKIP]
            swings = {name: rows[name] for name in ("contact_time", "peak_height", "swing_height")}
            rows |= call("follow_swing", foot=1, foot_height=now, dt=DT, **swings).after
            new = (contact > 0) & (contact <= SKIP)
            landings += int(new.sum())
            last_peak = np.where(new, peak, last_peak)
            peak = np.where(new, 0.0, np.where(contact == 0, np.maximum(peak, now), peak))
            np.testing.assert_allclose(rows["peak_height"][:, 1], peak, atol=1e-6)
            np.testing.assert_allclose(rows["swing_height"][:, 1], last_peak, atol=1e-6)
    assert landings > N
    assert all((rows[name][:, [0, 2]] == 0).all() for name in clocks)
