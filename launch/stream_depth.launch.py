"""ros2 launch dyfn_ros stream_depth.launch.py image:=/camera/image_raw [rviz:=true frame:=camera]

One camera; may be included by other launch files. For an installation with ROS launch; without
it, run `stream_depth --ros-args -r image:=...`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare("dyfn_ros"), "config"])
ARGUMENTS = {
    "image": ("image", "Topic of the colour images; the compressed one is beside it."),
    "camera_info": ("camera_info", "Topic of their CameraInfo."),
    "odometry": ("odometry", "Topic of the robot's motion, with metric_source: odometry."),
    "reference": ("reference", "Topic of measured distances, with metric_source: reference."),
    "namespace": ("", "Namespace of the node."),
    "model": ("dyfn-mini", "Bundled model's name, checkpoint file, or Hub id."),
    "autostart": ("true", "Configure and activate at start; false: leave it to a manager."),
    "use_sim_time": ("false", "Take the time from /clock."),
    "rviz": ("false", "Start RViz with image, depth and cloud."),
    "frame": ("camera", "RViz: the images' frame_id, or a frame that tf connects with it."),
}

INPUTS = ("image", "camera_info", "odometry", "reference")
SHOWN = ("stream_depth/depth/image", "stream_depth/points")  # by stream_depth.rviz


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    params_file = DeclareLaunchArgument(
        "params_file",
        default_value=PathJoinSubstitution([CONFIG, "stream_depth.yaml"]),
        description="Parameter file of the node; config/cameras has some for usual cameras.",
    )
    image = LaunchConfiguration("image")
    flags = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool)
        for name in ("autostart", "use_sim_time")
    }
    node = Node(
        package="dyfn_ros",
        executable="stream_depth",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params_file"),
            {"model": LaunchConfiguration("model"), **flags},
        ],
        remappings=[(name, LaunchConfiguration(name)) for name in INPUTS],
        output="screen",
    )
    view = PathJoinSubstitution([CONFIG, "stream_depth.rviz"])
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),  # relative names are then the node's
        arguments=["-d", view, "-f", LaunchConfiguration("frame")],
        remappings=[("/camera/image_raw", image), *((f"/{topic}", topic) for topic in SHOWN)],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*declared, params_file, node, rviz])
