"""Parameters of the node mujoco_bridge, and the simulator and payload that they define."""

from pathlib import Path

from symbid_ros.package_paths import config_file
from symbid_ros.ros.parameters import Parameter, Values
from symbid_ros.simulation.body_inertia import Payload, link_index
from symbid_ros.simulation.plant import load_model
from symbid_ros.simulation.simulator import Simulator

INTERNAL, TOPIC, UDP = "internal", "topic", "udp"

PARAMETERS = (
    Parameter(
        "scenario",
        "smooth",
        "Motion of the robot; with an external controller, its initial posture.",
        choices=("smooth", "squat", "vibrating", "suspended", "tare"),
    ),
    Parameter(
        "moves",
        20,
        "Number of moves of the centre of mass or the hook; tare has none.",
        minimum=1,
        maximum=100_000,
    ),
    Parameter("motion_seed", 0, "Random seed of the moves.", minimum=0),
    Parameter("noise_seed", 0, "Random seed of the sensor noise.", minimum=0),
    Parameter("ideal", False, "Publish noise-free sensor data; the motion stays the same."),
    Parameter("friction", False, "Give the joints the friction and armature of friction.yaml."),
    Parameter("friction_file", "", "YAML file to use instead of friction.yaml; implies friction."),
    Parameter("errors", "", "Systematic errors: typical, or a comma-separated list; empty: none."),
    Parameter("error_seed", 0, "Random seed of the systematic errors.", minimum=0),
    Parameter("model", "", "MJCF file of the robot; empty: the package's Symbitron."),
    Parameter("noise", "", "YAML file of sensor noise; empty: the package's noise.yaml."),
    Parameter("payload_link", "", "Link that carries the payload; empty: the base.", live=True),
    Parameter(
        "payload_mass",
        0.0,
        "Mass of the payload, kg; 0: none. A change while the robot moves takes effect at once.",
        minimum=0.0,
        maximum=100.0,
        live=True,
    ),
    Parameter(
        "payload_position",
        [0.0, 0.0, 0.0],
        "Centre of the payload in the link's frame, m.",
        minimum=-2.0,
        maximum=2.0,
        live=True,
    ),
    Parameter(
        "payload_time",
        0.0,
        "Time in the motion at which a payload given at the start is attached, s.",
        minimum=0.0,
    ),
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
    return (_path(values["model"]) or config_file("symbitron.xml")).stem


def simulator_from(values: Values) -> Simulator:
    """Return a simulator at the start of the motion and without payload."""
    return Simulator(
        values["scenario"],
        moves=values["moves"],
        motion_seed=values["motion_seed"],
        noise_seed=values["noise_seed"],
        ideal=values["ideal"],
        friction=values["friction"],
        errors=values["errors"],
        error_seed=values["error_seed"],
        model_path=_path(values["model"]),
        noise_path=_path(values["noise"]),
        friction_path=_path(values["friction_file"]),
        is_commanded=values["command_source"] != INTERNAL,
    )


class PayloadParameters:
    """Converts the payload parameters of one robot.

    Parameters
    ----------
    values : mapping
        Values of the node's parameters; only the path of the model is used.
    """

    def __init__(self, values: Values) -> None:
        self._model = load_model(_path(values["model"]) or config_file("symbitron.xml"))
        self._base = str(self._model.body(self._model.jnt_bodyid[0]).name)

    def payload(self, values: Values) -> Payload | None:
        """Return the payload; None if its mass is 0.

        Raises
        ------
        SimulationError
            When the robot has no such link, even if the mass is 0.
        """
        link = values["payload_link"] or self._base
        link_index(self._model, link)
        if not values["payload_mass"]:
            return None
        x, y, z = values["payload_position"]
        return Payload(link, values["payload_mass"], (x, y, z))


def _path(value: str) -> Path | None:
    return Path(value) if value else None
