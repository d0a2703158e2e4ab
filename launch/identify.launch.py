"""Identify a robot from its topics while it runs, or from a bag.

    ros2 launch symbid_ros identify.launch.py model:=robot.urdf monitor:=true
    ros2 launch symbid_ros identify.launch.py model:=robot.urdf bag:=log out:=result

Without a model, the identifier waits for `robot_description`. The estimate stays on latched topics
until Ctrl-C. Online, `ros2 service call /identifier/save std_srvs/srv/Trigger` writes the current
estimate to `out`. `ros2 launch symbid_ros identify.launch.py --show-args` lists all arguments.
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from symbid_ros.package_paths import PACKAGE
from symbid_ros.ros.launch_arguments import launch_arguments, node_arguments


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in launch_arguments("identifier", "monitor")
    ]
    arguments += [
        DeclareLaunchArgument("use_sim_time", default_value="false", description="follow /clock"),
        DeclareLaunchArgument("monitor", default_value="false", description="print each estimate"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Action]:
    given = context.launch_configurations
    monitor = Node(
        package=PACKAGE,
        executable="monitor",
        namespace=given["namespace"],
        arguments=node_arguments("monitor", given),
        output="screen",
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
        condition=IfCondition(LaunchConfiguration("monitor")),
    )
    identifier = Node(
        package=PACKAGE,
        executable="identifier",
        namespace=given["namespace"],
        arguments=node_arguments("identifier", given),
        output="screen",
        # The monitor would wait for it. Other nodes may belong to the robot and keep running.
        on_exit=EmitEvent(event=ShutdownProcess(process_matcher=matches_action(monitor))),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    return [identifier, monitor]
