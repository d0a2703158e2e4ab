"""Identify a robot from a bag and keep the estimate on latched topics.

ros2 launch symbid_ros identify.launch.py bag:=log model:=robot.urdf validate:=validation
"""

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from symbid_ros.share import PACKAGE, config_file

# What a robot or a bag decides; the other defaults stand in identifier.yaml alone.
PATH_ARGUMENTS = {
    "prior": "prior.json; default: the model's own inertias",
    "validate": "bag on which to choose the number of singular values",
    "out": "folder for estimate.json, model.urdf and model.xml",
}
CHOICE_ARGUMENTS = {
    "method": "ols, wls_r, wls_c or wls_rc",
    "cutoff": "low-pass cutoff in Hz; 0 filters nothing",
    "friction": "identify joint friction as well",
    "rank": "number of singular values; 0: choose it on the validation bag",
}


def generate_launch_description() -> LaunchDescription:
    file = config_file("identifier.yaml")
    defaults = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    arguments = [
        DeclareLaunchArgument("bag", description="bag to identify from"),
        DeclareLaunchArgument("model", description="robot model, URDF or MJCF"),
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value="", description=description)
        for name, description in PATH_ARGUMENTS.items()
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value=str(defaults[name]), description=description)
        for name, description in CHOICE_ARGUMENTS.items()
    ]
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(defaults.get(name, "")))
        for name in ("model", *PATH_ARGUMENTS, *CHOICE_ARGUMENTS)
    }
    # The node takes a list of bags; launch reads a parameter without a type as YAML.
    given["bag"] = ParameterValue(["['", LaunchConfiguration("bag"), "']"])
    identifier = Node(
        package=PACKAGE, executable="identifier", parameters=[str(file), given], output="screen"
    )
    return LaunchDescription([*arguments, identifier])
