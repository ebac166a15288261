from lyceum_warp.tuning.judgement import Difference as Difference
from lyceum_warp.tuning.search import (
    Tuning as Tuning,
    tune as tune,
)
