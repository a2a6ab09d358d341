"""ros2 launch dyfn_ros laserscan.launch.py image:=/camera/image_raw odometry:=/odom

One camera as a laser scan: stream_depth, and depthimage_to_laserscan on its depth image.
docs/recipes/laserscan.md says what the camera and tf must be. The arguments of
stream_depth.launch.py are arguments of this file.
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
                PathJoinSubstitution([RECIPES, "stream_depth_laserscan.yaml"]),
                "Parameter file of stream_depth.",
            ),
            (
                "scan_params_file",
                PathJoinSubstitution([RECIPES, "depthimage_to_laserscan.yaml"]),
                "Parameter file of depthimage_to_laserscan.",
            ),
            ("namespace", "", "Namespace of both nodes."),
            ("scan", "scan", "Topic of the scan."),
        )
    ]
    depth = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([SHARE, "launch", "stream_depth.launch.py"])
        )
    )
    scan = Node(
        package="depthimage_to_laserscan",
        executable="depthimage_to_laserscan_node",
        name="depthimage_to_laserscan",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("scan_params_file")],
        remappings=[
            ("depth", "stream_depth/depth/image"),
            ("depth_camera_info", "stream_depth/depth/camera_info"),
            ("scan", LaunchConfiguration("scan")),
        ],
        output="screen",
    )
    return LaunchDescription([*declared, depth, scan])
