"""Codes of errors, stable over releases, each with its cause and its fix.

The documentation lists them; tests bind to them rather than to the wording of a message.
"""

from typing import NamedTuple


class Entry(NamedTuple):
    """What a code means.

    Attributes
    ----------
    cause, fix : str
        One sentence each, for the documentation.
    """

    cause: str
    fix: str


CODES: dict[str, Entry] = {
    # E1xx: robot models
    # E2xx: bags and messages
    # E3xx: measurements
    # E4xx: priors and estimates
    # E5xx: options and their combinations
    # E6xx: simulation
    # E7xx: studies and reports
    # E8xx: ROS nodes
    "E801": Entry(
        "A topic has a message type that is not installed on this machine.",
        "Install the package of the message type, or leave the topic out.",
    ),
    "E802": Entry(
        "A launch argument or node parameter has an invalid value.",
        "Give a value of the type and range that the message states.",
    ),
    "E803": Entry(
        "A node parameter is required but empty.", "Give the parameter that the message names."
    ),
    "E804": Entry(
        "Two node parameters contradict each other.",
        "Change one of the parameters that the message names.",
    ),
    "E805": Entry(
        "A publishing rate does not divide the rate of the simulation.",
        "Give the rate of the simulation divided by a whole number.",
    ),
    "E806": Entry(
        "The start of a replay lies beyond the end of the bag.", "Give a smaller `start`."
    ),
    "E807": Entry(
        "No topic of the bag is left to replay.",
        "Name topics of the bag in `topics`, or fewer in `exclude`.",
    ),
    "E808": Entry(
        "A reliable subscriber has received nothing for a minute and blocks a lossless replay.",
        "Stop that subscriber, or set `rate` and `lossless:=false`.",
    ),
    "E809": Entry(
        "The recorder received no message.", "Check the names of the topics and `ROS_DOMAIN_ID`."
    ),
    "E810": Entry(
        "Writing a bag failed, and recorded messages are missing.",
        "Fix the disk problem that the message names and record again.",
    ),
    "E811": Entry(
        "A recorded message is too short for its type.",
        "Repair the bag with `symbid bag recover` and replay the result.",
    ),
    "E812": Entry(
        "The monitor received no estimate within its timeout.",
        "Check that the identifier runs, its name and `ROS_DOMAIN_ID`.",
    ),
    "E813": Entry(
        "The identifier stopped before its first estimate.",
        "Fix what the message names, such as a missing topic, and run longer.",
    ),
    "E814": Entry(
        "The identifier has not found its sensor topics yet.",
        "Start the robot's drivers, or correct the topic parameters.",
    ),
    "E815": Entry("The data so far are too few for an estimate.", "Wait, or let the robot move."),
    "E816": Entry(
        "Joint states lack a joint of the model, or a position or velocity.",
        "Publish all joints with positions and velocities, or choose another model.",
    ),
    "E817": Entry(
        "Feedback for the controller holds NaN, infinite or impossible values.",
        "Check the drivers of `joint_states` and `imu/data`.",
    ),
    "E818": Entry(
        "A command for the simulated robot is invalid and is ignored.",
        "Send commands as the page on ROS describes; it lists the reasons.",
    ),
    "E819": Entry(
        "The bytes of a message do not match its type.", "Check the publisher of the topic."
    ),
}
