"""Simulate the robot in real time and record its topics to a bag.

    ros2 launch symbid_ros simulate.launch.py scenario:=vibrating bag:=log

Everything ends when the motion does; the bag is then complete.
"""

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
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
    "real_time_factor": "simulated seconds per second",
}


def generate_launch_description() -> LaunchDescription:
    bridge_file, recorder_file = config_file("bridge.yaml"), config_file("recorder.yaml")
    defaults = yaml.safe_load(bridge_file.read_text())["/**"]["ros__parameters"]

    arguments = [
        DeclareLaunchArgument(name, default_value=str(defaults[name]), description=description)
        for name, description in BRIDGE_ARGUMENTS.items()
    ]
    arguments += [
        DeclareLaunchArgument("record", default_value="true", description="write a bag"),
        DeclareLaunchArgument(
            "bag", default_value="", description="folder of the new bag; default: log_<date>-<time>"
        ),
    ]
    overrides = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(defaults[name]))
        for name in BRIDGE_ARGUMENTS
    }
    # Without a recorder nobody may ever subscribe, and the robot would wait for it.
    overrides["wait_for_subscribers"] = ParameterValue(
        LaunchConfiguration("record"), value_type=bool
    )
    bridge = Node(
        package=PACKAGE,
        executable="mujoco_bridge",
        parameters=[str(bridge_file), overrides],
        output="screen",
        on_exit=Shutdown(reason="the motion has ended"),
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
    )
    return LaunchDescription([*arguments, recorder, bridge])
