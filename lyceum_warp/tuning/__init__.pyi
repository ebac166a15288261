from lyceum_warp.tuning.judgement import Difference as Difference
from lyceum_warp.tuning.search import (
    Tuning as Tuning,
    tune as tune,
)
from lyceum_warp.tuning.trial import (
    DIVERGENCE_STEPS as DIVERGENCE_STEPS,
    NUDGE as NUDGE,
)
