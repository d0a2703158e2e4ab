"""The robot as options say it is: its mounting, wrist sensors and contacts."""

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.common_scale import is_plausible_mass, load_cause
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors

# Standard deviations of the total mass as identified that chance explains.
CHANCE = 3.0


def with_robot_options(robot: RobotModel, options: RobotOptions) -> RobotModel:
    """Return a robot divided at its wrist sensors, with unknown wrenches at its contacts.

    Raises
    ------
    ModelError
        When a frame or link is unknown, the contacts explain any motion, or a foot whose sensor
        measures forces alone is no ball.
    OptionError
        When the direction of gravity is given for a floating base.
    """
    robot = robot.with_gravity(options.gravity).with_force_only(options.force_only_sensors)
    robot = robot.with_end_stops(options.end_stop_joints)
    return with_contacts(with_wrist_sensors(robot, options.wrist_sensors), options.contacts)


def total_mass_alarms(
    model: RobotModel, before: FloatArray, after: FloatArray, std: float
) -> tuple[str, ...]:
    """Return an alarm if the total mass of a robot with a floating base is implausible.

    With wrench sensors nothing else reveals a support that carries a part of the weight, as the
    links adapt to it. Without them nothing else reveals a contact that was not named, a flag that
    says "lifted" while the foot carries weight, or a common factor of all efforts.

    Parameters
    ----------
    model : RobotModel
    before, after : (L,) float64
        Masses of the links in the model file and as identified, kg.
    std : float
        Standard deviation of the total mass, kg.
    """
    if not model.floating:
        return ()
    change = float(after.sum() - before.sum())
    is_chance = abs(change) <= CHANCE * std
    if is_chance or not before.sum() or is_plausible_mass(float(after.sum() / before.sum())):
        return ()
    start = (
        f"{Alarm.TOTAL_MASS} {before.sum():.3g} kg in the model file to {after.sum():.3g} "
        "kg: weigh the robot, and give `total_mass`; if it weighs what the file says,"
    )
    if model.contacts is not None:
        return (
            f"{start} all efforts have a wrong scale in common, which no residual shows, some have "
            "a wrong sign or unit, a contact is missing in `contact`, or a flag is wrong "
            "(`contact_flag`)",
        )
    return (f"{start} {load_cause(change)}",)
