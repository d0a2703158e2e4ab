"""Verdicts on wrenches and efforts from given gains, on either side of each limit."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.common_scale import KGF, ScaleEvidence
from symbid_ros.diagnosis.effort_findings import (
    SignConversions,
    _similar_groups,
    effort_findings,
)
from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.forces import (
    _is_known,
    _median_gain,
    _reference_gain,
    _wrench_findings,
    check_forces,
    reversed_imu_finding,
)
from symbid_ros.diagnosis.gain_problem import GainEstimate
from symbid_ros.diagnosis.gain_rows import GainLayout
from symbid_ros.diagnosis.rotation_fit import RotationFit

IDENTITY = np.eye(3)
QUARTER = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
# Far from every rotation and from its reverse.
ODD = np.diag([1.0, 0.0, 1.0])
STD = 1e-2


@dataclass
class Robot:
    """Gains of a robot on two feet with four driven joints, as the estimate would be."""

    wrenches: list = field(default_factory=lambda: [IDENTITY, IDENTITY])
    efforts: list = field(default_factory=lambda: [1.0] * 4)
    left: float = 0.01  # of the weight, with gains of one
    left_reversed: float = 2.0  # of the weight, with all wrenches reversed
    floating: bool = True
    loaded: tuple = (True, True)
    driven: int = 4
    std: float = STD
    carried: float = 500.0
    mass_ratio: float = 1.0
    density: float = 500.0
    suspect: tuple = ("", 0.0)

    def verdict(self):
        frames = ("left", "right")
        names = ("a", "b", "c", "d")[: self.driven]
        layout = GainLayout(frames, ("imu",) * self.floating, tuple(range(self.driven)), names)
        mean = np.zeros(len(layout))
        for index, matrix in enumerate(self.wrenches):
            mean[layout.wrench(index)] = (matrix - IDENTITY).ravel()
        mean[layout.efforts] = np.array(self.efforts[: self.driven]) - 1
        covariance = self.std**2 * np.eye(len(mean))
        before, backwards = 500.0 * self.left, 500.0 * self.left_reversed
        gains = GainEstimate(layout, mean, covariance, np.zeros(0), before, 5.0, backwards)
        gains = replace(gains, mass_ratio=self.mass_ratio)
        statistics = SimpleNamespace(
            model=SimpleNamespace(floating=self.floating, gravity=np.array([0.0, 0.0, -10.0])),
            weight=500.0,
            carried=self.carried,
            scale_evidence=ScaleEvidence(self.density),
            effort_limits={},
            wrench_noise=(0.0, 0.0),
            unloaded=SimpleNamespace(suspect_force=lambda: self.suspect),
            efforts=[1.0],
            is_loaded=np.array(self.loaded),
            mean_forces=np.array([[0.0, 0, 250], [10, 0, 240]]),
        )
        topics = {"left": "/left", "right": "/right"}
        return check_forces(statistics, gains, "/joints", ("/imu",), topics)

    @property
    def kinds(self):
        return [(one.kind, one.stream) for one in self.verdict().findings]


def test_gains_of_one_are_clean():
    verdict = Robot().verdict()
    assert (verdict.findings, verdict.blamed, verdict.left_out) == ((), "", ())
    figures = verdict.figures
    assert figures["gain"] == pytest.approx(1)
    assert figures["weight_left"] == pytest.approx(0.01)
    assert figures["weight_left_with_gains"] == pytest.approx(0.01)
    assert figures["left/gain"] == pytest.approx(1)
    assert figures["right/angle_deg"] == pytest.approx(0)
    assert (figures["a/effort_gain"], figures["d/effort_gain_std"]) == (1.0, STD)
    assert "weight_left" not in Robot(floating=False).verdict().figures


@pytest.mark.parametrize(
    ("robot", "kinds"),
    [
        (Robot([-IDENTITY, IDENTITY]), [(Kind.WRENCH_SIGN, "/left")]),
        (Robot([IDENTITY, QUARTER]), [(Kind.WRENCH_FRAME, "/right")]),
        (Robot([0.5 * IDENTITY, IDENTITY]), [(Kind.WRENCH_GAIN, "/left")]),
        (Robot(efforts=[-1.0, 1, 1, 1]), [(Kind.TORQUE_SIGN, "/joints")]),
        (Robot(efforts=[0.5, 1, 1, 1]), [(Kind.TORQUE_GAIN, "/joints")]),
        (
            Robot([-IDENTITY, IDENTITY], [0.5, 1, 1, 1]),
            [(Kind.WRENCH_SIGN, "/left"), (Kind.TORQUE_GAIN, "/joints")],
        ),
        # Three faults of several kinds are one contradiction, of one kind they are three.
        (Robot([-IDENTITY, QUARTER], [0.5, 1, 1, 1]), [(Kind.CONTRADICTION, "")]),
        (
            Robot([0.5 * IDENTITY, QUARTER], [-1, 0.5, 1, 1]),
            [(Kind.CONTRADICTION, "")],
        ),
        (Robot(efforts=[0.5, 0.3, 0.1, 1]), [(Kind.TORQUE_GAIN, "/joints")] * 3),
    ],
)
def test_faults_are_named(robot, kinds):
    assert robot.kinds == kinds
    assert robot.verdict().blamed == kinds[0][0].value


def test_reversed_gravity_is_the_imus_fault():
    """All forces and efforts look reversed."""
    robot = Robot([-IDENTITY, -IDENTITY], [-1.0, -1, -1, -1], left=2.0)
    assert robot.kinds == [(Kind.IMU_MOUNTING, "/imu")]
    (finding,) = robot.verdict().findings
    assert finding.figures == {"gain": -1.0}
    assert reversed_imu_finding(["/a", "/b"]).stream == ""
    # One wrench that is also rotated a little does not balance it, but all together do.
    tilted = Robot([-IDENTITY, -ODD], [-1.0] * 4, left=2.0, left_reversed=0.05)
    assert tilted.kinds == [(Kind.IMU_MOUNTING, "/imu")]
    # One that is not, or none at all, is another fault.
    for other in (
        Robot([-IDENTITY, IDENTITY], [-1.0] * 4),
        Robot([-IDENTITY, -IDENTITY], [-1.0, -1, -1, 1]),
        Robot([-IDENTITY, -IDENTITY], driven=0),
        Robot(efforts=[-1.0] * 4, loaded=(False, False)),
        Robot([-IDENTITY, -ODD], [-1.0] * 4),
        Robot([-IDENTITY, -IDENTITY], [-1.0] * 4, floating=False),
    ):
        assert (Kind.IMU_MOUNTING, "/imu") not in other.kinds


@pytest.mark.parametrize(
    ("carried", "density", "times", "says"),
    [
        (0.5, 5e5, 1e3, "weighs 50 kg, the wrenches (frames: left, right) carry 0.05 kg"),
        (5e4, 5.0, 1e-2, "were 100 times too small"),
        (5.0, 2e3, None, "as if the masses in the model were 100 times too large or forces were"),
        (
            5e5,
            500.0,
            None,
            "they carry 50000 kg and the model weighs 50 kg, as if forces were in mN",
        ),
        (200.0, 5e5, None, "record the wrench of every contact"),
        (0.0, 500.0, None, "record the wrench of every contact"),
    ],
)
def test_wrenches_that_weigh_another_robot_doubt_its_masses(carried, density, times, says):
    robot = Robot(left=0.99, loaded=(False, False), carried=carried, density=density)
    (finding,) = robot.verdict().findings
    assert finding.kind is Kind.WEIGHT
    assert says in finding.message
    assert ("record the wrench" in finding.message) == (times is None)
    assert finding.figures.get("masses_times") == (None if times is None else pytest.approx(times))


@pytest.mark.parametrize(
    ("share", "says"),
    [
        (0.74, "carry 37 kg, 0.74 times the 50 kg of the model: weigh the robot"),
        (0.74, "a support without a sensor, such as a crane"),
        (0.76, None),
        (1.32, None),
        (1.34, "carry 67 kg, 1.34 times the 50 kg of the model"),
        (1.34, "it carried a payload"),
    ],
)
def test_wrenches_that_carry_another_mass_alone_are_named(share, says):
    """A factor that all gains have in common is no fault of a single sensor."""
    verdict = Robot(left=abs(1 - share), mass_ratio=share).verdict()
    if says is None:
        assert not verdict.findings
        return
    (finding,) = verdict.findings
    assert (finding.kind, finding.severity) == (Kind.WEIGHT, Severity.WARNING)
    assert says in finding.message
    assert finding.figures == {"mass_ratio": share}
    assert verdict.figures["mass_ratio"] == share


def test_the_fault_of_a_sensor_explains_what_the_wrenches_carry():
    robot = Robot([0.5 * IDENTITY, IDENTITY], mass_ratio=0.7)
    assert robot.kinds == [(Kind.WRENCH_GAIN, "/left")]


@pytest.mark.parametrize(("share", "is_named"), [(0.74, True), (0.76, False)])
def test_a_crane_may_explain_a_contradiction(share, is_named):
    (finding,) = Robot([-IDENTITY, QUARTER], [0.5, 1, 1, 1], mass_ratio=share).verdict().findings
    assert finding.kind is Kind.CONTRADICTION
    assert ("such as a crane, carried the rest" in finding.message) == is_named


@pytest.mark.parametrize("carried", [300.0, 400.0])
def test_a_crane_may_explain_weight_that_is_missing(carried):
    (finding,) = Robot([ODD, IDENTITY], left=0.9, carried=carried).verdict().findings
    assert f"they carry {carried / 10:.0f} kg of 50 kg" in finding.message
    assert ("such as a crane" in finding.message) == (carried == 300.0)


@pytest.mark.parametrize("unit", [KGF, 1e-3])
def test_wrenches_in_another_unit_are_to_be_multiplied(unit):
    found = Robot([unit * IDENTITY, IDENTITY]).verdict().findings
    assert [one.kind for one in found] == [Kind.WRENCH_GAIN]
    assert f"multiply its forces and torques by {unit:.3g}" in found[0].message


@pytest.mark.parametrize("left", [0.34, 0.36, 0.9])
@pytest.mark.parametrize(
    ("robot", "is_explained"),
    [
        (Robot(), True),
        (Robot([ODD, IDENTITY]), False),
        (Robot(loaded=(False, False)), False),
        (Robot([0.41 * IDENTITY] * 2, [0.41] * 4), True),
        (Robot([0.39 * IDENTITY] * 2, [0.39] * 4), False),
        (Robot([2.45 * IDENTITY] * 2, [2.45] * 4), True),
        (Robot([2.55 * IDENTITY] * 2, [2.55] * 4), False),
        (Robot([ODD, IDENTITY], floating=False), True),
    ],
)
def test_a_weight_that_no_gain_explains_is_reported(robot, is_explained, left):
    robot.left = left
    found = [kind for kind, _ in robot.kinds if kind is Kind.WEIGHT]
    assert len(found) == (left > 0.35 and not is_explained)
    if found:
        (finding,) = robot.verdict().findings
        assert finding.figures == {"weight_left": pytest.approx(left), "weight_n": 500.0}
        assert f"{100 * left:.0f} % of 500 N" in finding.message
        assert robot.verdict().blamed == Kind.WEIGHT.value


def test_wrenches_without_effort_have_no_scale_to_compare_with():
    unknown = Robot([0.5 * IDENTITY, IDENTITY], std=0.5, efforts=[0.0] * 4)
    verdict = Robot([1e-1 * IDENTITY, -IDENTITY], driven=0).verdict()
    assert [one.kind for one in verdict.findings] == [Kind.WRENCH_GAIN, Kind.WRENCH_SIGN]
    assert verdict.left_out == ()
    assert unknown.verdict().left_out == (
        "gains of the wrench sensors: no effort is known well enough to compare them with",
    )
    assert Robot(driven=1, std=0.5, floating=False, loaded=(False, False)).verdict().left_out == ()
    assert unknown.verdict().findings == ()


@pytest.mark.parametrize("first", [-1.5, -0.9])
def test_joints_that_are_reversed_together_are_all_named(first):
    """A log that determines no gain, or that of one joint alone, shows the sign of all."""
    efforts = [first, -0.9, -0.9, -0.9]
    robot = Robot(efforts=efforts, std=0.32, floating=False, loaded=(False, False))
    (finding,) = robot.verdict().findings
    assert set(finding.figures) == {"a/gain", "b/gain", "c/gain", "d/gain"}
    assert "effort of all joints has the wrong sign; give" in finding.message


def test_a_joint_that_is_reversed_alone_does_not_stand_for_the_others():
    efforts = [-5.0, 0.1, 0.1, 0.1]
    robot = Robot(efforts=efforts, std=0.32, floating=False, loaded=(False, False))
    (finding,) = robot.verdict().findings
    assert set(finding.figures) == {"a/gain"}


@pytest.mark.parametrize("common", [0.39, 0.41, 2.45, 2.55])
def test_gains_that_all_vanish_explain_nothing(common):
    """A fault is one of its sensor only while the others are near the model."""
    robot = Robot([common * IDENTITY] * 2, [common, common, common, -common])
    is_near = 0.4 <= common <= 2.5
    assert robot.kinds == [(Kind.TORQUE_SIGN, "/joints") if is_near else (Kind.CONTRADICTION, "")]


def test_a_contradiction_names_the_foot_that_alone_is_never_in_the_air():
    gains = [0.3 * IDENTITY] * 2, [0.3] * 4
    (usual,) = Robot(*gains).verdict().findings
    (found,) = Robot(*gains, suspect=("right", 15.0)).verdict().findings
    assert found.kind == usual.kind == Kind.CONTRADICTION
    assert "; /right never reads less than 15 N" in found.message
    assert "never reads" not in usual.message


@pytest.mark.parametrize(
    ("gain", "std", "is_known"),
    [
        (1.0, 0.33, True),
        (1.0, 0.34, False),
        (-3.0, 0.99, True),
        (0.1, 0.16, True),
        (0, 0.17, False),
    ],
)
def test_a_gain_is_known_to_three_deviations(gain, std, is_known):
    assert _is_known(gain, std) is is_known


def fits(*scales):
    return {i: RotationFit(1, np.eye(3), 0.0, scale, 0.0, 0.0) for i, scale in enumerate(scales)}


UNKNOWN = {"x": (0.5, 2.0)}  # gain of a joint whose load the log does not show


def known(*gains):
    return {str(i): (gain, 0.01) for i, gain in enumerate(gains)}


@pytest.mark.parametrize(
    ("wrenches", "efforts", "median", "reference"),
    [
        ((), (), 1, 1),
        ((2.0,), (3.0,), 1, 1),
        ((2.0,), (1.5, -1.8), 1.8, 1.8),
        ((2.0, 2.0), (2.6,), 2.0, 2.0),
        ((2.6, 2.6), (2.6,), 2.6, 1),  # not explained: compared with the model
        ((0.39, 0.39), (0.39,), 0.39, 1),
        ((0.41, 0.41), (0.41,), 0.41, 0.41),
        ((2.45, 2.45), (2.45,), 2.45, 2.45),
        ((1.5, 1.5), (1.0, 1.0, 1.0), 1.0, 1.0),  # alike: the median of all
        ((1.7, 1.7), (1.0, 1.0, 1.0), 1.0, 1.0),  # efforts are nearer
        ((1.1, 1.1), (2.0, 2.0, 2.0), 2.0, 1.1),  # wrenches are nearer
        ((100.0, 100.0), (9.0, 9.0, 9.0), 9.0, 2.5),
        ((0.01, 0.01), (0.1, 0.1, 0.1), 0.1, 0.4),
        ((1.0, 1.0), (0.7, 0.7, 0.7), 0.7, 0.7),
        ((1.0, 1.0), (0.62, 0.62, 0.62), 0.62, 1.0),
    ],
)
def test_medians_and_reference_gains(wrenches, efforts, median, reference):
    assert _median_gain(fits(*wrenches), known(*efforts)) == pytest.approx(median)
    assert _reference_gain(fits(*wrenches), known(*efforts)) == pytest.approx(reference)


@pytest.mark.parametrize(
    ("turn", "common", "kinds"),
    [
        (RotationFit(1, IDENTITY, 0.0, 1.0, 0, 0), 1.0, []),
        (RotationFit(-1, IDENTITY, 0.0, 1.0, 5, 31), 1.0, [Kind.WRENCH_SIGN]),
        (RotationFit(-1, IDENTITY, 0.0, 1.0, 5, 29), 1.0, []),
        (RotationFit(1, QUARTER, np.radians(5.1), 1.0, 5, 31), 1.0, [Kind.WRENCH_FRAME]),
        (RotationFit(1, QUARTER, np.radians(5.1), 1.0, 5, 29), 1.0, []),
        (RotationFit(1, QUARTER, np.radians(4.9), 1.0, 5, 90), 1.0, []),
        (RotationFit(-1, QUARTER, 1.0, 1.0, 5, 90), 1.0, [Kind.WRENCH_SIGN]),
        (RotationFit(1, IDENTITY, 0.0, 1 / 1.59, 0, 0), 1.0, []),
        (RotationFit(1, IDENTITY, 0.0, 1 / 1.61, 0, 0), 1.0, [Kind.WRENCH_GAIN]),
        (RotationFit(1, IDENTITY, 0.0, 1 / 0.61, 0, 0), 1.0, []),
        (RotationFit(1, IDENTITY, 0.0, 1 / 0.59, 0, 0), 1.0, [Kind.WRENCH_GAIN]),
        (RotationFit(1, IDENTITY, 0.0, 1.0, 0, 0), 2.0, [Kind.WRENCH_GAIN]),
        (RotationFit(-1, IDENTITY, 0.0, 4.0, 0, 90), 2.0, [Kind.WRENCH_SIGN, Kind.WRENCH_GAIN]),
    ],
)
def test_a_wrench_is_judged_by_sign_frame_and_gain(turn, common, kinds):
    found = list(_wrench_findings("/left", "left", turn, common))
    assert [one.kind for one in found] == kinds
    for one in found:
        expected = {
            Kind.WRENCH_SIGN: {
                "gain": turn.sign * turn.scale / common,
                "evidence": turn.plain - turn.cost,
            },
            Kind.WRENCH_FRAME: {
                "angle_deg": np.degrees(turn.angle),
                "evidence": turn.plain - turn.cost,
            },
            Kind.WRENCH_GAIN: {"reads": common / turn.scale},
        }[one.kind]
        assert one.figures == pytest.approx(expected)
        says = {
            Kind.WRENCH_SIGN: f"(gain {turn.sign * turn.scale / common:.2f} relative",
            Kind.WRENCH_FRAME: f"rotated by {np.degrees(turn.angle):.0f} degrees from left",
            Kind.WRENCH_GAIN: f"/left: reads {common / turn.scale:.3g} times",
        }[one.kind]
        assert says in one.message
        is_gain = one.kind is Kind.WRENCH_GAIN
        assert one.severity is (Severity.WARNING if is_gain else Severity.UNUSABLE)


@pytest.mark.parametrize(
    ("efforts", "common", "expected"),
    [
        ([(1, 0.1), (1, 0.1)], 1.0, []),
        ([(-0.31, 0.33), (1, 0.1)], 1.0, [(Kind.TORQUE_SIGN, ["0/gain"])]),
        ([(-120.0, 0.34), (1, 0.1)], 1.0, []),
        ([(-1.6, 0.01)], 2.0, [(Kind.TORQUE_SIGN, ["0/gain"])]),
        ([(1 / 1.59, 0.01)], 1.0, []),
        ([(1 / 1.61, 0.01)], 1.0, [(Kind.TORQUE_GAIN, ["0"])]),
        ([(1 / 0.61, 0.01)], 1.0, []),
        ([(1 / 0.59, 0.01)], 1.0, [(Kind.TORQUE_GAIN, ["0"])]),
        ([(0.5, 0.17)], 1.0, []),
        ([(0.5, 0.16)], 1.0, [(Kind.TORQUE_GAIN, ["0"])]),
        ([(2.0, 0.01)], 2.0, []),
        (
            [(0.5, 0.01), (0.2, 0.01), (0.19, 0.01)],
            1.0,
            [(Kind.TORQUE_GAIN, ["0"]), (Kind.TORQUE_GAIN, ["1", "2"])],
        ),
    ],
)
def test_efforts_are_judged_by_sign_and_gain(efforts, common, expected):
    gains = {str(i): each for i, each in enumerate(efforts)}
    found = list(effort_findings("/joints", gains, common))
    assert [one.kind for one in found] == [kind for kind, _ in expected]
    for one, (kind, names) in zip(found, expected, strict=True):
        if kind is Kind.TORQUE_SIGN:
            assert list(one.figures) == names
            assert one.figures["0/gain"] == pytest.approx(gains["0"][0] / common)
            continue
        reads = [common / max(gains[name][0], 1e-4 * common) for name in names]
        assert one.figures["reads"] == pytest.approx(np.median(reads))
        for name, each in zip(names, reads, strict=True):
            assert one.figures[f"{name}/reads"] == pytest.approx(each)


def test_all_joints_are_named_together_from_three_on():
    (signs,) = effort_findings("/joints", known(-1, -1, -1), 1.0)
    assert "effort of all joints has the wrong sign; give" in signs.message
    (more,) = effort_findings("/joints", known(-1, -1, -1), 1.0, UNKNOWN)
    assert "effort of all joints has" in more.message
    assert 'effort_scale: ["0:=-1", "1:=-1", "2:=-1", "x:=-1"]' in more.message
    assert set(more.figures) == {"0/gain", "1/gain", "2/gain", "x/gain"}
    (two,) = effort_findings("/joints", known(-1, -1), 1.0)
    assert "effort of 0, 1 has" in two.message
    (part,) = effort_findings("/joints", known(-1, -1, -1, 1), 1.0)
    assert "effort of 0, 1, 2 has the wrong sign (gain -1.00" in part.message
    (gains,) = effort_findings("/joints", known(0.1, 0.1, 0.1), 1.0)
    assert "effort of all joints reads 10 times" in gains.message
    (pair,) = effort_findings("/joints", known(0.1, 0.1), 1.0)
    assert "effort of 0, 1 reads 10 times" in pair.message


def test_the_line_for_a_robot_file_names_every_joint_with_its_number():
    """It replaces the line of another finding, and of joints that show no load of their own."""
    found = list(effort_findings("/joints", known(0.1, 5.0, 1.0), 1.0, UNKNOWN))
    assert len(found) == 2
    for one in found:
        assert 'write effort_scale: ["0:=0.1", "1:=5"] in robot.yaml' in one.message
        assert "give `drive_gain` 0,1 to identify" in one.message
    (every,) = effort_findings("/joints", known(1e-3, 1.3e-3, 0.9e-3), 1.0, UNKNOWN)
    assert 'effort_scale: ["0:=0.001", "1:=0.0013", "2:=0.0009", "x:=0.001"]' in every.message
    assert "give `drive_gain` all to" in every.message


def test_efforts_without_their_load_have_no_factor():
    """Unless all others have the same wrong unit, which is theirs as well."""
    hidden = {"x": 0.04}
    (found,) = effort_findings("/joints", known(1.0, 1.0, 1.0), 1.0, UNKNOWN, hidden=hidden)
    assert found.figures == {"x/load_share": 0.04}
    assert "effort of x does not show the load" in found.message
    assert "explains 4 % of the effort" in found.message
    (unit,) = effort_findings("/joints", known(1e-3, 1e-3, 1e-3), 1.0, UNKNOWN, hidden=hidden)
    assert '"x:=0.001"' in unit.message


def test_an_unseen_joint_gets_no_factor_beyond_its_limit():
    gains = known(5.0, 6.0, 7.0)
    for rms, factor in ((1.0, 6), (20.0, 2)):
        limits = {"x": (rms, 40.0)}
        (found,) = effort_findings("/joints", gains, 1.0, UNKNOWN, limits=limits)
        assert f'"x:={factor}"' in found.message


def test_unlike_factors_without_a_right_one_are_those_of_currents():
    """Factors of the named joints alone would take the others' currents for torques."""
    found = list(effort_findings("/joints", known(6.4, 3.6, 3.8), 1.0, UNKNOWN))
    assert len(found) == 2
    for one in found:
        assert "give `drive_gain` all to identify" in one.message
        assert "effort_scale" not in one.message


def test_advice_about_signs_builds_on_the_conversions_that_are_given():
    """A user who reversed an effort by mistake is not told to reverse it once more."""
    given = SignConversions({"0": -1.0, "1": 0.11}, frozenset({"left"}))
    (found,) = effort_findings("/joints", known(-1, -1), 1.0, conversions=given)
    assert 'effort_scale: ["0:=1", "1:=-0.11"] in robot.yaml instead of 0:=-1, 1:=0.11' in (
        found.message
    )
    (wrong,) = effort_findings("/joints", known(1.0, 0.1), 1.0, conversions=given)
    assert '["1:=0.011"] in robot.yaml instead of 1:=0.11' in wrong.message
    (plain,) = effort_findings("/joints", known(-1, 1), 1.0)
    assert plain.message.endswith('effort_scale: ["0:=-1"] in robot.yaml')
    turn = RotationFit(-1, IDENTITY, 0.0, 1.0, 0, 90)
    (wrench,) = _wrench_findings("/left", "left", turn, 1.0, conversions=given)
    assert "remove left from `flip_wrench`" in wrench.message


def test_similar_errors_are_one_group():
    reads = {"a": 4.0, "b": 2.0, "c": 3.1, "d": 6.0, "e": 0.1, "f": 6.5}
    assert list(_similar_groups(reads)) == [["e"], ["b", "c"], ["a", "d"], ["f"]]
    assert list(_similar_groups({})) == []
