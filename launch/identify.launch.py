"""Identify a robot: from its topics while it runs, or from a bag.

    ros2 launch symbid_ros identify.launch.py model:=robot.urdf monitor:=true
    ros2 launch symbid_ros identify.launch.py model:=robot.urdf bag:=log out:=result

Either way the estimate stays on latched topics until Ctrl-C; `ros2 service call
/identifier/save std_srvs/srv/Trigger` writes what a running robot has told.
"""

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from symbid_ros.share import PACKAGE, config_file

# What a robot or a bag decides; the other defaults stand in identifier.yaml alone.
IDENTIFIER_PATHS = {
    "prior": "prior.json; default: the model's own values",
    "information": "information.npz of an earlier run, to add its data to a bag's",
    "resume": "information.npz to go on from, online",
    "validate": "bag on which truncated methods choose the number of singular values",
    "joint_topic": "JointState topic; default: joint_states",
    "out": "folder for the estimate and the models",
}
IDENTIFIER_LISTS = {
    "bag": "bag to identify from; without one the robot's topics are followed",
    "tare": "bag with nothing touching the wrench sensors",
}
IDENTIFIER_TOPICS = {
    "imu_topics": "Imu topics as [one, other]; default: all",
    "wrench_topics": "WrenchStamped topics as [one, other]; default: all named wrench",
}
IDENTIFIER_ARGUMENTS = {
    "method": "map_lmi, map, ols, wls_r, wls_c or wls_rc",
    "prior_percent": "trust the model's values to ± this many %; 0.0: not given",
    "solve_period": "seconds between two estimates, online",
    "memory": "seconds in which data lose all but 1/e of their weight, online; 0.0: never",
    "total_mass": "what the whole robot weighs, kg; 0.0: unknown",
    "sensor_errors": "sensor errors to identify: typical, or names with commas between",
    "friction": "identify joint friction as well",
    "armature": "identify the drives' inertias as well",
    "filter": "weak, butterworth or savitzky_golay",
    "cutoff": "of the Butterworth filter, Hz; 0.0: no filter",
    "rank": "number of singular values of truncated methods; 0: chosen by the data",
}


def generate_launch_description() -> LaunchDescription:
    file = config_file("identifier.yaml")
    defaults = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    arguments = [DeclareLaunchArgument("model", description="robot model, URDF or MJCF")]
    arguments += [
        DeclareLaunchArgument(name, default_value="", description=description)
        for name, description in (IDENTIFIER_LISTS | IDENTIFIER_PATHS).items()
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value="['']", description=description)
        for name, description in IDENTIFIER_TOPICS.items()
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value=str(defaults[name]), description=description)
        for name, description in IDENTIFIER_ARGUMENTS.items()
    ]
    arguments += [
        DeclareLaunchArgument("use_sim_time", default_value="false", description="follow /clock"),
        DeclareLaunchArgument("monitor", default_value="false", description="print each estimate"),
        DeclareLaunchArgument("truth", default_value="", description="true model, for the monitor"),
    ]
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(defaults.get(name, "")))
        for name in ("model", *IDENTIFIER_PATHS, *IDENTIFIER_ARGUMENTS)
    }
    # The node takes lists; launch reads a parameter without a type as YAML.
    given |= {
        name: ParameterValue(["['", LaunchConfiguration(name), "']"]) for name in IDENTIFIER_LISTS
    }
    given |= {name: ParameterValue(LaunchConfiguration(name)) for name in IDENTIFIER_TOPICS}
    clock = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    truth = {"truth": ParameterValue(LaunchConfiguration("truth"), value_type=str)}
    monitor = Node(
        package=PACKAGE,
        executable="monitor",
        parameters=[truth],
        output="screen",
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
        condition=IfCondition(LaunchConfiguration("monitor")),
    )
    identifier = Node(
        package=PACKAGE,
        executable="identifier",
        name="identifier",
        parameters=[str(file), given | clock],
        output="screen",
        # Without it the monitor would wait. Other nodes may be a whole robot's: they go on.
        on_exit=EmitEvent(event=ShutdownProcess(process_matcher=matches_action(monitor))),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    return LaunchDescription([*arguments, identifier, monitor])
