# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track images and refine what comes of them: `ros2 launch ba_node front_end.launch.py mode:=stereo namespace:=robot`.

Images come from left/image_raw and right/image_raw, rgb/image_raw and depth/image_raw, or image_raw, with camera_info
beside them; `left:=/camera/infra1/image_raw` and so on name others, with the camera_info beside those.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PASSED_ON = ("namespace", "params_file", "use_sim_time", "autostart", "log_level")
TEXTS = {
    "mode": ("auto", "auto, stereo, rgbd or mono"),
    "rig_file": ("", "YAML of the cameras, in any form of ba rig, in place of camera_info"),
    "base_frame": ("", "body frame, to which /tf_static tells the way; empty: the first camera"),
    "odometry": ("none", "steps from elsewhere: none, topic (odometry) or tf"),
}
SWITCHES = {
    "rectified": ("false", "images are rectified: p of camera_info is their camera"),
    "publish_tf": ("true", "publish odom -> body"),
    "autostart": ("true", "configure and activate both nodes at start"),
    "use_sim_time": ("false", "take the time from /clock"),
}
TOPICS = {
    "left": ("left/image_raw", "left image"),
    "left_info": ("left/camera_info", "its camera"),
    "right": ("right/image_raw", "right image"),
    "right_info": ("right/camera_info", "its camera"),
    "rgb": ("rgb/image_raw", "colour image"),
    "rgb_info": ("rgb/camera_info", "its camera"),
    "depth": ("depth/image_raw", "depth image, registered to the colour image"),
    "image": ("image_raw", "image of one camera alone"),
    "image_info": ("camera_info", "its camera"),
}


def generate_launch_description() -> LaunchDescription:
    """Describe both nodes; all topics are relative to the namespace."""
    share = FindPackageShare("ba_node")
    listed = {**TEXTS, **SWITCHES, **TOPICS}
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "ba_node.yaml"]),
                description="YAML file with the parameters of ba_node",
            ),
            DeclareLaunchArgument(
                "front_end_params_file",
                default_value=PathJoinSubstitution([share, "config", "ba_front_end.yaml"]),
                description="YAML file with the parameters of ba_front_end, but for those that are arguments here",
            ),
            DeclareLaunchArgument("log_level", default_value="info", description="the least severity that is logged"),
            *(
                DeclareLaunchArgument(name, default_value=listed[name][0], description=listed[name][1])
                for name in listed
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "ba_node.launch.py"])),
                launch_arguments={name: LaunchConfiguration(name) for name in PASSED_ON}.items(),
            ),
            Node(
                package="ba_node",
                executable="ba_front_end",
                name="ba_front_end",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("front_end_params_file"),
                    {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in TEXTS},
                    {name: ParameterValue(LaunchConfiguration(name), value_type=bool) for name in SWITCHES},
                ],
                remappings=[(topic, LaunchConfiguration(name)) for name, (topic, _) in TOPICS.items()],
                arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
                output="screen",
                emulate_tty=True,
            ),
        ]
    )
