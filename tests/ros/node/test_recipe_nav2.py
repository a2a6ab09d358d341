"""The recipe for nav2: what its costmap makes of the node's cloud, by its parameter file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.qos import QoSCompatibility, qos_check_compatible, qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField

from dyfn_core.geometry.rigid import inverse
from dyfn_ros.messages.camera_info import camera_info_message
from dyfn_ros.messages.clouds import cloud_points
from dyfn_ros.messages.transforms import TransformBuffer
from tests.support.foreign_parameters import NAV2_COSTMAP, NAV2_SOURCE, NAV2_VOXEL_LAYER
from tests.support.node_here import running_node
from tests.support.odometry import odometry, pose_text, tf_message, transform
from tests.support.plane_drive import OWN_CAMERA, shown
from tests.support.probe import Probe, stamp_of, stamped
from tests.support.recipe_scene import SIZE, Scene, mount, picture, scene_depth
from tests.support.recipe_stream import (
    OPTICAL_FRAME,
    RECIPES,
    ROOT,
    RecipeStream,
    recipe_stream,
)
from tests.support.ros_graph import image_message, own_domain
from tests.support.textured_plane import plane_view, texture, walk

COSTMAP = yaml.safe_load((RECIPES / "nav2_local_costmap.yaml").read_text())["local_costmap"][
    "local_costmap"
]["ros__parameters"]
LAYER = COSTMAP["voxel_layer"]
SOURCES = {name: LAYER[name] for name in LAYER["observation_sources"].split()}
BOX = ((1.7, -0.3, 0.0), (1.9, 0.3, 0.4))
SCENE = Scene(box=BOX, wall=2.6)
MOUNT = mount(height=1.0, left=8, down=15, x=0.1)  # of the camera in base_link
ROBOT = (0.4, -0.2)  # base_link in odom, metres; turned by TURN degrees
TURN = 20.0
FLOOR_ERROR = 0.04  # metres; a step of the picture's 8 bits is 8 mm of depth


@pytest.fixture(scope="module")
def stream() -> Iterator[RecipeStream]:
    file = RECIPES / "stream_depth_nav2.yaml"
    with recipe_stream(file, points_stride=1) as stream:  # the made picture is small
        yield stream


@pytest.fixture(scope="module")
def cloud(stream: RecipeStream) -> PointCloud2:
    return stream.frame(picture(scene_depth(SCENE, MOUNT)), {"points": PointCloud2})["points"]


def robot() -> np.ndarray:
    """4 x 4, base_link in odom."""
    angle = np.radians(TURN)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:2, 3] = ROBOT
    return pose


def in_costmap(cloud: PointCloud2) -> tuple[np.ndarray, np.ndarray]:
    """As nav2 has it by tf: N x 3 points in its global frame, and where the sensor is."""
    buffer = TransformBuffer()
    base = COSTMAP["robot_base_frame"]
    buffer.take(tf_message(transform(MOUNT, 0, base, OPTICAL_FRAME)), static=True)
    buffer.take(tf_message(transform(robot(), 0, COSTMAP["global_frame"], base)), static=True)
    placed = buffer.lookup(COSTMAP["global_frame"], cloud.header.frame_id, 0)
    found = cloud_points(cloud)
    points = np.stack([found[axis] for axis in "xyz"], axis=-1).reshape(-1, 3)
    return points @ placed.pose[:3, :3].T + placed.pose[:3, 3], placed.pose[:3, 3]


def buffered(points: np.ndarray, source: dict[str, Any]) -> np.ndarray:
    """nav2's ObservationBuffer: NaN fails both comparisons."""
    low, high = source["min_obstacle_height"], source["max_obstacle_height"]
    return points[(points[:, 2] >= low) & (points[:, 2] <= high)]


def marked(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """nav2's VoxelLayer: the points that become obstacles, of the sources that mark."""
    found = []
    for source in SOURCES.values():
        if source["marking"]:
            some = buffered(points, source)
            away = np.linalg.norm(some - origin, axis=1)
            near, far = source["obstacle_min_range"], source["obstacle_max_range"]
            some = some[(away >= near) & (away < far)]
            found.append(some[some[:, 2] <= LAYER["max_obstacle_height"]])
    return np.concatenate(found)


def to_robot(points: np.ndarray) -> np.ndarray:
    pose = robot()
    return (points - pose[:3, 3]) @ pose[:3, :3]


def test_the_file_has_parameters_that_nav2_declares() -> None:
    assert set(COSTMAP) - NAV2_COSTMAP == set(COSTMAP["plugins"])
    assert set(LAYER) - NAV2_VOXEL_LAYER == set(SOURCES)
    for source in SOURCES.values():
        assert set(source) <= NAV2_SOURCE
        assert source["data_type"] == "PointCloud2"
    assert isinstance(COSTMAP["width"], int)  # nav2 declares whole metres
    assert isinstance(COSTMAP["height"], int)


def test_nav2_can_be_connected_with_the_cloud(stream: RecipeStream) -> None:
    for source in SOURCES.values():
        (publisher,) = stream.node.get_publishers_info_by_topic(source["topic"])
        assert publisher.topic_type == "sensor_msgs/msg/PointCloud2"
        offered = publisher.qos_profile
        found, reason = qos_check_compatible(offered, qos_profile_sensor_data)  # nav2's
        assert found != QoSCompatibility.ERROR, reason


def test_the_cloud_has_the_fields_and_the_frame_that_nav2_reads(cloud: PointCloud2) -> None:
    kinds = {field.name: (field.datatype, field.count) for field in cloud.fields}
    for axis in "xyz":
        assert kinds[axis] == (PointField.FLOAT32, 1)
    assert cloud.header.frame_id == OPTICAL_FRAME
    assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec) != (0, 0)


def test_obstacles_are_where_they_are_and_the_floor_is_none(cloud: PointCloud2) -> None:
    points, origin = in_costmap(cloud)
    obstacles = to_robot(marked(points, origin))
    low, high = np.array(BOX[0]) - FLOOR_ERROR, np.array(BOX[1]) + FLOOR_ERROR
    of_box = ((obstacles >= low) & (obstacles <= high)).all(axis=1)
    of_wall = abs(obstacles[:, 0] - SCENE.wall) < FLOOR_ERROR
    assert of_box.sum() > 50
    assert of_wall.sum() > 50
    assert (of_box | of_wall).all()
    assert obstacles[of_box][:, 2].max() == pytest.approx(BOX[1][2], abs=FLOOR_ERROR)
    front = obstacles[of_box & (obstacles[:, 2] < BOX[1][2] - FLOOR_ERROR)]
    np.testing.assert_allclose(front[:, 0], BOX[0][0], atol=FLOOR_ERROR)
    width = front[:, 1].max() - front[:, 1].min()
    assert width == pytest.approx(0.6, abs=0.12)  # a pixel is 37 mm; edges are filtered


def test_the_floor_that_nav2_clears_by_is_flat(cloud: PointCloud2) -> None:
    points, _ = in_costmap(cloud)
    clearing = np.concatenate([buffered(points, s) for s in SOURCES.values() if s["clearing"]])
    before_the_box = to_robot(clearing)
    floor = before_the_box[before_the_box[:, 0] < BOX[0][0] - FLOOR_ERROR]
    assert len(floor) > 500
    assert abs(floor[:, 2]).max() < FLOOR_ERROR


def test_what_is_beyond_the_ranges_is_no_obstacle(cloud: PointCloud2) -> None:
    """The check above would miss a file whose limits are never reached."""
    points, origin = in_costmap(cloud)
    far = points - origin
    assert len(marked(origin + 1.6 * far, origin)) < len(marked(points, origin)) / 2
    assert len(marked(origin + 0.05 * far, origin)) == 0
    assert not np.isfinite(points).all()  # the edges of the box, by points_edge_filter


def test_the_voxels_reach_above_the_camera_and_the_clouds_as_far_as_is_cleared(
    stream: RecipeStream,
) -> None:
    top = LAYER["origin_z"] + LAYER["z_voxels"] * LAYER["z_resolution"]
    assert MOUNT[2, 3] < top  # nav2 clears nothing for a sensor outside
    settings = stream.node.settings
    reach = max(s.get("raytrace_max_range", 0) for s in SOURCES.values())
    assert settings.points_max_depth >= reach
    assert all(s.get("obstacle_max_range", 0) < reach for s in SOURCES.values())
    assert COSTMAP["width"] / 2 >= max(s.get("obstacle_max_range", 0) for s in SOURCES.values())


def test_clouds_come_as_often_as_nav2_expects(stream: RecipeStream) -> None:
    """expected_update_rate is in seconds between clouds."""
    rate = stream.node.settings.max_rate
    assert rate >= COSTMAP["update_frequency"]
    for source in SOURCES.values():
        assert source.get("expected_update_rate", 10) >= 3 / rate


def test_before_there_are_metres_nav2_sees_nothing() -> None:
    """The file as it is, without an odometry that comes."""
    own = {"metric_source": "odometry", "camera_pose": pose_text(MOUNT)}
    file = RECIPES / "stream_depth_nav2.yaml"
    with recipe_stream(file, **own, odometry_wait=0.0, points_stride=1) as stream:
        image = picture(scene_depth(SCENE, MOUNT))
        points, _ = in_costmap(stream.frame(image, {"points": PointCloud2})["points"])
    assert len(points) == SIZE[0] * SIZE[1]
    assert all(len(buffered(points, source)) == 0 for source in SOURCES.values())


@pytest.mark.slow
def test_with_the_file_as_it_is_the_robot_s_motion_gives_metres() -> None:
    """A walk along a plane at 0.2 m/s; the camera's place is given where no tf2_msgs is."""
    line = ["--params-file", str(RECIPES / "stream_depth_nav2.yaml")]
    line += ["-p", f"camera_pose:={pose_text(MOUNT)}", "-r", "odometry:=/odom"]
    whole, ratios = texture(), list[float]()
    with own_domain() as domain, running_node(domain, line) as node:
        probe = Probe(domain)
        clouds = probe.listen("points", PointCloud2)
        first = (node.settings.points_stride - 1) // 2
        grid = (slice(first, None, node.settings.points_stride),) * 2
        for number, pose in enumerate(walk(60, step=0.02, turn=0.002)):
            stamp, view = 10**9 + number * 10**8, plane_view(pose, whole, OWN_CAMERA)
            info = camera_info_message(None, OWN_CAMERA, *view.depth.shape)
            probe.publish("/odom", odometry(pose @ inverse(MOUNT), stamp / 1e9))
            probe.publish("/camera_info", stamped(info, stamp, OPTICAL_FRAME))
            probe.publish("/image", stamped(image_message(shown(view)), stamp, OPTICAL_FRAME))
            probe.wait(lambda stamp=stamp: clouds and stamp_of(clouds[-1]) == stamp, 60.0)
            depth = cloud_points(clouds[-1])["z"]
            if np.isfinite(depth).any():
                ratios.append(float(np.nanmedian(depth / view.depth[grid])))
            if len(ratios) == 3:
                break
        probe.close()
    assert 20 < number < 60  # nothing before the motion has told
    np.testing.assert_allclose(ratios, 1.0, atol=0.01)


def test_the_transform_of_the_page_is_that_of_an_optical_frame() -> None:
    page = (ROOT / "docs/recipes/nav2.md").read_text(encoding="utf-8")
    given = dict(re.findall(r"--(x|y|z|roll|pitch|yaw) (\S+)", page))
    angles = [float(given.get(name, 0)) for name in ("roll", "pitch", "yaw")]
    found = Rotation.from_euler("xyz", angles).as_matrix()  # as static_transform_publisher has it
    expected = mount(height=float(given["z"]), down=15, x=float(given["x"]))
    np.testing.assert_allclose(found, expected[:3, :3], atol=1e-3)
    assert f"--child-frame-id {OPTICAL_FRAME}" in page
