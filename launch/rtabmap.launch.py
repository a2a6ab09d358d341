"""ros2 launch dyfn_ros rtabmap.launch.py image:=/camera/image_rect odometry:=/odom

A map by RTAB-Map from one camera: stream_depth, rgbd_sync and rtabmap. docs/recipes/rtabmap.md
says what the camera and tf must be. The arguments of stream_depth.launch.py are arguments of this
file.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("dyfn_ros")
RECIPES = PathJoinSubstitution([SHARE, "config", "recipes"])


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, default, text in (
            (
                "params_file",
                PathJoinSubstitution([RECIPES, "stream_depth_rtabmap.yaml"]),
                "Parameter file of stream_depth.",
            ),
            (
                "rtabmap_params_file",
                PathJoinSubstitution([RECIPES, "rtabmap.yaml"]),
                "Parameter file of rgbd_sync and rtabmap.",
            ),
            ("namespace", "", "Namespace of all nodes."),
        )
    ]
    depth = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([SHARE, "launch", "stream_depth.launch.py"])
        )
    )
    common = {
        "namespace": LaunchConfiguration("namespace"),
        "parameters": [LaunchConfiguration("rtabmap_params_file")],
        "output": "screen",
    }
    sync = Node(
        package="rtabmap_sync",
        executable="rgbd_sync",
        name="rgbd_sync",
        remappings=[
            ("rgb/image", LaunchConfiguration("image")),
            ("depth/image", "stream_depth/depth/image"),
            ("rgb/camera_info", "stream_depth/depth/camera_info"),
        ],
        **common,
    )
    slam = Node(package="rtabmap_slam", executable="rtabmap", name="rtabmap", **common)
    return LaunchDescription([*declared, depth, sync, slam])
