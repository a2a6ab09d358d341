"""Parameters that other packages declare, so that a recipe cannot misspell one."""

from __future__ import annotations


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# docs.nav2.org, configuration guide: costmap, voxel layer and its sources.
NAV2_COSTMAP = _words("""
    global_frame robot_base_frame update_frequency publish_frequency transform_tolerance
    rolling_window width height resolution plugins
""")
NAV2_VOXEL_LAYER = _words("""
    plugin enabled footprint_clearing_enabled min_obstacle_height max_obstacle_height z_voxels
    origin_z z_resolution unknown_threshold mark_threshold combination_method publish_voxel_map
    observation_sources
""")
NAV2_SOURCE = _words("""
    topic sensor_frame observation_persistence expected_update_rate data_type min_obstacle_height
    max_obstacle_height inf_is_valid marking clearing obstacle_max_range obstacle_min_range
    raytrace_max_range raytrace_min_range
""")
# docs.ros.org, depthimage_to_laserscan of Jazzy.
LASERSCAN = _words("scan_time range_min range_max scan_height output_frame")
# rtabmap_ros, branch ros2: rtabmap_sync/doc/rgbd_sync.md and rtabmap_slam/doc/rtabmap.md.
RGBD_SYNC = _words("""
    approx_sync approx_sync_max_interval topic_queue_size sync_queue_size qos qos_camera_info
    depth_scale decimation compressed_rate depth_compression_format image_transport depth_transport
""")
RTABMAP = _words("""
    subscribe_rgbd subscribe_depth subscribe_rgb frame_id odom_frame_id wait_for_transform
    database_path delete_db_on_start publish_tf approx_sync topic_queue_size sync_queue_size
""")
# introlab.github.io/rtabmap: RTAB-Map's own, which are strings.
RTABMAP_OWN = _words("""
    RGBD/LinearUpdate RGBD/AngularUpdate Reg/Force3DoF Grid/RangeMax Grid/MaxGroundHeight
    Grid/NormalsSegmentation Rtabmap/DetectionRate
""")
