from lyceum_warp.engines.base import (
    Engine as Engine,
    EngineFactory as EngineFactory,
)
from lyceum_warp.engines.c.batch_faults import call_batch as call_batch
from lyceum_warp.engines.placement import (
    engine_name as engine_name,
    options_for_few_worlds as options_for_few_worlds,
    options_for_plant as options_for_plant,
    options_on_cores as options_on_cores,
)
