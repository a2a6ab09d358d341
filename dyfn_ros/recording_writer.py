"""Recordings out: rosbag2 folders and bare MCAP or sqlite3 files, without a ROS installation."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import apsw
import cv2
import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dyfn_ros.finished_file import OutputError, cannot_write

TYPES = get_typestore(Stores.ROS2_JAZZY)
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
SUFFIXES = {".mcap": "mcap", ".db3": "sqlite3"}
DepthEncoding = Literal["png", "16UC1", "32FC1"]
ColourEncoding = Literal["jpeg", "png", "raw"]


class RecordingError(Exception):
    """A recording cannot be read or written; the message names the file or topic and why."""


@dataclass(frozen=True)
class RgbdFrame:
    """One moment of an RGB-D recording.

    image: H x W x 3 uint8, RGB.
    depth_m: H x W float, metres along the optical z axis; 0, NaN or inf where there is none.
        None when the frame has no ground truth.
    camera_matrix: 3 x 3 intrinsics in pixels; None when unknown.
    pose: 4 x 4 camera-to-world in metres, optical frame; None when unknown.
    stamp: seconds. lens: of an image that is distorted.
    """

    image: np.ndarray
    depth_m: np.ndarray | None
    camera_matrix: np.ndarray | None
    pose: np.ndarray | None
    stamp: float
    lens: Lens | None = None

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds; of seconds since 1970, whose floats are no finer, to the microsecond."""
        if abs(self.stamp) < 1e6:
            return round(self.stamp * 1e9)
        return round(self.stamp * 1e6) * 1000


@dataclass(frozen=True)
class Lens:
    """model: plumb_bob, rational_polynomial or equidistant. coefficients: as CameraInfo.d."""

    model: str
    coefficients: tuple[float, ...]


class RecordingWriter:
    """Writes one recording; it appears at `path` only when it is complete.

    path: a folder (rosbag2 layout with metadata.yaml), or a file ending in .mcap or .db3.
    storage: "mcap" (zstd chunks) or "sqlite3"; a file's suffix decides for itself.
    Raises RecordingError when `path` exists and overwrite is False.
    """

    def __init__(
        self, path: str | Path, storage: str | None = None, *, overwrite: bool = False
    ) -> None:
        self.path = Path(path)
        implied = SUFFIXES.get(self.path.suffix)
        if storage not in (None, *STORAGES):
            raise RecordingError(f"storage {storage!r} is unknown, expected one of {[*STORAGES]}")
        if implied and storage not in (None, implied):
            raise RecordingError(f"{self.path}: a {self.path.suffix} file is {implied}")
        if self.path.exists() and not overwrite:
            raise RecordingError(f"{self.path} exists already and is not overwritten")
        self._bare = implied is not None
        self._storage = implied or storage or "mcap"
        self._partial = self.path.parent / f".{self.path.name}.partial"
        self._connections: dict[str, Connection] = {}
        self._writer = self._open()

    def _open(self) -> Writer:
        shutil.rmtree(self._partial, ignore_errors=True)
        writer = Writer(
            self._partial / self.path.stem, version=9, storage_plugin=STORAGES[self._storage]
        )
        if self._storage == "mcap":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        writer.open()
        return writer

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def close(self) -> None:
        """Finish the recording and move it to its path. Raises OutputError, and leaves nothing."""
        try:
            self._writer.close()
        except WRITE_ERRORS as error:
            self.discard()
            raise _full(self.path, error) from error
        folder = self._partial / self.path.stem
        source = next(folder.glob(f"*{self.path.suffix}")) if self._bare else folder
        if self.path.is_dir():
            shutil.rmtree(self.path)
        source.replace(self.path)
        shutil.rmtree(self._partial)

    def discard(self) -> None:
        """Drop everything written so far; an older recording at the path stays."""
        with suppress(Exception):  # whatever a full disk does here must not hide the first error
            self._writer.close()
        shutil.rmtree(self._partial, ignore_errors=True)

    def write(self, topic: str, kind: str, message: object, stamp_ns: int) -> None:
        """Write a message of type `kind` (such as "sensor_msgs/msg/Image") as logged at stamp_ns.

        The message may be rosbags' or any object with the same fields.
        """
        self.write_cdr(topic, kind, TYPES.serialize_cdr(message, kind), stamp_ns)

    def write_cdr(self, topic: str, kind: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write an already serialised (CDR) message."""
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._writer.add_connection(topic, kind, typestore=TYPES)
            self._connections[topic] = connection
        if connection.msgtype != kind:
            raise RecordingError(f"topic {topic} holds {connection.msgtype}, not {kind}")
        try:
            self._writer.write(connection, stamp_ns, data)
        except WRITE_ERRORS as error:
            raise _full(self.path, error) from error

    def write_image(self, topic: str, image: np.ndarray, stamp_ns: int, frame_id: str) -> None:
        """image: H x W x 3 uint8 RGB, written raw as rgb8."""
        self.write(topic, IMAGE, image_message(image, "rgb8", stamp_ns, frame_id), stamp_ns)

    def write_jpeg(
        self, topic: str, image: np.ndarray, stamp_ns: int, frame_id: str, quality: int = 90
    ) -> None:
        """image: H x W x 3 uint8 RGB, written as a JPEG CompressedImage."""
        data = _encode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        message = compressed_message(data, "rgb8; jpeg compressed bgr8", stamp_ns, frame_id)
        self.write(topic, COMPRESSED_IMAGE, message, stamp_ns)

    def write_png(self, topic: str, image: np.ndarray, stamp_ns: int, frame_id: str) -> None:
        """image: H x W x 3 uint8 RGB, written as a lossless PNG CompressedImage."""
        data = _encode(".png", image[..., ::-1], [])
        message = compressed_message(data, "rgb8; png compressed bgr8", stamp_ns, frame_id)
        self.write(topic, COMPRESSED_IMAGE, message, stamp_ns)

    def write_depth(
        self,
        topic: str,
        depth: np.ndarray,
        stamp_ns: int,
        frame_id: str,
        encoding: DepthEncoding = "32FC1",
    ) -> None:
        """depth: H x W metres; 0, NaN and inf mean "none".

        32FC1: metres, NaN for none. 16UC1: millimetres, 0 for none and beyond 65.535 m;
        png: the same as a lossless PNG CompressedImage.
        """
        if encoding == "32FC1":
            metres = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan).astype(np.float32)
            self.write(topic, IMAGE, image_message(metres, "32FC1", stamp_ns, frame_id), stamp_ns)
            return
        millimetres = depth_to_millimetres(depth)
        if encoding == "16UC1":
            self.write(
                topic, IMAGE, image_message(millimetres, "16UC1", stamp_ns, frame_id), stamp_ns
            )
            return
        data = _encode(".png", millimetres, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        message = compressed_message(data, "16UC1; png compressed", stamp_ns, frame_id)
        self.write(topic, COMPRESSED_IMAGE, message, stamp_ns)

    def write_camera_info(
        self,
        topic: str,
        camera_matrix: np.ndarray,
        size: tuple[int, int],
        stamp_ns: int,
        frame_id: str,
        lens: Lens | None = None,
    ) -> None:
        """camera_matrix: 3 x 3 in pixels of an image of size (H, W); lens: None for a pinhole."""
        message = camera_info(camera_matrix, size, stamp_ns, frame_id, lens)
        self.write(topic, CAMERA_INFO, message, stamp_ns)

    def write_pose(self, topic: str, pose: np.ndarray, stamp_ns: int, frame_id: str) -> None:
        """pose: 4 x 4 camera-to-`frame_id`, written as PoseStamped."""
        x, y, z = (float(v) for v in pose[:3, 3])
        message = _new(
            POSE,
            header=header(stamp_ns, frame_id),
            pose=_new(
                "geometry_msgs/msg/Pose",
                position=_new("geometry_msgs/msg/Point", x=x, y=y, z=z),
                orientation=_quaternion(pose),
            ),
        )
        self.write(topic, POSE, message, stamp_ns)

    def write_transform(
        self, pose: np.ndarray, stamp_ns: int, parent: str, child: str, topic: str = "/tf"
    ) -> None:
        """pose: 4 x 4, takes points of `child` to `parent`; written as a TFMessage."""
        x, y, z = (float(v) for v in pose[:3, 3])
        transform = _new(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp_ns, parent),
            child_frame_id=child,
            transform=_new(
                "geometry_msgs/msg/Transform",
                translation=_new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=_quaternion(pose),
            ),
        )
        self.write(topic, TF, _new(TF, transforms=[transform]), stamp_ns)


IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
POSE = "geometry_msgs/msg/PoseStamped"
TF = "tf2_msgs/msg/TFMessage"
FLOAT = "std_msgs/msg/Float64"


# What rosbags' storages raise when the disk is full or gone.
WRITE_ERRORS = (OSError, sqlite3.Error, apsw.Error)


def _full(path: Path, error: Exception) -> OutputError:
    return cannot_write(path, error if isinstance(error, OSError) else OSError(str(error)))


def write_rgbd_recording(
    path: str | Path,
    frames: Iterable[RgbdFrame],
    *,
    storage: str | None = None,
    overwrite: bool = False,
    namespace: str = "/camera",
    frame_id: str = "camera_optical",
    world_frame: str = "world",
    jpeg_quality: int | None = 90,
    colour: ColourEncoding = "jpeg",
    depth_encoding: DepthEncoding = "png",
) -> int:
    """Turn RGB-D frames into a recording and say how many there were.

    Topics under `namespace`: image/compressed (image for raw rgb8: colour "raw" or jpeg_quality
    None), camera_info, depth/image/compressed (depth/image for a raw depth_encoding), pose; and
    /tf.
    Raises RecordingError when there are no frames or the path exists.
    """
    count = 0
    with RecordingWriter(path, storage, overwrite=overwrite) as writer:
        for count, frame in enumerate(frames, start=1):  # noqa: B007
            stamp_ns = frame.stamp_ns
            topic = f"{namespace}/image/compressed"
            if colour == "raw" or jpeg_quality is None:
                writer.write_image(f"{namespace}/image", frame.image, stamp_ns, frame_id)
            elif colour == "png":
                writer.write_png(topic, frame.image, stamp_ns, frame_id)
            else:
                writer.write_jpeg(topic, frame.image, stamp_ns, frame_id, jpeg_quality)
            if frame.camera_matrix is not None:
                topic, size = f"{namespace}/camera_info", frame.image.shape[:2]
                writer.write_camera_info(
                    topic, frame.camera_matrix, size, stamp_ns, frame_id, frame.lens
                )
            if frame.depth_m is not None:
                suffix = "/compressed" if depth_encoding == "png" else ""
                topic = f"{namespace}/depth/image{suffix}"
                writer.write_depth(topic, frame.depth_m, stamp_ns, frame_id, depth_encoding)
            if frame.pose is not None:
                writer.write_pose(f"{namespace}/pose", frame.pose, stamp_ns, world_frame)
                writer.write_transform(frame.pose, stamp_ns, world_frame, frame_id)
        if count == 0:
            raise RecordingError(f"{path}: there are no frames to write")
    return count


def depth_to_millimetres(depth: np.ndarray) -> np.ndarray:
    """H x W metres -> H x W uint16 millimetres, 0 where there is none or beyond 65.535 m."""
    millimetres = np.round(np.nan_to_num(depth.astype(np.float64), posinf=0, neginf=0) * 1000)
    representable = (millimetres > 0) & (millimetres <= np.iinfo(np.uint16).max)
    return np.where(representable, millimetres, 0).astype(np.uint16)


def header(stamp_ns: int, frame_id: str) -> Any:
    """A std_msgs Header."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = _new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def camera_info(
    camera_matrix: np.ndarray,
    size: tuple[int, int],
    stamp_ns: int,
    frame_id: str,
    lens: Lens | None = None,
) -> Any:
    """A CameraInfo: K and P from the 3 x 3 matrix; D zero unless there is a lens."""
    matrix = np.asarray(camera_matrix, np.float64)
    lens = lens or Lens("plumb_bob", (0.0,) * 5)
    return _new(
        CAMERA_INFO,
        header=header(stamp_ns, frame_id),
        height=size[0],
        width=size[1],
        distortion_model=lens.model,
        d=np.array(lens.coefficients, np.float64),
        k=matrix.reshape(9),
        r=np.eye(3).reshape(9),
        p=np.hstack([matrix, np.zeros((3, 1))]).reshape(12),
        binning_x=0,
        binning_y=0,
        roi=_new(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def _new(kind: str, **fields: Any) -> Any:
    return TYPES.types[kind](**fields)


def image_message(pixels: np.ndarray, encoding: str, stamp_ns: int, frame_id: str) -> Any:
    """A raw Image of H x W (x C) pixels, whose dtype must be that of the encoding."""
    pixels = np.ascontiguousarray(pixels)
    return _new(
        IMAGE,
        header=header(stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.view(np.uint8).reshape(-1),
    )


def compressed_message(data: np.ndarray, layout: str, stamp_ns: int, frame_id: str) -> Any:
    """A CompressedImage of encoded bytes (1-D uint8)."""
    return _new(COMPRESSED_IMAGE, header=header(stamp_ns, frame_id), format=layout, data=data)


def _encode(suffix: str, pixels: np.ndarray, options: list[int]) -> np.ndarray:
    done, data = cv2.imencode(suffix, pixels, options)
    if not done:
        raise RecordingError(f"cannot encode a {pixels.shape} {pixels.dtype} image as {suffix}")
    return data.reshape(-1)


def _quaternion(pose: np.ndarray) -> Any:
    x, y, z, w = quaternion_from_matrix(pose[:3, :3])
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def quaternion_from_matrix(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """3 x 3 rotation -> unit quaternion (x, y, z, w) with w >= 0.

    The eigenvector of Bar-Itzhack's symmetric 4 x 4 matrix: exact for a rotation, and the
    nearest one for a matrix with rounding errors.
    """
    r = np.asarray(rotation, np.float64)
    upper = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(upper)[1][:, -1]  # eigh reads the lower triangle
    sign = -1.0 if w < 0 else 1.0
    return sign * float(x), sign * float(y), sign * float(z), sign * float(w)
