"""Identify a robot from a bag and keep the estimate on latched topics.

ros2 launch symbid_ros identify.launch.py bag:=log model:=robot.urdf validate:=validation
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from symbid_ros.share import PACKAGE

# Name: (type, default or None for an argument that must be given, description).
ARGUMENTS = {
    "model": (str, None, "robot model, URDF or MJCF"),
    "prior": (str, "", "prior.json; default: the model's own inertias"),
    "method": (str, "wls_rc", "ols, wls_r, wls_c or wls_rc"),
    "cutoff": (float, "30.0", "low-pass cutoff in Hz; 0 filters nothing"),
    "friction": (bool, "false", "identify joint friction as well"),
    "rank": (int, "0", "number of singular values; 0: choose it on the validation bag"),
    "validate": (str, "", "bag on which to choose the number of singular values"),
    "out": (str, "", "folder for estimate.json, model.urdf and model.xml"),
}


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (_, default, description) in ARGUMENTS.items()
    ]
    arguments.append(DeclareLaunchArgument("bag", description="bag to identify from"))
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _, _) in ARGUMENTS.items()
    }
    # The node takes a list of bags; launch reads a parameter without a type as YAML.
    parameters["bag"] = ParameterValue(["['", LaunchConfiguration("bag"), "']"])
    identifier = Node(
        package=PACKAGE, executable="identifier", parameters=[parameters], output="screen"
    )
    return LaunchDescription([*arguments, identifier])
