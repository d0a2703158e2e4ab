"""Replay a bag at its recorded rate and identify the robot as if it were running.

    ros2 launch symbid_ros replay.launch.py bag:=log model:=robot.urdf rate:=2.0 monitor:=true

All arguments of identify.launch.py are accepted as well. The estimate stays on latched topics until
Ctrl-C. All nodes end when one of them fails. If another robot already publishes /clock, give
`namespace:=robot2 clock:=false`.
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from symbid_ros.package_paths import PACKAGE, share_directory
from symbid_ros.ros.launch_arguments import launch_arguments, node_arguments


def generate_launch_description() -> LaunchDescription:
    # Here the bag is required, and publish_clock is called clock.
    arguments = [DeclareLaunchArgument("bag", description="bag to replay")]
    arguments += [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in launch_arguments("player")
        if name not in ("bag", "publish_clock")
    ]
    arguments += [
        DeclareLaunchArgument("clock", default_value="true", description="publish /clock"),
        DeclareLaunchArgument("use_sim_time", default_value="true", description="follow /clock"),
    ]
    identify = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share_directory() / "launch" / "identify.launch.py")),
        launch_arguments={
            "bag": "",  # the identifier reads the topics instead
            "use_sim_time": LaunchConfiguration("use_sim_time"),
        }.items(),
    )
    failure = RegisterEventHandler(OnProcessExit(on_exit=_end_after_failure))
    # The group limits the empty bag to the identifier.
    return LaunchDescription(
        [*arguments, failure, OpaqueFunction(function=_player), GroupAction([identify])]
    )


def _player(context: LaunchContext) -> list[Action]:
    given = context.launch_configurations
    # The player publishes /clock, so it must not wait for it.
    own = {name: text for name, text in given.items() if name != "use_sim_time"}
    player = Node(
        package=PACKAGE,
        executable="player",
        namespace=given["namespace"],
        arguments=node_arguments(
            "player", own | {"publish_clock": given["clock"]}, {"wait_for_subscribers": True}
        ),
        output="screen",
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    return [player]


def _end_after_failure(event: ProcessExited, _: LaunchContext) -> list[Action]:
    """Shut down when a node fails, because the others would wait for it."""
    return [Shutdown(reason=f"{event.process_name} failed")] if event.returncode else []
