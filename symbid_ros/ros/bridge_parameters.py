"""Parameters of the node mujoco_bridge, and the simulator and payload that they define."""

from pathlib import Path

from symbid_ros.package_paths import config_file
from symbid_ros.ros.parameters import Parameter, Values, options_from, parameters_of
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator, simulator_of

INTERNAL, TOPIC, UDP = "internal", "topic", "udp"

PARAMETERS = (
    *parameters_of(SimulateOptions),
    Parameter("model", "", "MJCF file of the robot; empty: the package's Symbitron."),
    Parameter(
        "command_source",
        INTERNAL,
        "Source of the drive commands: the scenario's own controller (internal), joint_command "
        "(topic), or UDP datagrams (udp).",
        choices=(INTERNAL, TOPIC, UDP),
    ),
    Parameter(
        "command_timeout",
        0.1,
        "Longest wait for a command before the drives apply safe torques, s of real time.",
        minimum=0.001,
        maximum=60.0,
    ),
    Parameter("udp_host", "127.0.0.1", "Address on which datagrams are received."),
    Parameter(
        "udp_port",
        5005,
        "Port on which datagrams are received; 0: any free port, shown on /diagnostics.",
        minimum=0,
        maximum=65535,
    ),
    Parameter(
        "udp_reply_port",
        0,
        "Port to which measurements are sent; 0: the port from which commands come.",
        minimum=0,
        maximum=65535,
    ),
    Parameter(
        "real_time_factor",
        1.0,
        "Simulated seconds per second, if the machine and the controller are fast enough.",
        minimum=0.01,
        maximum=100.0,
    ),
    Parameter(
        "clock_rate",
        100.0,
        "/clock messages per simulated second; 0: none.",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "ground_truth_rate",
        100.0,
        "Messages per simulated second on each ground_truth/ topic; 0: none.",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter("queue_depth", 5000, "Messages kept for a slow subscriber.", minimum=1),
    Parameter(
        "wait_for_subscribers",
        False,
        "Start when every sensor topic has its subscribers, so that no message is lost.",
    ),
    Parameter(
        "subscribers",
        1,
        "Number of subscribers that each sensor topic needs before the start.",
        minimum=1,
        maximum=100,
    ),
)


def robot_name(values: Values) -> str:
    """Return the robot's name in diagnostics: that of its model file."""
    return (model_path(values) or config_file("symbitron.xml")).stem


def simulator_from(values: Values) -> Simulator:
    """Return a simulator at the start of the motion and without payload."""
    return simulator_of(
        options_from(SimulateOptions, values),
        model=model_path(values),
        is_commanded=values["command_source"] != INTERNAL,
    )


def model_path(values: Values) -> Path | None:
    """Return the MJCF of the robot; None for the package's own."""
    return Path(values["model"]) if values["model"] else None
