"""ros2 launch dyfn_ros stream_depth_cameras.launch.py cameras:='[front, left]'

Several cameras in one process. Each must publish `/CAMERA/image_raw` and `/CAMERA/camera_info`;
other names are given by `image` and `camera_info`, below the camera's name.
"""

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "cameras": ("[front, left]", "Names of the cameras, as a YAML list."),
    "image": ("image_raw", "Their images, below /CAMERA/."),
    "camera_info": ("camera_info", "Their CameraInfos, below /CAMERA/."),
    "model": ("", "Bundled model's name, checkpoint file, or Hub id; empty: the file's."),
    "params_file": ("", "Parameter file of the node, such as config/cameras/two_cameras.yaml."),
    "rviz": ("false", "Start an RViz for each camera, with its image, depth and cloud."),
    "frame": ("camera", "RViz: a frame that tf connects with the frame_id of the images."),
}
SHOWN = ("depth/image", "points")  # by stream_depth.rviz


def nodes(context: LaunchContext) -> list[Node]:
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    cameras = [str(name) for name in yaml.safe_load(values["cameras"])]
    files = [values["params_file"]] if values["params_file"] else []
    own = {"cameras": cameras, **({"model": values["model"]} if values["model"] else {})}
    remappings = [
        (f"{camera}/{ours}", f"/{camera}/{values[theirs]}")
        for camera in cameras
        for ours, theirs in (("image", "image"), ("camera_info", "camera_info"))
    ]
    node = Node(
        package="dyfn_ros",
        executable="stream_depth",
        parameters=[*files, own],
        remappings=remappings,
        output="screen",
    )
    return [node, *(rviz(camera, values["image"]) for camera in cameras)]


def rviz(camera: str, image: str) -> Node:
    shown = [(f"/stream_depth/{name}", f"/stream_depth/{camera}/{name}") for name in SHOWN]
    view = PathJoinSubstitution([FindPackageShare("dyfn_ros"), "config", "stream_depth.rviz"])
    return Node(
        package="rviz2",
        executable="rviz2",
        name=f"rviz_{camera}",
        arguments=["-d", view, "-f", LaunchConfiguration("frame")],
        remappings=[("/camera/image_raw", f"/{camera}/{image}"), *shown],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
