"""Define XML models with every kind of element."""

from lyceum_warp.testing import fault_rules as faults, state_rules as state

# the checks that depend on the model; slow engines and models run only these
MODEL_CHECKS = (
    state.check_restoring,
    state.check_masked_restoring,
    state.check_purity,
    state.check_masked_reset,
    state.check_graphs,
    faults.check_bad_state,
)

BALL = '<body pos="0 0 {z}"><freejoint/><geom size=".1"/></body>'
ARM = """
<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping=".1"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05"/><site name="tip" pos="0 0 -.5"/>
  <body name="hand" pos="0 0 -.5"><joint name="wrist" axis="0 1 0" damping=".1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".04"/><site name="end" pos="0 0 -.3"/></body></body>
"""
MOTOR = '<actuator><motor name="push" joint="hinge" ctrllimited="true" ctrlrange="-1 1"/></actuator>'
MESH = "-.1 -.1 -.1  .1 -.1 -.1  0 .1 -.1  0 0 .1"


def text(world: str, rest: str = MOTOR, option: str = "") -> str:
    return (
        f'<mujoco model="made"><option timestep="0.005">{option}</option>'
        f'<worldbody><geom name="floor" type="plane" size="5 5 .1"/><site name="here" pos="0 0 2"/>{world}</worldbody>'
        f"{rest}</mujoco>"
    )


def actuated(*actuators: str) -> str:
    return f"<actuator>{''.join(actuators)}</actuator>"


SDF = '<flag/></option><option sdf_iterations="2" sdf_initpoints="8">'

MODELS = {
    "free and ball joints": text(
        BALL.format(z=0.1)
        + '<body pos="1 0 1"><joint name="ball" type="ball" damping=".1"/><geom size=".1" pos="0 0 -.3"/></body>',
        actuated('<motor joint="ball" gear="0 1 0 0 0 0"/>'),
    ),
    "activations": text(
        ARM,
        actuated(
            '<position name="slow" joint="hinge" kp="5" timeconst=".05"/>',
            '<intvelocity name="velocity" joint="wrist" kp="5" actrange="-1 1"/>',
        ),
    ),
    "delays": text(
        ARM,
        actuated(
            '<motor joint="hinge" nsample="4" interp="zoh" delay=".01"/>',
            '<motor joint="wrist" nsample="4" interp="linear" delay=".012"/>',
        ),
    ),
    "muscles": text(
        ARM,
        '<tendon><spatial name="string"><site site="here"/><site site="tip"/></spatial></tendon>'
        + actuated('<muscle tendon="string" lengthrange="1 2" force="5" ctrllimited="true" ctrlrange="0 1"/>'),
    ),
    "tendons": text(
        ARM,
        '<tendon><fixed name="both" limited="true" range="-.1 .1"><joint joint="hinge" coef="1"/>'
        '<joint joint="wrist" coef="-1"/></fixed><spatial name="string" stiffness="5" damping=".1">'
        '<site site="here"/><site site="tip"/></spatial></tendon>'
        + actuated('<position name="pull" tendon="both" kp="2"/>'),
    ),
    "equalities": text(
        ARM + BALL.format(z=1.5),
        '<equality><joint name="held" joint1="hinge" joint2="wrist"/><connect name="hung" active="false" body1="hand" '
        'body2="world" anchor="0 0 0"/></equality>' + MOTOR,
    ),
    "mocap": text(
        ARM + '<body name="target" mocap="true" pos=".3 0 .6"><geom size=".1"/></body>',
        '<equality><weld body1="hand" body2="target" solref=".1 1"/></equality>' + MOTOR,
    ),
    "keyframes": text(ARM, f'{MOTOR}<keyframe><key name="home" qpos=".3 -.3"/><key qpos="1 1"/></keyframe>'),
    "height field": text(
        '<geom type="hfield" hfield="hills" pos="0 0 .05"/>' + BALL.format(z=0.3) + ARM,
        '<asset><hfield name="hills" nrow="3" ncol="3" size="2 2 .2 .1" elevation="0 1 0 1 0 1 0 1 0"/></asset>'
        + MOTOR,
    ),
    "mesh": text(
        '<body pos="0 0 .1"><freejoint/><geom type="mesh" mesh="tetra"/></body>' + ARM,
        f'<asset><mesh name="tetra" vertex="{MESH}"/></asset>' + MOTOR,
    ),
    "flex": text(
        '<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" pos="0 0 .3" radius=".02" '
        'mass=".1"><contact selfcollide="none"/><edge equality="true"/></flexcomp>' + ARM,
    ),
    "names": text(ARM, actuated('<motor name="actuator_1" joint="hinge"/>', '<motor joint="wrist"/>')),
    "sdf": text(
        '<body pos="0 0 .1"><freejoint/><geom type="sdf" mesh="tetra"/></body>' + ARM,
        f'<asset><mesh name="tetra" vertex="{MESH}"/></asset>' + MOTOR,
        SDF,
    ),
    "sleep": text(BALL.format(z=0.1) + ARM, option='<flag sleep="enable"/>'),
    "position sensors": text(
        ARM + '<body pos="1 0 .5"><joint name="lift" type="slide" axis="0 0 1" range="-.01 .5" limited="true"/>'
        '<geom size=".1"/></body>',
        MOTOR + '<sensor><jointpos joint="hinge"/><framepos objtype="site" objname="end"/><rangefinder site="here"/>'
        '<subtreecom body="arm"/><jointlimitpos joint="lift"/><e_potential/></sensor>',
    ),
    "velocity sensors": text(
        ARM,
        MOTOR + '<sensor><gyro site="end"/><velocimeter site="end"/><jointvel joint="wrist"/>'
        '<subtreeangmom body="arm"/><actuatorvel actuator="push"/><e_kinetic/></sensor>',
    ),
    "acceleration sensors": text(
        ARM + BALL.format(z=0.1),
        MOTOR + '<sensor><framequat objtype="site" objname="end"/><accelerometer site="end"/><force site="tip"/>'
        '<touch site="end"/><actuatorfrc actuator="push"/><contact geom1="floor" num="1" data="found force"/></sensor>',
    ),
    "welds and sensors": text(
        ARM + BALL.format(z=1.5) + '<body name="target" mocap="true" pos=".3 0 .6"/>',
        '<equality><weld body1="hand" body2="target" solref=".1 1"/></equality>'
        '<sensor><gyro site="end"/><framepos objtype="site" objname="end"/></sensor>' + MOTOR,
    ),
    "delayed sensors": text(
        ARM,
        MOTOR + '<sensor><jointpos joint="hinge" nsample="4" delay=".012"/><jointvel joint="hinge" nsample="4" '
        'interval=".02"/><accelerometer site="end" nsample="4" interval=".015" delay=".01"/></sensor>',
    ),
}

PLUGINS = {
    "SDF plugins need a registered distance function": text(
        '<body pos="0 0 .3"><freejoint/><geom type="sdf" mesh="torus"><plugin instance="torus"/></geom></body>' + ARM,
        '<extension><plugin plugin="mujoco.sdf.torus"><instance name="torus"><config key="radius1" value=".3"/>'
        '<config key="radius2" value=".1"/></instance></plugin></extension>'
        '<asset><mesh name="torus"><plugin instance="torus"/></mesh></asset>' + MOTOR,
        SDF,
    ),
    "Actuator plugins not supported": text(
        ARM,
        '<extension><plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="5"/>'
        '<config key="ki" value="1"/><config key="slewmax" value="3"/></instance></plugin></extension>'
        + actuated('<plugin joint="hinge" plugin="mujoco.pid" instance="pid" actdim="2"/>'),
    ),
    "Quadratic flex interpolation": text(
        '<flexcomp name="ball" type="ellipsoid" dim="3" count="3 3 3" spacing=".05 .05 .05" dof="quadratic" mass=".1" '
        'pos="0 0 .3" radius=".003"><contact selfcollide="none"/><elasticity young="1e4" damping=".01"/></flexcomp>'
        + ARM,
    ),
    "'mjTRN_SO3'] not supported": text(
        ARM, actuated('<orientation name="aim" site="tip" refsite="here" kp="1"/>', '<motor joint="wrist"/>')
    ),
}
"""Models that only the C engine supports, and the error message of the Warp engine for each model."""
