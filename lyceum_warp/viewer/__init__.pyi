from lyceum_warp.viewer.follow import Follower as Follower
from lyceum_warp.viewer.session.clock import Watcher as Watcher
from lyceum_warp.viewer.show import view as view
