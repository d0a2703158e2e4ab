"""Replay a bag in its own time and identify the robot as if it were running.

    ros2 launch symbid_ros replay.launch.py bag:=log model:=robot.urdf rate:=2.0 monitor:=true

Every argument of identify.launch.py may be given as well. The estimate stays on latched topics
until Ctrl-C; everything ends when a node fails.
"""

import yaml
from launch import Action, LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from symbid_ros.share import PACKAGE, config_file, share_directory

# What is worth changing from the command line; the defaults stand in player.yaml alone.
PLAYER_ARGUMENTS = {
    "rate": "seconds of the bag per second; 0.0: as fast as it is taken",
    "loop": "true: begin again at the end",
    "start": "where in the bag to begin, s",
    "duration": "how much to replay, s of the bag; 0.0: to its end",
}


def generate_launch_description() -> LaunchDescription:
    file = config_file("player.yaml")
    defaults = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    arguments = [
        DeclareLaunchArgument("bag", description="bag to replay"),
        DeclareLaunchArgument("model", description="robot model, URDF or MJCF"),
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value=str(defaults[name]), description=description)
        for name, description in PLAYER_ARGUMENTS.items()
    ]
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(defaults[name]))
        for name in PLAYER_ARGUMENTS
    }
    # The node takes a list of bags; launch reads a parameter without a type as YAML.
    given["bag"] = ParameterValue(["['", LaunchConfiguration("bag"), "']"])
    player = Node(
        package=PACKAGE,
        executable="player",
        parameters=[str(file), given, {"publish_clock": True}],
        output="screen",
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    identify = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share_directory() / "launch" / "identify.launch.py")),
        launch_arguments={
            "model": LaunchConfiguration("model"),  # required there, so launch wants it said
            "bag": "",  # the identifier is to follow the topics, not to read the bag itself
            "use_sim_time": "true",
        }.items(),
    )
    # In a group of its own, lest the player lose its bag.
    failure = RegisterEventHandler(OnProcessExit(on_exit=_end_after_failure))
    return LaunchDescription([*arguments, failure, player, GroupAction([identify])])


def _end_after_failure(event: ProcessExited, _: LaunchContext) -> list[Action]:
    """Shut down when a node fails: the others would wait for it."""
    return [Shutdown(reason=f"{event.process_name} failed")] if event.returncode else []
