# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Play a recording into ba_node: `ros2 launch ba_node replay.launch.py bag:=stereo_loop.mcap rate:=2`.

Ends when all has been played and refined.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

PASSED_ON = ("namespace", "params_file", "autostart", "log_level")
# For the last solve.
SETTLE_S = 3.0


def generate_launch_description() -> LaunchDescription:
    """Describe the node, and `ba play` that waits for it."""
    share = FindPackageShare("ba_node")
    defaults = {
        "namespace": "",
        "params_file": PathJoinSubstitution([share, "config", "ba_node.yaml"]),
        "autostart": "true",
        "log_level": "info",
    }
    namespace = LaunchConfiguration("namespace")
    play = ExecuteProcess(
        cmd=[
            ExecutableInPackage(package="ba_node", executable="ba"),
            *("play", PathJoinSubstitution([share, "bags", LaunchConfiguration("bag")])),
            *("--rate", LaunchConfiguration("rate"), "--namespace", namespace),
        ],
        output="screen",
    )
    end = [TimerAction(period=SETTLE_S, actions=[EmitEvent(event=Shutdown(reason="all has been played"))])]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "bag",
                default_value="stereo_loop.mcap",
                description="recording: a full path, or the name of one that comes with the package",
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="times real time; 0: as fast as possible"),
            *(DeclareLaunchArgument(name, default_value=defaults[name]) for name in PASSED_ON),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "ba_node.launch.py"])),
                launch_arguments={name: LaunchConfiguration(name) for name in PASSED_ON}.items(),
            ),
            play,
            RegisterEventHandler(OnProcessExit(target_action=play, on_exit=end)),
        ]
    )
