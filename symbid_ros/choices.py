"""Allowed values of options. Nothing here imports NumPy, so that commands start quickly."""

from typing import Literal, NamedTuple, get_args

Base = Literal["auto", "floating", "fixed"]
Method = Literal["map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"]
Filter = Literal["weak", "butterworth", "savitzky_golay"]
Channels = Literal["all", "thesis"]
Criterion = Literal["gen_force", "torque", "com"]
Term = Literal[
    "viscous",
    "coulomb",
    "armature",
    "offset",
    "stribeck",
    "load",
    "presliding",
    "stiffness",
    "lead",
    "creep",
]
Scenario = Literal[
    "smooth", "wide", "squat", "vibrating", "one_leg", "stepping", "suspended", "tare"
]
SensorErrorKind = Literal[
    "wrench_offset",
    "wrench_gain",
    "wrench_position",
    "torque_gain",
    "imu_mounting",
    "imu_bias",
    "encoder_offset",
    "compliance",
    "sensor_delay",
    "link_length",
    "joint_axis",
    "frame_pose",
]

BASES: tuple[Base, ...] = get_args(Base)
METHODS: tuple[Method, ...] = get_args(Method)
# Methods that combine the data with a prior, and use pseudo-measurements.
GAUSSIAN: tuple[Method, ...] = ("map_lmi", "map")
FILTERS: tuple[Filter, ...] = get_args(Filter)
CHANNELS: tuple[Channels, ...] = get_args(Channels)
TERMS: tuple[Term, ...] = get_args(Term)
SENSOR_ERROR_KINDS: tuple[SensorErrorKind, ...] = get_args(SensorErrorKind)
# Those that calibration usually leaves. Elastic joints and wrong kinematics are properties of the
# robot, and stamps one of drivers and networks.
TYPICAL_ERRORS: tuple[SensorErrorKind, ...] = SENSOR_ERROR_KINDS[:7]
# Errors of the model's geometry.
KINEMATIC_ERRORS: tuple[SensorErrorKind, ...] = ("link_length", "joint_axis")
# Errors of geometry, which also change where the forces of contacts without a sensor act.
UNSEEN_WITH_CONTACTS: tuple[SensorErrorKind, ...] = (*KINEMATIC_ERRORS, "frame_pose")


class JointTerm(NamedTuple):
    """A parameter that each joint may add to its row of the equation of motion.

    Attributes
    ----------
    units : tuple of str
        Of a revolute and of a prismatic joint.
    field : str or None
        Field of a joint that holds the value of a model file; None if no format has it.
    std : float
        Prior standard deviation of a revolute joint whose file gives no value, wide for a leg.
    lever_power : int
        Power of 1/lever by which ``std`` is larger for a prismatic joint.
    load_share : float
        Standard deviation in the checks of a log, as a share of the joint's load.
    is_nonnegative : bool
    """

    units: tuple[str, str]
    field: str | None
    std: float
    lever_power: int
    load_share: float
    is_nonnegative: bool


JOINT_TERMS: dict[Term, JointTerm] = {
    "viscous": JointTerm(("Nm s/rad", "N s/m"), "damping", 1.0, 2, 0.3, True),
    "coulomb": JointTerm(("Nm", "N"), "friction_loss", 2.0, 1, 0.3, True),
    "armature": JointTerm(("kg m^2", "kg"), "armature", 0.1, 2, 0.3, True),
    "offset": JointTerm(("Nm", "N"), None, 1.0, 1, 0.1, False),
    "stribeck": JointTerm(("Nm", "N"), None, 2.0, 1, 0.3, False),
    "load": JointTerm(("Nm/Nm", "N/N"), None, 0.1, 0, 0.1, True),
    "presliding": JointTerm(("Nm", "N"), None, 2.0, 1, 0.3, True),
    "stiffness": JointTerm(("Nm/rad", "N/m"), "stiffness", 1.0, 2, 0.3, True),
    "lead": JointTerm(("Nm", "N"), None, 2.0, 1, 0.3, True),
    "creep": JointTerm(("Nm", "N"), None, 2.0, 1, 0.3, True),
}
# Candidates only on robots whose model file states one, because few have it; the data are searched
# for it otherwise.
SPRING: Term = "stiffness"
# A candidate only if the friction of all joints together leads, as that of simulated joints does.
LEAD: Term = "lead"
# Terms of the friction of simulated joints alone.
SIMULATED_TERMS: tuple[Term, ...] = (LEAD, "creep")
# Terms that act only while a joint slips. A sticking joint has static friction in their place.
SLIDING_TERMS: frozenset[Term] = frozenset(
    {"coulomb", "stribeck", "load", "presliding", *SIMULATED_TERMS}
)
