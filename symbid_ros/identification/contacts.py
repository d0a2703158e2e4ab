"""The robot as options say it is: its mounting, wrist sensors and contacts."""

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors

# Range of the total mass, relative to the model file's, in which contacts are plausible.
PLAUSIBLE_MASS = 0.4, 2.5


def with_robot_options(robot: RobotModel, options: RobotOptions) -> RobotModel:
    """Return a robot divided at its wrist sensors, with unknown wrenches at its contacts.

    Raises
    ------
    ModelError
        When a frame or link is unknown, or the contacts explain any motion.
    OptionError
        When the direction of gravity is given for a floating base.
    """
    robot = robot.with_gravity(options.gravity)
    return with_contacts(with_wrist_sensors(robot, options.wrist_sensors), options.contacts)


def contact_alarms(model: RobotModel, before: FloatArray, after: FloatArray) -> tuple[str, ...]:
    """Return an alarm if the total mass of a robot with unmeasured contacts is implausible.

    Without wrench sensors nothing else reveals a contact that was not named, or a flag that says
    "lifted" while the foot carries weight. The efforts then imply another mass.

    Parameters
    ----------
    model : RobotModel
    before, after : (L,) float64
        Masses of the links in the model file and as identified, kg.
    """
    if model.contacts is None or not model.floating:
        return ()
    least, most = (bound * before.sum() for bound in PLAUSIBLE_MASS)
    if least < after.sum() < most:
        return ()
    return (
        f"{Alarm.TOTAL_MASS} {before.sum():.3g} kg in the model file to {after.sum():.3g} "
        f"kg: name every contact in `contact`, leave flags out that are wrong (`contact_flag`), or "
        "check signs and units of the efforts",
    )
