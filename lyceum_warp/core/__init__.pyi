from lyceum_warp.core.cameras import Camera as Camera
from lyceum_warp.core.done import (
    FAULTS as FAULTS,
    Done as Done,
)
from lyceum_warp.core.fields import (
    INPUTS as INPUTS,
    element_names as element_names,
    elements as elements,
    quat as quat,
    vec10 as vec10,
)
from lyceum_warp.core.fitted import FIT_FORMAT as FIT_FORMAT
from lyceum_warp.core.gate import (
    Gate as Gate,
    Limit as Limit,
    Verdict as Verdict,
)
from lyceum_warp.core.mirror import Mirror as Mirror
from lyceum_warp.core.model_fields import (
    MOVED_INERTIA as MOVED_INERTIA,
    NOT_NEGATIVE as NOT_NEGATIVE,
    VARYING_FIELDS as VARYING_FIELDS,
)
from lyceum_warp.core.model_files import (
    ModelFile as ModelFile,
    ModelSource as ModelSource,
    find_model as find_model,
    gymnasium_model as gymnasium_model,
    gymnasium_robotics_model as gymnasium_robotics_model,
    load_spec as load_spec,
    menagerie_model as menagerie_model,
    package_model as package_model,
    playground_model as playground_model,
    read_spec as read_spec,
)
from lyceum_warp.core.objects import (
    Objects as Objects,
    mesh as mesh,
    myosuite_objects as myosuite_objects,
    shape as shape,
)
from lyceum_warp.core.options import (
    CONES as CONES,
    INTEGRATORS as INTEGRATORS,
    JACOBIANS as JACOBIANS,
    OPTIONS as OPTIONS,
    EnvOptions as EnvOptions,
    PhysicsOptions as PhysicsOptions,
    given_values as given_values,
)
from lyceum_warp.core.spaces import (
    COUNTERS as COUNTERS,
    Space as Space,
)
from lyceum_warp.core.task import (
    FUNCTIONS as FUNCTIONS,
    MEMORIES as MEMORIES,
    Planning as Planning,
    Row as Row,
    Task as Task,
    Training as Training,
    act as act,
    actuator as actuator,
    actuators as actuators,
    bodies as bodies,
    body as body,
    camera as camera,
    ctrl as ctrl,
    dof as dof,
    dofs as dofs,
    equality as equality,
    from_model as from_model,
    geom as geom,
    geoms as geoms,
    joint as joint,
    joints as joints,
    lasting_memory as lasting_memory,
    memory as memory,
    mocap as mocap,
    observer_name as observer_name,
    part as part,
    qpos as qpos,
    qposes as qposes,
    sensor as sensor,
    sensors as sensors,
    site as site,
    sites as sites,
    tendon as tendon,
)
