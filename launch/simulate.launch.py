"""Simulate the robot in real time and record its topics to a bag.

    ros2 launch symbid_ros simulate.launch.py scenario:=vibrating recorder_bag:=log
    ros2 launch symbid_ros simulate.launch.py command_source:=topic payload_mass:=2.0

All nodes end when the motion ends, with a complete bag, or when one of them fails. If another robot
already publishes /clock, give `namespace:=robot2 clock:=false`.
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from symbid_ros.package_paths import PACKAGE
from symbid_ros.ros.launch_arguments import launch_arguments, node_arguments

TRUE = ("true", "True", "1")


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in launch_arguments(
            "mujoco_bridge", "balance_controller", "recorder"
        )
    ]
    arguments += [
        DeclareLaunchArgument("record", default_value="true", description="write a bag"),
        DeclareLaunchArgument("clock", default_value="true", description="publish /clock"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Action]:
    given = context.launch_configurations
    # Without a recorder there may be no subscriber to wait for.
    preset = {"wait_for_subscribers": given["record"] in TRUE}
    no_clock = {} if given["clock"] in TRUE else {"clock_rate": 0.0}
    bridge = Node(
        package=PACKAGE,
        executable="mujoco_bridge",
        namespace=given["namespace"],
        arguments=node_arguments("mujoco_bridge", given, preset, **no_clock),
        output="screen",
        on_exit=Shutdown(reason="the motion has ended"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    controller = Node(
        package=PACKAGE,
        executable="balance_controller",
        namespace=given["namespace"],
        arguments=node_arguments("balance_controller", given),
        output="screen",
        condition=IfCondition(EqualsSubstitution(LaunchConfiguration("command_source"), "topic")),
        on_exit=Shutdown(reason="the controller, which the bridge waits for, has ended"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    recorder = Node(
        package=PACKAGE,
        executable="recorder",
        namespace=given["namespace"],
        arguments=node_arguments("recorder", given),
        output="screen",
        condition=IfCondition(LaunchConfiguration("record")),
        on_exit=Shutdown(reason="the recorder, which the bridge waits for, has ended"),
        sigterm_timeout="10",  # a busy machine may need longer than launch's 5 s
        sigkill_timeout="10",
    )
    return [recorder, controller, bridge]
