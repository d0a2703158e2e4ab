"""Simulate the robot in real time and record its topics to a bag.

    ros2 launch symbid_ros simulate.launch.py scenario:=vibrating bag:=log
    ros2 launch symbid_ros simulate.launch.py command_source:=topic payload_mass:=2.0

Everything ends when the motion does, the bag is then complete, or when one of the nodes fails.
"""

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from symbid_ros.share import PACKAGE, config_file

# What is worth changing from the command line; the defaults stand in bridge.yaml alone.
BRIDGE_ARGUMENTS = {
    "scenario": "smooth, vibrating, squat, suspended or tare",
    "moves": "number of moves",
    "motion_seed": "draws the moves",
    "noise_seed": "draws the sensor noise",
    "ideal": "true: noise-free sensors, the same motion",
    "friction": "true: joints with friction and armature",
    "errors": "systematic errors: typical, or names with commas",
    "error_seed": "draws the systematic errors",
    "payload_link": "link that carries the payload; empty for the base",
    "payload_mass": "mass of the payload, kg; 0.0: none",
    "payload_time": "when in the motion it is fastened, s",
    "command_source": "who commands the drives: internal, topic (balance_controller is started as "
    "well) or udp (symbid udp-client is one who can)",
    "udp_host": "address on which datagrams are received",
    "udp_port": "port on which datagrams are received",
    "real_time_factor": "simulated seconds per second",
}
# The controller must play what the bridge has set up.
CONTROLLER_ARGUMENTS = ("scenario", "moves", "motion_seed")


def generate_launch_description() -> LaunchDescription:
    bridge_file, recorder_file = config_file("bridge.yaml"), config_file("recorder.yaml")
    defaults = yaml.safe_load(bridge_file.read_text())["/**"]["ros__parameters"]

    arguments = [
        DeclareLaunchArgument(name, default_value=str(defaults[name]), description=description)
        for name, description in BRIDGE_ARGUMENTS.items()
    ]
    arguments += [
        DeclareLaunchArgument(
            "payload_position",
            default_value=str(defaults["payload_position"]),
            description="centre of the payload in the link's frame, m: three numbers with "
            "decimal points",
        ),
        DeclareLaunchArgument("record", default_value="true", description="write a bag"),
        DeclareLaunchArgument(
            "bag", default_value="", description="folder of the new bag; default: log_<date>-<time>"
        ),
    ]
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(defaults[name]))
        for name in BRIDGE_ARGUMENTS
    }
    overrides = given | {
        # Launch reads a parameter without a type as YAML.
        "payload_position": ParameterValue(LaunchConfiguration("payload_position")),
        # Without a recorder nobody may ever subscribe, and the robot would wait for it.
        "wait_for_subscribers": ParameterValue(LaunchConfiguration("record"), value_type=bool),
    }
    bridge = Node(
        package=PACKAGE,
        executable="mujoco_bridge",
        parameters=[str(bridge_file), overrides],
        output="screen",
        on_exit=Shutdown(reason="the motion has ended"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    controller = Node(
        package=PACKAGE,
        executable="balance_controller",
        parameters=[
            str(config_file("balance_controller.yaml")),
            {name: given[name] for name in CONTROLLER_ARGUMENTS},
        ],
        output="screen",
        condition=IfCondition(EqualsSubstitution(LaunchConfiguration("command_source"), "topic")),
        on_exit=Shutdown(reason="the controller has ended, for which the bridge would wait"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    recorder = Node(
        package=PACKAGE,
        executable="recorder",
        parameters=[
            str(recorder_file),
            {"bag": ParameterValue(LaunchConfiguration("bag"), value_type=str)},
        ],
        output="screen",
        condition=IfCondition(LaunchConfiguration("record")),
        on_exit=Shutdown(reason="the recorder has ended, for which the bridge would wait"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    return LaunchDescription([*arguments, recorder, controller, bridge])
