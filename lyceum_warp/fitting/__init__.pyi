from lyceum_warp.fitting.excitation import excitation as excitation
from lyceum_warp.fitting.fit import (
    DEFAULT as DEFAULT,
    fit as fit,
)
from lyceum_warp.fitting.log import (
    LogSource as LogSource,
    read_log as read_log,
)
from lyceum_warp.fitting.parameters import Parameter as Parameter
from lyceum_warp.fitting.result import Fit as Fit
