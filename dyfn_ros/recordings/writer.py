"""Recordings out: rosbag2 folders and bare MCAP or sqlite3 files, without a ROS installation."""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Literal
from urllib.parse import quote

import apsw
import cv2
import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from dyfn_core.files import OutputError, cannot_write
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POSE,
    TF,
    TYPES,
    Lens,
    Moved,
    camera_info,
    compressed_message,
    depth_to_millimetres,
    image_message,
    odometry_message,
    pose_message,
    transform_message,
)

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
SUFFIXES = {".mcap": "mcap", ".db3": "sqlite3"}
STATIC_TOPIC = "/tf_static"
FOREVER = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    FOREVER,
    FOREVER,
    QosLiveliness.AUTOMATIC,
    FOREVER,
    False,
)
DepthEncoding = Literal["png", "16UC1", "32FC1"]


class _SqliteStorage(Sqlite3Writer):
    """rosbags puts the path into an address as it is, where # ? and % mean something."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(Path(quote(os.fsencode(path))), compression)
        self.path = path / f"{path.name}.db3"


class _Writer(Writer):
    STORAGE_PLUGINS = MappingProxyType(
        {**Writer.STORAGE_PLUGINS, StoragePlugin.SQLITE3: _SqliteStorage}
    )


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
        writer = _Writer(
            self._partial / self.path.stem, version=9, storage_plugin=STORAGES[self._storage]
        )
        if self._storage == "mcap":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        try:
            writer.open()
        except WRITE_ERRORS as error:
            shutil.rmtree(self._partial, ignore_errors=True)
            raise _full(self.path, error) from error
        return writer

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
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
            latched = [LATCHED] if topic == STATIC_TOPIC else []
            connection = self._writer.add_connection(
                topic, kind, typestore=TYPES, offered_qos_profiles=latched
            )
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
        self,
        topic: str,
        image: np.ndarray,
        stamp_ns: int,
        frame_id: str,
        quality: int = 90,
        log_ns: int | None = None,
    ) -> None:
        """image: H x W x 3 uint8 RGB, written as a JPEG CompressedImage.

        log_ns: time of recording; None: the stamp.
        """
        data = _encode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        message = compressed_message(data, "rgb8; jpeg compressed bgr8", stamp_ns, frame_id)
        self.write(topic, COMPRESSED_IMAGE, message, stamp_ns if log_ns is None else log_ns)

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

    def write_pose(
        self,
        topic: str,
        pose: np.ndarray,
        stamp_ns: int,
        frame_id: str,
        log_ns: int | None = None,
    ) -> None:
        """pose: 4 x 4 camera-to-`frame_id`, written as PoseStamped.

        log_ns: time of recording; None: the stamp.
        """
        message = pose_message(pose, stamp_ns, frame_id)
        self.write(topic, POSE, message, stamp_ns if log_ns is None else log_ns)

    def write_transform(
        self,
        pose: np.ndarray,
        stamp_ns: int,
        parent: str,
        child: str,
        topic: str = "/tf",
        log_ns: int | None = None,
    ) -> None:
        """pose: 4 x 4, takes points of `child` to `parent`; written as a TFMessage.

        log_ns: time of recording; None: the stamp.
        """
        message = transform_message(pose, stamp_ns, parent, child)
        self.write(topic, TF, message, stamp_ns if log_ns is None else log_ns)

    def write_static_transform(
        self, pose: np.ndarray, stamp_ns: int, parent: str, child: str
    ) -> None:
        """As write_transform, for ever: on /tf_static, which a player keeps for late listeners."""
        self.write_transform(pose, stamp_ns, parent, child, STATIC_TOPIC)

    def write_odometry(
        self, topic: str, moved: Moved, stamp_ns: int, parent: str, child: str
    ) -> None:
        """moved: of the frame `child` in the frame `parent`."""
        self.write(topic, ODOMETRY, odometry_message(moved, stamp_ns, parent, child), stamp_ns)


# What rosbags' storages raise when the disk is full or gone.
WRITE_ERRORS = (OSError, sqlite3.Error, apsw.Error)


def _full(path: Path, error: Exception) -> OutputError:
    return cannot_write(path, error if isinstance(error, OSError) else OSError(str(error)))


def _encode(suffix: str, pixels: np.ndarray, options: list[int]) -> np.ndarray:
    done, data = cv2.imencode(suffix, pixels, options)
    if not done:
        raise RecordingError(f"cannot encode a {pixels.shape} {pixels.dtype} image as {suffix}")
    return data.reshape(-1)
