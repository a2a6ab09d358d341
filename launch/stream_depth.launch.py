"""ros2 launch dyfn_ros stream_depth.launch.py image:=/camera/image_raw

For an installation with ROS launch; without it, run `stream_depth --ros-args -r image:=...`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "image": ("image", "Topic of the colour images; the compressed one is beside it."),
    "camera_info": ("camera_info", "Topic of their CameraInfo."),
    "namespace": ("", "Namespace of the node."),
    "model": ("dyfn-mini", "Bundled model's name, checkpoint file, or Hub id."),
}


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    params_file = DeclareLaunchArgument(
        "params_file",
        default_value=PathJoinSubstitution(
            [FindPackageShare("dyfn_ros"), "config", "stream_depth.yaml"]
        ),
        description="Parameter file of the node.",
    )
    image = LaunchConfiguration("image")
    node = Node(
        package="dyfn_ros",
        executable="stream_depth",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), {"model": LaunchConfiguration("model")}],
        remappings=[
            ("image", image),
            ("image/compressed", [image, "/compressed"]),
            ("camera_info", LaunchConfiguration("camera_info")),
        ],
        output="screen",
    )
    return LaunchDescription([*declared, params_file, node])
