"""Values that options may take, apart from what they stand for: nothing here imports NumPy."""

from typing import Literal, get_args

Base = Literal["auto", "floating", "fixed"]
Method = Literal["map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"]
Filter = Literal["weak", "butterworth", "savitzky_golay"]
Channels = Literal["all", "thesis"]
Criterion = Literal["gen_force", "torque", "com"]
Term = Literal["viscous", "coulomb", "armature", "offset"]
SensorErrorKind = Literal[
    "plate_offset",
    "plate_gain",
    "plate_pose",
    "torque_gain",
    "imu_mounting",
    "imu_bias",
    "encoder_offset",
]

METHODS: tuple[Method, ...] = get_args(Method)
# Those that weight data against a prior, and use pseudo-measurements.
GAUSSIAN: tuple[Method, ...] = ("map_lmi", "map")
TERMS: tuple[Term, ...] = get_args(Term)
SENSOR_ERROR_KINDS: tuple[SensorErrorKind, ...] = get_args(SensorErrorKind)
