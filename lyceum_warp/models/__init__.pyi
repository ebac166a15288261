from lyceum_warp.models.actuators import (
    follow_velocity as follow_velocity,
    unstable_servos as unstable_servos,
)
from lyceum_warp.models.legs import Legs as Legs
from lyceum_warp.models.objects import ObjectModels as ObjectModels
from lyceum_warp.models.terrain import (
    Terrain as Terrain,
    height_field as height_field,
    scan_grid as scan_grid,
)
