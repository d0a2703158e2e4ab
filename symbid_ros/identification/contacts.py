"""The robot with the wrist sensors and contacts that options name."""

from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.identification.contact_options import ContactOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors


def with_contact_options(robot: RobotModel, options: ContactOptions) -> RobotModel:
    """Return a robot divided at its wrist sensors, with unknown wrenches at its contacts.

    Raises
    ------
    ModelError
        When a frame or link is unknown, or the contacts explain any motion.
    """
    return with_contacts(with_wrist_sensors(robot, options.wrist_sensors), options.contacts)
