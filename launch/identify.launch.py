"""Identify a robot from a bag and keep the estimate on latched topics.

ros2 launch symbid_ros identify.launch.py bag:=log model:=robot.urdf out:=result
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
    "prior": "prior.json; default: the model's own values",
    "information": "information.npz of an earlier run, to add its data",
    "validate": "bag on which truncated methods choose the number of singular values",
    "out": "folder for the estimate and the models",
}
CHOICE_ARGUMENTS = {
    "method": "map_lmi, map, ols, wls_r, wls_c or wls_rc",
    "total_mass": "what the whole robot weighs, kg; 0: unknown",
    "sensor_errors": "sensor errors to identify: typical, or names with commas between",
    "friction": "identify joint friction as well",
    "armature": "identify the drives' inertias as well",
    "filter": "weak, butterworth or savitzky_golay",
    "cutoff": "of the Butterworth filter, Hz; 0: no filter",
    "rank": "number of singular values of truncated methods; 0: chosen by the data",
}


def generate_launch_description() -> LaunchDescription:
    file = config_file("identifier.yaml")
    defaults = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    arguments = [
        DeclareLaunchArgument("bag", description="bag to identify from"),
        DeclareLaunchArgument("model", description="robot model, URDF or MJCF"),
        DeclareLaunchArgument(
            "tare", default_value="", description="bag with nothing touching the wrench sensors"
        ),
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
    # The node takes lists of bags; launch reads a parameter without a type as YAML.
    for name in ("bag", "tare"):
        given[name] = ParameterValue(["['", LaunchConfiguration(name), "']"])
    identifier = Node(
        package=PACKAGE, executable="identifier", parameters=[str(file), given], output="screen"
    )
    return LaunchDescription([*arguments, identifier])
