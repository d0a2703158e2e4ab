"""The robot as options say it is: its mounting, wrist sensors and contacts."""

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors

# Share by which a model file's total mass may err, and standard deviations of the total mass as
# identified that chance explains.
PLAUSIBLE_ERROR, CHANCE = 0.25, 3.0


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
    return with_contacts(with_wrist_sensors(robot, options.wrist_sensors), options.contacts)


def contact_alarms(
    model: RobotModel, before: FloatArray, after: FloatArray, std: float
) -> tuple[str, ...]:
    """Return an alarm if the total mass of a robot with unmeasured contacts is implausible.

    Without wrench sensors nothing else reveals a contact that was not named, a flag that says
    "lifted" while the foot carries weight, or a common factor of all efforts. The efforts then
    imply another mass.

    Parameters
    ----------
    model : RobotModel
    before, after : (L,) float64
        Masses of the links in the model file and as identified, kg.
    std : float
        Standard deviation of the total mass, kg.
    """
    if model.contacts is None or not model.floating:
        return ()
    change = abs(after.sum() - before.sum())
    if change <= max(PLAUSIBLE_ERROR * before.sum(), CHANCE * std):
        return ()
    return (
        f"{Alarm.TOTAL_MASS} {before.sum():.3g} kg in the model file to {after.sum():.3g} "
        "kg: weigh the robot, and give `total_mass`; if it weighs what the file says, all efforts "
        "have a wrong scale in common, which no residual shows, some have a wrong sign or unit, a "
        "contact is missing in `contact`, or a flag is wrong (`contact_flag`)",
    )
