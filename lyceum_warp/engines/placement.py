"""TEMPORARY until the engines branch is merged."""

from lyceum_warp.engines import ON_CPU_CORES, find_device as find_device
from lyceum_warp.engines import open_engine as _open


def few_worlds(engine, device):
    return {} if device.is_cpu or engine != "auto" else dict(ON_CPU_CORES)


def open_engine(options, model, device, fields, *, beside=0):
    p = options.physics
    e = _open(
        options.engine,
        model,
        options.nworld,
        device,
        nthread=options.nthread,
        nconmax=p.nconmax,
        njmax=p.njmax,
        deterministic=p.deterministic,
        unroll=p.unroll,
    )
    for f in fields:
        e.field(f.name, lagged=f.lagged)
    e.capturable = e.recordable
    e.prepare_capture = e.prepare
    return e
