import contextlib
import copy
import dataclasses
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp.core.fields import describe
from lyceum_warp.engines.deterministic.contact_order import _ROWS, _SPARSE_ROWS, CanonicalOrder
from lyceum_warp.engines.deterministic.deterministic_engine import DeterministicEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine


@pytest.fixture
def without_allocators(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable custom allocators, because they need a CUDA device."""
    monkeypatch.setattr(wp, "ScopedAllocator", lambda *args: contextlib.nullcontext())


@pytest.mark.usefixtures("without_allocators")
def test_deterministic_engine_takes_the_same_steps_as_the_warp_engine() -> None:
    """On the CPU, the two engines differ only in the order of sums."""
    envs = [lw.make("hopper", engine=engine, nworld=3, horizon=3) for engine in (DeterministicEngine, WarpEngine)]
    ordered, plain = envs
    for _ in range(4):
        for env in envs:
            env.step(torch.full_like(env.action, 0.3))
        torch.testing.assert_close(ordered.get_state(), plain.get_state(), rtol=1e-3, atol=1e-3)
    engine: Any = ordered.engine
    assert engine.name == "warp" and engine.m.opt.deterministic == mjw.DeterminismType.ALL
    model, _ = engine.bare()
    assert model.callback.contactfilter is not None and model.opt.deterministic == mjw.DeterminismType.ALL
    assert ordered.bytes_per_world > 3 * plain.bytes_per_world


# these tests shuffle contacts and rows, because their order is random only on a GPU


@pytest.fixture(scope="module", params=["dense", "sparse"])
def forwarded(request: pytest.FixtureRequest) -> tuple[WarpEngine, CanonicalOrder]:
    model = copy.copy(lw.make("humanoid").model)
    model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{request.param.upper()}")
    engine = WarpEngine(model, 3, wp.get_device("cpu"), [describe(model, "qpos")])
    qpos = engine.arrays["qpos"].numpy()
    qpos[:, 2] = (1.2, 0.25, 0.3)
    qpos[1:, 3:7] = (0.7, 0.0, 0.7, 0.0)
    qpos[:, 7:] = np.random.default_rng(0).uniform(-1.5, 1.5, qpos[:, 7:].shape)
    sorter = CanonicalOrder(engine.m, engine.d)
    return engine, sorter


def contents(*owners: object) -> dict[str, np.ndarray]:
    # type: ignore[arg-type]
    return {f.name: getattr(o, f.name).numpy().copy() for o in owners for f in dataclasses.fields(o)}


@pytest.mark.quick("sparse")
def test_shuffled_contacts_are_sorted_into_the_same_order(forwarded: tuple[WarpEngine, CanonicalOrder]) -> None:
    engine, _ = forwarded
    m, d = engine.m, engine.d
    sort_rows, m.callback.passive = m.callback.passive, None
    mjw.fwd_position(m, d)
    n, wanted = int(d.nacon.numpy()[0]), contents(d.contact)
    assert n > 8 and len(set(wanted["worldid"][:n])) > 1
    assert (np.diff(wanted["worldid"][:n]) >= 0).all()
    shuffle = np.random.default_rng(1).permutation(n)
    assert (shuffle != np.arange(n)).any()
    for name, values in wanted.items():
        if len(values):
            getattr(d.contact, name).numpy()[:n] = values[:n][shuffle]
    m.callback.contactfilter(m, d)
    for name, values in contents(d.contact).items():
        np.testing.assert_array_equal(values[:n], wanted[name][:n], err_msg=name)
    m.callback.passive = sort_rows


def test_shuffled_constraint_rows_are_sorted_into_the_same_order(forwarded: tuple[WarpEngine, CanonicalOrder]) -> None:
    engine, sorter = forwarded
    m, d = engine.m, engine.d
    mjw.fwd_position(m, d)
    sorter.sort_rows(m, d)
    wanted, counts = contents(d.efc), d.nefc.numpy()
    addresses = d.contact.efc_address.numpy().copy()
    assert counts.max() > 20
    names = [*_ROWS, *_SPARSE_ROWS, "J"]
    rng = np.random.default_rng(2)
    for w, n in enumerate(counts):
        kinds = np.minimum(wanted["type"][w, :n], 5)
        groups = {key: rng.random() for key in zip(kinds, wanted["id"][w, :n], strict=True)}
        keys = [groups[kind, i] for kind, i in zip(kinds, wanted["id"][w, :n], strict=True)]
        shuffle = np.argsort(keys, kind="stable")  # a stable sort keeps the rows of a constraint adjacent and in order
        place = np.argsort(shuffle)
        for name in names:
            array = getattr(d.efc, name).numpy()
            if not (name == "J" and m.is_sparse) and array.shape[1]:
                array[w, :n] = wanted[name][w, :n][shuffle]
        mine = d.contact.worldid.numpy()[: int(d.nacon.numpy()[0])] == w
        rows = d.contact.efc_address.numpy()[: len(mine)]
        rows[mine] = np.where(addresses[: len(mine)][mine] >= 0, place[addresses[: len(mine)][mine]], -1)
        if m.is_sparse:
            blocks = rng.permutation(nblock := wanted["jtdaj_nblock"][w])
            d.efc.jtdaj_adr.numpy()[w, :nblock] = place[wanted["jtdaj_adr"][w, blocks]]
            d.efc.jtdaj_nrow.numpy()[w, :nblock] = wanted["jtdaj_nrow"][w, blocks]
    assert (d.efc.id.numpy() != wanted["id"]).any()
    sorter.sort_rows(m, d)
    found = contents(d.efc)
    for name in names:
        for w, n in enumerate(counts):
            np.testing.assert_array_equal(found[name][w, :n], wanted[name][w, :n], err_msg=name)
    for w, nblock in enumerate(wanted["jtdaj_nblock"] if m.is_sparse else ()):
        for name in ("jtdaj_adr", "jtdaj_nrow"):
            np.testing.assert_array_equal(found[name][w, :nblock], wanted[name][w, :nblock], err_msg=name)
    n = int(d.nacon.numpy()[0])
    np.testing.assert_array_equal(d.contact.efc_address.numpy()[:n], addresses[:n])
