"""The estimate: identified parameters with their uncertainty, provenance and verdict."""

from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import TERMS, Base, Channels, Filter
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.directions import describe_determined
from symbid_ros.estimation.provenance import Provenance
from symbid_ros.estimation.unexplained import LARGE
from symbid_ros.estimation.verdict import Verdict
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.ripple import RIPPLE_TERM
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.warming import WARMING_TERM, WARMING_TERMS, Course

MODEL_FILES = "model.urdf", "model.xml"


# Error of held-out data, percent, above which a model is not called fit for predictions despite its
# alarms. Real arms err by up to 9 %.
LARGEST_ERROR = 15.0
# The same for the factor on the prior's deviations, if the base floats: a correct log widens the
# prior up to eight times, and single faults of sensors up to 450 times. Files of arms may have
# invented inertias. These are widened 40 times, and still predict well.
LARGEST_SCALE = 10.0


def mass_text(mass: float, std: float | None) -> str:
    """Return a mass in kg with its deviation, to the gram or to two digits of the deviation."""
    if not std:
        return f"{mass:.3f}"
    decimals = max(3, 1 - int(np.floor(np.log10(std))))
    return f"{mass:.{decimals}f} ± {std:.{decimals}f}"


@dataclass(frozen=True)
class RowSettings:
    """How the rows of an identification were made; options that do not apply are None.

    Attributes
    ----------
    filter : {"weak", "butterworth", "savitzky_golay"}
    window : float or None
        Length of the windows, s.
    cutoff : float or None
        Cutoff frequency of butterworth, Hz.
    channels : str or None
        Signals that butterworth filters.
    rate : float or None
        Rate of the log, Hz; None if it is unknown.
    """

    filter: Filter
    window: float | None = None
    cutoff: float | None = None
    channels: Channels | None = None
    rate: float | None = None


@dataclass(frozen=True)
class HoldOut:
    """Check on the end of the log, by a trial identification that left it out.

    Attributes
    ----------
    seconds : float
        Length of the end, s.
    percent_before, percent_after : float or None
        Error of the original model and of the trial's, percent of the measured torque; None if
        nothing was measured.
    advice : {"better", "equal", "worse", "mixed", "unfit", "none"}
        The trial's model compared with the original one, beyond chance; none if there was no trial.
    repeats : float
        Share of the end's postures and speeds that occurred earlier in the log.
    coordinates : dict of str to tuple of (float, float)
        RMS error before and after for each coordinate, Nm or N.
    summary : str
        The same as a sentence with figures.
    file_percents : dict of str to float
        Error of what each model file of the result holds, percent of the measured torque.
    """

    seconds: float
    percent_before: float | None
    percent_after: float | None
    advice: str
    repeats: float
    coordinates: dict[str, tuple[float, float]]
    summary: str
    file_percents: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Estimate:
    """The result of one identification.

    Attributes
    ----------
    method : str
        ``map_lmi``, ``map``, ``ols``, ``wls_r``, ``wls_c`` or ``wls_rc``.
    model : str
        Name of the robot model.
    names : tuple of str
        Parameter names, ``<link>/<m|mc_x|...|Izz>`` or ``<joint>/<viscous|...>``.
    units : tuple of str
        SI unit of each parameter.
    value, prior : (p,) float64
        Estimate and prior mean.
    std : (p,) float64 or None
        Standard deviation of the estimate; None if the method gives none.
    determined : (p,) bool or None
        Whether the data rather than the prior determine the value; None if the method gives none.
    rank : int or None
        Number of singular values used (z in the thesis); None without truncation.
    condition : float
        Ratio of the largest to the smallest singular value used, with columns scaled as in the
        method.
    samples : int
        Number of rows per coordinate.
    residual_rmse : dict of str to float
        Root mean square of the residual per coordinate (``base/moment_x`` ... ``base/force_z``,
        joint names), Nm or N.
    consistent : dict of str to bool
        Per link, whether its mass is positive and its pseudo-inertia positive definite.
    inputs : tuple of str
        Bags, model and prior as given by the user.
    software : str
        Name and version of the software.
    verdict : Verdict or None
        What the log determined; None for the truncated methods.
    known : dict of str to float
        Joint terms ``<joint>/<viscous|coulomb|armature>`` of the model file that were not
        identified; the equation of motion contains them.
    rows : RowSettings or None
        How the rows were made; None for windows of the verdict's length.
    model_file : str
        File of the result that has the kinematics of the user's file; empty if not saved.
    base : str
        Whether the robot's base is ``floating`` or ``fixed``; empty if not saved.
    row_std : dict of str to float
        Standard deviation of a row's residual for each coordinate, corrected for the fitted
        parameters, Nm or N; empty if the method gives no covariance.
    holdout : HoldOut or None
        Check on the end of the log; None if it was skipped.
    joint_terms : dict of str to tuple of str, or None
        The terms of each joint that the data asked for; its other terms in ``names`` are fixed.
        None if the user named the terms.
    remarks : tuple of str
        What the robot or the log leaves open about joint terms, one sentence each.
    wrist_sensors : tuple of str
        ``FRAME:LINK`` of each wrist force/torque sensor, with the first link beyond it; a minus
        before it marks a sensor that reads the wrench of the robot on the payload.
    load_reference : dict of str to float
        Parameters of links from which the load of joints follows, if their friction depends on it.
    courses : tuple of (int, int)
        First and last stamp, ns, of each part of the log during which friction changes.
    contacts : tuple of str
        ``FRAME`` or ``FRAME:point`` of each contact whose wrench was not measured.
    force_only : tuple of str
        ``FRAME:RADIUS`` of each foot sensor that measures forces alone, at the lowest point of a
        ball.
    end_stops : tuple of str
        Joints that leaned on the ends of their ranges, where their rows were left out.
    gravity : (3,) tuple of float, or None
        Gravity in the axes of a fixed base, m/s²; None for a floating base, and in files of
        earlier releases.
    held_joints : dict of str to float
        Joints that count as rigid because the log lacks them, and their positions, rad (m). Links
        beyond them are parts of the links that carry them.
    provenance : Provenance or None
        Checksums of the inputs, command, options, versions and date; None in files of earlier
        releases and for live estimates that are not saved.
    """

    method: str
    model: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: FloatArray
    prior: FloatArray
    std: FloatArray | None
    determined: BoolArray | None
    rank: int | None
    condition: float
    samples: int
    residual_rmse: dict[str, float]
    consistent: dict[str, bool]
    inputs: tuple[str, ...]
    software: str
    verdict: Verdict | None = None
    known: dict[str, float] = field(default_factory=dict)
    rows: RowSettings | None = None
    model_file: str = ""
    base: str = ""
    row_std: dict[str, float] = field(default_factory=dict)
    holdout: HoldOut | None = None
    joint_terms: dict[str, tuple[str, ...]] | None = None
    remarks: tuple[str, ...] = ()
    wrist_sensors: tuple[str, ...] = ()
    load_reference: dict[str, float] = field(default_factory=dict)
    courses: tuple[Course, ...] = ()
    contacts: tuple[str, ...] = ()
    force_only: tuple[str, ...] = ()
    end_stops: tuple[str, ...] = ()
    gravity: tuple[float, ...] | None = None
    held_joints: dict[str, float] = field(default_factory=dict)
    provenance: Provenance | None = None

    def parameters_of(self, model: RobotModel) -> ParameterSet:
        """Return the columns of a robot with the joint terms of this estimate."""
        parameters = ParameterSet.of_names(model, self.names, self.courses)
        parameters = parameters.with_known_values(self.known)
        if not self.load_reference:
            return parameters
        names = parameters.names[: parameters.inertial]
        reference = np.array([self.load_reference.get(name, 0.0) for name in names])
        return replace(parameters, reference=reference)

    @property
    def base_option(self) -> Base:
        """The base as a model is loaded with it; ``auto`` before it is saved."""
        return "floating" if self.base == "floating" else "fixed" if self.base else "auto"

    @property
    def is_floating(self) -> bool:
        """Whether the base moves; before it is saved, whether its forces have rows."""
        if self.base:
            return self.base == "floating"
        return any(name.startswith("base/") for name in self.residual_rmse)

    @property
    def impossible_links(self) -> tuple[str, ...]:
        """Links whose inertia no body has."""
        return tuple(link for link, is_possible in self.consistent.items() if not is_possible)

    @property
    def predicts_better(self) -> bool:
        """Whether predictions improve and err little, and no alarm is about what spoils them too.

        The others are about what the model leaves over, and about factors of efforts that are
        identified. With faults of sensors, predictions of a log with the same fault improve.
        """
        verdict, holdout = self.verdict, self.holdout
        if verdict is None or holdout is None or holdout.advice != "better":
            return False
        if holdout.percent_after is not None and holdout.percent_after > LARGEST_ERROR:
            return False
        if verdict.unexplained and verdict.unexplained[0].share > LARGE:
            return False
        if self.doubt:
            return False
        spared = [Alarm.WIDENED_PRIOR, Alarm.HEAVY_LINK, Alarm.COLOURED]
        if verdict.describe_drive_gains():
            spared.append(Alarm.WRONG_FACTORS)
        return all(any(kind in alarm for kind in spared) for alarm in verdict.alarms)

    @property
    def doubt(self) -> str:
        """Why other logs may be predicted badly, although this one is predicted better; or empty.

        The data held out have the same faults of sensors as the rest of the log.
        """
        scale = 1.0 if self.verdict is None else self.verdict.prior_scale
        if not self.is_floating or scale <= LARGEST_SCALE:
            return ""
        return f"the data widened the prior {scale:.0f} times"

    @property
    def fixed(self) -> frozenset[str]:
        """Names of the joint terms that were not identified because the data do not need them."""
        if self.joint_terms is None:
            return frozenset()
        chosen = {f"{joint}/{term}" for joint, terms in self.joint_terms.items() for term in terms}
        joints = set(self.joint_terms)
        return frozenset(
            name
            for name in self.names
            if name.rpartition("/")[0] in joints
            and name.rpartition("/")[2] in TERMS
            and name not in chosen
        )

    @property
    def identified(self) -> int:
        """Number of parameters that were identified: all that are not fixed."""
        return len(self.names) - len(self.fixed)

    def describe_determined(self) -> str:
        """Return how many parameter combinations and single parameters the data determine."""
        combinations = None if self.verdict is None else len(self.verdict.directions)
        single = 0 if self.determined is None else int(np.sum(self.determined))
        return describe_determined(combinations, single, self.identified)

    def describe_terms(self) -> str:
        """Return the chosen joint terms as one line; empty if the user named the terms."""
        if self.joint_terms is None:
            return ""
        count = len(self.joint_terms)
        parts = []
        for term in TERMS:
            joints = [joint for joint, terms in self.joint_terms.items() if term in terms]
            others = [joint for joint in self.joint_terms if joint not in joints]
            if not joints:
                continue
            if not others:
                where = "all joints" if count > 1 else joints[0]
            elif len(others) < len(joints):
                where = f"all joints except {', '.join(others)}"
            else:
                where = ", ".join(joints)
            parts.append(f"{term} ({where})")
        # A ripple has two columns, of one label.
        labels = dict.fromkeys(
            f"{joint}: {match[1]}"
            for joint, terms in self.joint_terms.items()
            for term in terms
            if (match := RIPPLE_TERM.fullmatch(term))
        )
        if labels:
            parts.append(f"ripple (periods a turn of {', '.join(labels)})")
        for term in WARMING_TERMS:
            joints = [joint for (joint, kind), _ in self._changes.items() if kind == term]
            if joints:
                parts.append(f"change of {term} during the log ({', '.join(joints)})")
        return ", ".join(parts) or "none"

    @property
    def _changes(self) -> dict[tuple[str, str], int]:
        """The first change of friction until the end of the log, by joint and term."""
        found: dict[tuple[str, str], int] = {}
        for index, name in enumerate(self.names):
            joint, _, term = name.rpartition("/")
            if match := WARMING_TERM.fullmatch(term):
                found.setdefault((joint, match[1]), index)
        return found

    def describe_warming(self) -> tuple[str, ...]:
        """Return lines with friction that changes, at the start and at the end of the log."""
        lines = []
        for (joint, term), index in self._changes.items():
            name = f"{joint}/{term}"
            last = float(self.value[self.names.index(name)]) if name in self.names else 0.0
            change = float(self.value[index])
            std = "" if self.std is None else f" ± {self.std[index]:.2g}"
            lines.append(
                f"{term} friction of {joint} changes by {-change:.3g}{std} {self.units[index]} "
                f"during the log, from {last + change:.3g} to {last:.3g}"
            )
        return tuple(lines)

    def describe_payloads(self) -> tuple[str, ...]:
        """Return lines with the payload behind each wrist sensor and the sensor's offset."""
        place = {name: index for index, name in enumerate(self.names)}
        lines = []
        for sensor in self.wrist_sensors:
            frame, _, link = sensor.removeprefix("-").partition(":")
            first = place[f"{link}/m"]
            mass, com, inertia = com_from_phi(self.value[first : first + 10])
            text = mass_text(mass, None if self.std is None else float(self.std[first]))
            largest = float(np.abs(inertia).max())
            decimals = 6 if largest == 0 else max(0, 4 - int(np.floor(np.log10(largest))))
            products = ", ".join(f"{one:.{decimals}f}" for one in inertia[np.triu_indices(3)])
            force, moment = (
                ", ".join(
                    f"{self.value[place[f'{frame}/offset_{kind}_{axis}']]:.3g}" for axis in "xyz"
                )
                for kind in ("force", "moment")
            )
            lines += [
                f"beyond {frame}: {text} kg, centre of mass "
                f"({', '.join(f'{1e3 * one:.1f}' for one in com)}) mm from the sensor, axes of "
                f"{link}",
                f"  inertia about it xx, xy, xz, yy, yz, zz: {products} kg m²",
                f"  offset of the sensor: {force} N; {moment} Nm",
            ]
        return tuple(lines)
