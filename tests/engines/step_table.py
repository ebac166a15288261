"""Generate models that together contain every element that both engines support."""

import functools
import itertools
import random
from collections.abc import Mapping

import mujoco

Case = dict[str, str]
"""Map each factor to one of its levels."""

GENERAL = "<general {place} {kind} {extra}/>"
DRIVES = {
    "motor": GENERAL.replace("{kind}", 'gaintype="fixed" gainprm="1.5"'),
    "servo": GENERAL.replace("{kind}", 'gaintype="fixed" gainprm="3" biastype="affine" biasprm="0 -3 -.1"'),
    "damper": GENERAL.replace("{kind}", 'gaintype="affine" gainprm=".1 0 -.5" ctrllimited="true" ctrlrange="0 1"'),
    "integrator": GENERAL.replace("{kind}", 'dyntype="integrator" gaintype="fixed" gainprm="3" biastype="affine" '
                                  'biasprm="0 -3 -.1" actlimited="true" actrange="-1 1"'),
    "filter": GENERAL.replace("{kind}", 'dyntype="filter" dynprm=".02" gaintype="fixed" gainprm="2"'),
    "filterexact": GENERAL.replace("{kind}", 'dyntype="filterexact" dynprm=".02" gaintype="fixed" gainprm="2" '
                                   'actearly="true" forcelimited="true" forcerange="-.5 .5"'),
    "muscle": GENERAL.replace("{kind}", 'dyntype="muscle" gaintype="muscle" biastype="muscle" dynprm=".01 .04 0" '
                              'gainprm=".75 1.05 5 200 .5 1.6 1.5 1.3 1.2" biasprm=".75 1.05 5 200 .5 1.6 1.5 1.3 1.2" '
                              'lengthrange=".1 2"'),
    "dcmotor": '<dcmotor {place} motorconst=".5" resistance="1" {extra}/>',
    "user": GENERAL.replace("{kind}", 'dyntype="user" gaintype="user" biastype="user" actdim="1"'),
}  # fmt: skip

DRIVE_GROUPS = {
    "instant": ("motor", "servo", "damper"),
    "filtered": ("integrator", "filter", "filterexact"),
    "special": ("muscle", "dcmotor", "user"),
}
"""Groups of actuator types. A model uses one group, with one actuator for each pair of type and transmission."""

PLACES = {
    "joint": 'joint="hip"',
    "parent": 'jointinparent="ball" gear=".1 .2 .1"',
    "crank": 'cranksite="crank" slidersite="slider" cranklength=".6"',
    "cord": 'tendon="cord" gear="2"',
    "string": 'tendon="string"',
    "site": 'site="tip" gear="0 0 .3 0 .1 0"',
    "refsite": 'site="tip" refsite="here" gear="0 0 .3 0 0 0"',
}
"""Transmissions of actuators. Adhesion is a separate factor."""

EQUALITIES = {
    "none": "",
    "connect": '<connect body1="hand" body2="arm" anchor=".02 0 -.1" {0}/><connect site1="tip" site2="knot" {0}/>',
    "weld": '<weld body1="cart" body2="target" solref=".05 1" {0}/>'
    '<weld site1="tip" site2="knot" torquescale=".1" {0}/>',
    "joint": '<joint joint1="hip" joint2="elbow" polycoef=".1 .5 0 0 0" {0}/>'
    '<joint joint1="lift" polycoef=".1 0 0 0 0" {0}/>',
    "tendon": '<tendon tendon1="cord" tendon2="string" polycoef="0 .5 0 0 0" {0}/>',
}
SHAPE = '<flexcomp name="soft" type="grid" spacing=".1 .1 .1" radius=".02" mass=".2" '
LOOSE = '<contact selfcollide="none"/>'
FLEXES = {
    "none": "",
    "rope": SHAPE + f'dim="1" count="4 1 1" pos="0 2 .8">{LOOSE}<edge stiffness="10" damping=".1"/></flexcomp>',
    "cloth": SHAPE + f'dim="2" count="3 3 1" pos="0 2 .015">{LOOSE}<edge equality="true"/></flexcomp>',
    "shell": SHAPE + f'dim="2" count="3 3 1" pos="0 2 .015">{LOOSE}'
    '<elasticity young="1e3" thickness=".01" damping=".01" elastic2d="both"/></flexcomp>',
    "solid": SHAPE + f'dim="3" count="2 2 2" pos="0 2 .06">{LOOSE}<elasticity young="1e3" damping=".01"/></flexcomp>',
    "lattice": SHAPE + f'dim="3" count="3 3 3" pos="0 2 .2" dof="trilinear">{LOOSE}'
    '<elasticity young="1e3" damping=".01"/></flexcomp>',
    "strain": SHAPE + f'dim="3" count="3 3 3" pos="0 2 .2" dof="trilinear">{LOOSE}<edge equality="strain"/></flexcomp>',
    "springy": SHAPE + 'dim="2" count="3 3 1" pos="0 2 .015"><contact selfcollide="none" passive="true"/>'
    '<elasticity young="1e3" thickness=".01" damping=".01" elastic2d="both"/></flexcomp>',
}
TENDONS = {
    "plain": "",
    "springs": 'stiffness="5" damping=".2" springlength="0 .1"',
    "armature": 'armature=".2"',
    "friction": 'frictionloss=".5"',
    "limits": 'limited="true" range="-.05 .4" margin=".01" actuatorfrclimited="true" actuatorfrcrange="-1 1"',
}
SENSORS = {
    "none": "",
    "position": """<magnetometer site="tip"/><camprojection site="tip" camera="eye"/><rangefinder site="tip"/>
    <jointpos joint="hip"/><tendonpos tendon="cord"/><actuatorpos actuator="{drive} joint"/><ballquat joint="ball"/>
    <framepos objtype="site" objname="tip"/><framequat objtype="body" objname="hand"/>
    <framexaxis objtype="geom" objname="fist"/><frameyaxis objtype="camera" objname="eye"/>
    <framezaxis objtype="xbody" objname="hand" reftype="site" refname="here"/><subtreecom body="arm"/>
    <insidesite site="here" objtype="body" objname="hand"/><e_potential/><clock/>""",
    "velocity": """<velocimeter site="tip"/><gyro site="tip"/><jointvel joint="hip"/><tendonvel tendon="string"/>
    <actuatorvel actuator="{drive} cord"/><ballangvel joint="ball"/><framelinvel objtype="site" objname="tip"/>
    <frameangvel objtype="camera" objname="eye" reftype="body" refname="arm"/><subtreelinvel body="arm"/>
    <subtreeangmom body="arm"/><e_kinetic/>""",
    "limits": """<jointlimitpos joint="elbow"/><jointlimitvel joint="elbow"/><jointlimitfrc joint="elbow"/>
    <tendonlimitpos tendon="stop"/><tendonlimitvel tendon="stop"/><tendonlimitfrc tendon="stop"/>
    <distance geom1="fist" geom2="floor" cutoff="2"/><normal geom1="fist" geom2="floor" cutoff="2"/>
    <fromto geom1="fist" geom2="floor" cutoff="2"/>""",
    "acceleration": """<touch site="foot"/><accelerometer site="tip"/><force site="tip"/><torque site="tip"/>
    <actuatorfrc actuator="{drive} joint"/><jointactuatorfrc joint="hip"/><tendonactuatorfrc tendon="cord"/>
    <framelinacc objtype="site" objname="tip"/><frameangacc objtype="body" objname="hand"/>
    <contact geom1="floor" num="1" data="found force"/>""",
    "histories": """<jointpos joint="hip" nsample="4" delay=".005"/><gyro site="tip" nsample="4" interval=".006"/>
    <accelerometer site="tip" nsample="4" delay=".004"/><framepos objtype="site" objname="tip"/>""",
}

STAGES = {
    "kinematics": "site_xpos",
    "com": "subtree_com",
    "camlight": "cam_xpos light_xdir",
    "flex": "flexvert_xpos flexedge_length",
    "tendon": "ten_length",
    "inertia": "crb",
    "transmission": "actuator_length",
    "com velocity": "cvel",
    "velocity": "ten_velocity actuator_velocity qfrc_bias qfrc_passive",
    "subtree velocity": "subtree_linvel",
    "energy": "energy",
    "acceleration": "qacc qfrc_actuator",
}
"""Map each stage of the physics to the fields of World that it computes."""

FIELDS = {
    "nothing": "",
    "bodies": " ".join(STAGES[name] for name in ("kinematics", "com", "camlight")),
    "positions": " ".join(STAGES[name] for name in ("camlight", "flex", "tendon", "inertia", "transmission")),
    "velocities": " ".join(STAGES[name] for name in ("camlight", "com velocity", "velocity")),
    "everything": " ".join(STAGES.values()).replace("subtree_linvel ", ""),
}

FLAGS = {
    "": "",
    "energy": 'energy="enable" invdiscrete="enable"',
    "no springs": 'spring="disable" warmstart="disable" nativeccd="disable" multiccd="disable" filterparent="disable"',
    "no passive forces": 'spring="disable" damper="disable" gravity="disable" clampctrl="disable" island="disable"',
    "no limits": 'limit="disable" frictionloss="disable" refsafe="disable" equality="disable" contact="disable"',
    "no constraints": 'constraint="disable" sensor="disable" actuation="disable" eulerdamp="disable"',
}

FACTORS: dict[str, tuple[str, ...]] = {
    "asked": tuple(FIELDS),
    "drives": tuple(DRIVE_GROUPS),
    "flags": tuple(FLAGS),
    "flex": tuple(FLEXES),
    "equality": tuple(EQUALITIES),
    "sensors": tuple(SENSORS),
    "integrator": ("Euler", "RK4", "implicit", "implicitfast", "discrete"),
    "tendons": tuple(TENDONS),
    "adhesion": ("none", "actuator", "geom", "pair"),
    "fluid": ("none", "box", "ellipsoid"),
    "gravcomp": ("none", "passive", "actuator"),
    "active": ("true", "false"),
    "armature": ("none", "motors"),
    "delay": ("none", "zoh", "linear"),
    "cone": ("pyramidal", "elliptic"),
    "solver": ("Newton", "CG"),
    "jacobian": ("dense", "sparse"),
    "noslip": ("0", "2"),
}

PLAIN: Case = {name: levels[0] for name, levels in FACTORS.items()}

REFUSED: list[tuple[Mapping[str, tuple[str, ...]], str]] = [
    ({"integrator": ("Euler", "RK4", "implicit", "implicitfast"), "flex": ("springy",)},
     "passive flex contact requires an integrator with the effective metric"),
    ({"integrator": ("implicit", "implicitfast"), "flex": ("shell", "solid", "lattice")},
     "flex elasticity is no longer integrated implicitly"),
    ({"integrator": ("discrete",), "flex": ("rope",)}, "flex edge stiffness and damping are not supported"),
    ({"integrator": ("discrete",), "noslip": ("2",)}, "noslip solver not implemented for the discrete integrator"),
]  # fmt: skip
"""Combinations of levels that MuJoCo or MuJoCo Warp rejects, and the error of each combination."""


def xml(case: Case, sensors: str | None = None) -> str:
    delay = "" if case["delay"] == "none" else f'delay=".005" nsample="4" interp="{case["delay"]}"'
    actuators = []
    for drive, (name, place) in itertools.product(DRIVE_GROUPS[case["drives"]], PLACES.items()):
        heavy = case["armature"] == "motors" and "site" not in place  # MuJoCo rejects armature at sites
        extra = f'armature=".1" damping=".05" {delay}' if heavy else delay
        actuators.append(DRIVES[drive].format(place=f'name="{drive} {name}" {place}', extra=extra))
    if case["adhesion"] == "actuator":
        actuators.append('<adhesion name="sticky" body="cart" gain="2" ctrlrange="0 1"/>')
    sticky = {"geom": 'adhesion="3"'}.get(case["adhesion"], "")
    pair = '<contact><pair geom1="box" geom2="floor" adhesion="3"/></contact>' if case["adhesion"] == "pair" else ""
    fluid = 'density="20" viscosity=".1" wind="1 .5 0"' if case["fluid"] != "none" else ""
    shape = 'fluidshape="ellipsoid"' if case["fluid"] == "ellipsoid" else ""
    gravcomp = 'gravcomp=".7"' if case["gravcomp"] != "none" else ""
    held = 'actuatorgravcomp="true"' if case["gravcomp"] == "actuator" else ""
    equality = EQUALITIES[case["equality"]].format(f'active="{case["active"]}"')
    rope = TENDONS[case["tendons"]]
    wrapped = "" if case["tendons"] == "armature" else rope  # MuJoCo rejects armature of tendons around geoms
    return f"""
    <mujoco>
      <option timestep="0.002" integrator="{case["integrator"]}" cone="{case["cone"]}" solver="{case["solver"]}"
        jacobian="{case["jacobian"]}" noslip_iterations="{case["noslip"]}" iterations="10" ls_iterations="10" {fluid}>
        <flag {FLAGS[case["flags"]]}/></option>
      <worldbody>
        <geom name="floor" type="plane" size="5 5 1"/>
        <site name="here" pos=".3 0 1.2" size=".5"/> <site name="crank" pos="-.3 0 .6"/>
        <geom name="post" type="cylinder" size=".05 .1" pos=".25 .3 .8" contype="0" conaffinity="0"/>
        <geom name="knob" size=".05" pos=".2 0 1" contype="0" conaffinity="0"/>
        <light mode="trackcom" pos="0 0 3"/>
        <camera name="still" mode="targetbody" target="cart" pos="0 -2 1"/>
        <body name="target" mocap="true" pos=".8 0 .1"/>
        <body name="arm" pos="0 0 1" {gravcomp}>
          <joint name="hip" axis="0 1 0" damping=".1" armature=".01" stiffness=".5" {held}/>
          <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04" {shape}/>
          <site name="slider" pos=".1 0 -.1" zaxis="1 0 1"/> <site name="knot" pos=".05 0 -.45"/>
          <camera name="eye" pos="-1 0 0" xyaxes="0 -1 0 1 0 1" resolution="64 48"/>
          <body name="hand" pos="0 0 -.4">
            <joint name="elbow" axis="0 1 0" damping=".1" range="-40 5" limited="true" frictionloss=".3"
              actuatorfrclimited="true" actuatorfrcrange="-.1 .1"/>
            <geom name="fist" type="capsule" fromto="0 0 0 .05 0 -.3" size=".03" {shape}/>
            <site name="tip" pos=".05 0 -.3"/>
          </body>
        </body>
        <body pos="0 .6 .8" {gravcomp}><joint name="ball" type="ball" damping=".1"/>
          <geom type="box" size=".05 .1 .15" pos="0 0 -.15" {shape}/></body>
        <body pos="0 -.6 .059"><joint name="lift" type="slide" axis="1 0 1" damping="1" frictionloss="9"/>
          <geom name="weight" size=".06" solref=".03 1"/></body>
        <body name="cart" pos=".8 0 .098"><freejoint/><geom name="box" type="box" size=".1 .1 .1" {sticky} {shape}/>
          <site name="foot" type="box" size=".12 .12 .12"/></body>
        {FLEXES[case["flex"]]}
      </worldbody>
      <tendon>
        <fixed name="cord" {rope}><joint joint="hip" coef="1"/><joint joint="elbow" coef="-.5"/></fixed>
        <spatial name="string" {rope}><site site="here"/><site site="tip"/></spatial>
        <spatial name="block" {wrapped}><site site="crank"/><geom geom="knob" sidesite="here"/><site site="knot"/>
          <pulley divisor="2"/><site site="knot"/><geom geom="post"/><site site="foot"/></spatial>
        <fixed name="stop" limited="true" range="-.2 .02"><joint joint="elbow" coef="1"/></fixed>
      </tendon>
      {pair}
      <actuator>{"".join(actuators)}</actuator>
      <equality>{equality}</equality>
      <sensor>{(sensors or SENSORS[case["sensors"]]).format(drive=DRIVE_GROUPS[case["drives"]][0])}</sensor>
    </mujoco>"""


def fields_of(case: Case) -> list[str]:
    names = (FIELDS | STAGES)[case["asked"]].split()
    if SENSORS[case["sensors"]] and case["flags"] != "no constraints":
        names.append("sensordata")
    return names


def model_of(case: Case) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(xml(case))
    if "energy" in fields_of(case):
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    if "subtree_linvel" in fields_of(case):
        spec.add_sensor(type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="arm")
    return spec.compile()


def is_refused(case: Case) -> bool:
    return any(all(case[name] in levels for name, levels in match.items()) for match, _ in REFUSED)


@functools.cache
def covering(strength: int, seed: int = 0) -> tuple[Case, ...]:
    """Choose cases that together contain every allowed combination of levels from ``strength`` factors."""
    rng = random.Random(seed)
    drawn = [{name: rng.choice(levels) for name, levels in FACTORS.items()} for _ in range(2000)]
    pool = [(case, set(itertools.combinations(case.items(), strength))) for case in drawn if not is_refused(case)]
    missing, cases = set().union(*(parts for _, parts in pool)), []
    while missing:
        first = min(missing)
        entries = (entry for entry in pool if first in entry[1])
        case, parts = max(entries, key=lambda entry: len(entry[1] & missing))
        missing -= parts
        cases.append(case)
    return tuple(cases)


def title(case: Case) -> str:
    return ", ".join(f"{name}={level}" for name, level in case.items() if level != PLAIN[name]) or "plain"
