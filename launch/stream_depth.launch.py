"""ros2 launch dyfn_ros stream_depth.launch.py image:=/camera/image_raw [rviz:=true frame:=camera]

One camera; may be included by other launch files. For an installation with ROS launch; without
it, run `stream_depth --ros-args -r image:=...`.
"""

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare("dyfn_ros"), "config"])
ARGUMENTS = {
    "image": ("image", "Topic of the colour images; the compressed one is beside it."),
    "camera_info": ("camera_info", "Topic of their CameraInfo."),
    "odometry": ("odometry", "Topic of the robot's motion, with metric_source: odometry."),
    "reference": ("reference", "Topic of measured distances, with metric_source: reference."),
    "namespace": ("", "Namespace of the node."),
    "model": ("", "Bundled model's name, checkpoint file, or Hub id; empty: the file's."),
    "autostart": ("", "false: leave the states to a manager; empty: as the file says."),
    "use_sim_time": ("", "true: take the time from /clock; empty: as the file says."),
    "rviz": ("false", "Start RViz with image, depth and cloud."),
    "frame": ("camera", "RViz: the images' frame_id, or a frame that tf connects with it."),
}

INPUTS = ("image", "camera_info", "odometry", "reference")
PARAMETERS = ("model", "autostart", "use_sim_time")  # before what the parameter file says
SHOWN = ("stream_depth/depth/image", "stream_depth/points")  # by stream_depth.rviz


def node(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    values = {name: value for name, value in given.items() if value}
    for name in values:
        if name != "model":
            values[name] = yaml.safe_load(values[name])
    return [
        Node(
            package="dyfn_ros",
            executable="stream_depth",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *([values] if values else [])],
            remappings=[(name, LaunchConfiguration(name)) for name in INPUTS],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    params_file = DeclareLaunchArgument(
        "params_file",
        default_value=PathJoinSubstitution([CONFIG, "stream_depth.yaml"]),
        description="The node's parameter file: config/cameras and config/recipes have some.",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),  # relative names are then the node's
        arguments=[
            *("-d", PathJoinSubstitution([CONFIG, "stream_depth.rviz"])),
            *("-f", LaunchConfiguration("frame")),
        ],
        remappings=[
            ("/camera/image_raw", LaunchConfiguration("image")),
            *((f"/{topic}", topic) for topic in SHOWN),
        ],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*declared, params_file, OpaqueFunction(function=node), rviz])
