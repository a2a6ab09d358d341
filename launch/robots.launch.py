"""ros2 launch dyfn_ros robots.launch.py robots:='[alpha, beta]' image:=camera/image_raw

A node for each robot, in the robot's namespace. Topics without a leading slash are the robot's own:
`image:=camera/image_raw` is /alpha/camera/image_raw. So are tf and tf_static, as nav2 has it for
several robots: the frames of both may have the same names.
"""

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "robots": ("[alpha, beta]", "Namespaces of the robots, as a YAML list."),
    "image": ("camera/image_raw", "Topic of their colour images."),
    "camera_info": ("camera/camera_info", "Topic of their CameraInfos."),
    "odometry": ("odom", "Topic of their motion, with metric_source: odometry."),
    "model": ("", "Bundled model's name, checkpoint file, or Hub id; empty: the file's."),
    "rviz": ("false", "Start an RViz for each robot, with its image, depth and cloud."),
    "frame": ("camera", "RViz: a frame that the robot's tf connects with the images' frame_id."),
}
INPUTS = ("image", "camera_info", "odometry")
OWN_TF = [("/tf", "tf"), ("/tf_static", "tf_static")]
SHOWN = ("stream_depth/depth/image", "stream_depth/points")  # by stream_depth.rviz


def nodes(context: LaunchContext) -> list[Node]:
    robots = yaml.safe_load(LaunchConfiguration("robots").perform(context))
    model = LaunchConfiguration("model").perform(context)
    own = [{"model": model}] if model else []
    found = []
    for robot in (str(name) for name in robots):
        found.append(
            Node(
                package="dyfn_ros",
                executable="stream_depth",
                namespace=robot,
                parameters=[LaunchConfiguration("params_file"), *own],
                remappings=[*((name, LaunchConfiguration(name)) for name in INPUTS), *OWN_TF],
                output="screen",
            )
        )
        found.append(rviz(robot))
    return found


def rviz(robot: str) -> Node:
    view = PathJoinSubstitution([FindPackageShare("dyfn_ros"), "config", "stream_depth.rviz"])
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=robot,
        arguments=["-d", view, "-f", LaunchConfiguration("frame")],
        remappings=[
            ("/camera/image_raw", LaunchConfiguration("image")),
            *((f"/{topic}", topic) for topic in SHOWN),
            *OWN_TF,
        ],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    config = PathJoinSubstitution([FindPackageShare("dyfn_ros"), "config"])
    params_file = DeclareLaunchArgument(
        "params_file",
        default_value=PathJoinSubstitution([config, "stream_depth.yaml"]),
        description="The nodes' parameter file: config/cameras and config/recipes have some.",
    )
    return LaunchDescription([*declared, params_file, OpaqueFunction(function=nodes)])
