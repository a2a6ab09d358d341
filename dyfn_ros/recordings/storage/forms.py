"""Messages in whatever encoding -> the CDR bytes of the ROS 2 type that they are read as."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.records import Schema

from dyfn_ros.recordings.storage.base import DAMAGE, plain, reason, ros_type
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FOXGLOVE_CALIBRATION,
    FOXGLOVE_COMPRESSED,
    FOXGLOVE_RAW,
    IMAGE,
    TYPES,
    calibration_message,
    compressed_message,
    header,
    raw_message,
    video_message,
)

FOXGLOVE = {
    "foxglove.CompressedImage": COMPRESSED_IMAGE,
    "foxglove.CompressedVideo": COMPRESSED_VIDEO,
    "foxglove.RawImage": IMAGE,
    "foxglove.CameraCalibration": CAMERA_INFO,
}
# The same as ROS messages, but for video, which is read as it is.
FOXGLOVE_ROS = {
    FOXGLOVE_RAW: IMAGE,
    FOXGLOVE_COMPRESSED: COMPRESSED_IMAGE,
    FOXGLOVE_CALIBRATION: CAMERA_INFO,
}
EXTRA = "`pip install 'dyfn_ros[foxglove]'`"


@dataclass(frozen=True)
class Form:
    """What messages are.

    kind: ROS 2 type; of an encoding that is not read, a text that is no type and says so.
    to_cdr: a message's bytes -> those of the ROS 2 type; raises one of DAMAGE.
    """

    kind: str
    to_cdr: Callable[[bytes], bytes]


def message_form(encoding: str, schema: Schema | None) -> Form:
    """cdr and ros1 of any type, json and protobuf of Foxglove's images, video and calibration."""
    name = "" if schema is None else schema.name
    encoding = encoding.lower()
    if encoding == "cdr":
        return ros2_form(name)
    if encoding == "ros1":
        return ros1_form(name)
    why = "which is not read"
    if schema is not None and name in FOXGLOVE:
        kind = FOXGLOVE[name]
        if encoding == "json":
            return Form(kind, lambda data: _cdr(kind, _from_json(data)))
        if encoding == "protobuf":
            try:
                decode = _protobuf(schema)
                return Form(kind, lambda data: _cdr(kind, decode(data)))
            except ImportError:
                why = f"which needs {EXTRA}"
            except DAMAGE as error:
                why = f"whose schema cannot be used ({reason(error)})"
    return Form(f"{name}, encoded as {encoding or repr(encoding)}, {why}", lambda data: data)


def ros2_form(name: str) -> Form:
    """Messages in CDR, whatever the style of the type's name; each may be packed by zstd."""
    kind = ros_type(name)
    if kind not in FOXGLOVE_ROS:
        return Form(kind, plain)
    return Form(FOXGLOVE_ROS[kind], lambda data: _from_foxglove(kind, plain(data)))


def ros1_form(name: str) -> Form:
    """Messages as ROS 1 serialises them."""
    kind = ros_type(name)
    if kind not in FOXGLOVE_ROS:
        return Form(kind, lambda data: bytes(TYPES.ros1_to_cdr(data, kind)))
    return Form(
        FOXGLOVE_ROS[kind],
        lambda data: _from_foxglove(kind, bytes(TYPES.ros1_to_cdr(data, kind))),
    )


def _from_foxglove(kind: str, data: bytes) -> bytes:
    message: Any = TYPES.deserialize_cdr(data, kind)
    fields = {
        name.upper() if len(name) == 1 else name: getattr(message, name)
        for name in message.__dataclass_fields__
        if not name.startswith("_")
    }
    stamp = message.timestamp
    return _cdr(
        FOXGLOVE_ROS[kind], {**fields, "stamp_ns": stamp.sec * 1_000_000_000 + stamp.nanosec}
    )


def _from_json(data: bytes) -> Mapping[str, Any]:
    fields: dict[str, Any] = json.loads(data)
    stamp = fields["timestamp"]
    fields["stamp_ns"] = int(stamp["sec"]) * 1_000_000_000 + int(stamp["nsec"])
    if "data" in fields:
        fields["data"] = base64.b64decode(fields["data"], validate=True)
    return fields


def _protobuf(schema: Schema) -> Callable[[bytes], Mapping[str, Any]]:
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for("protobuf", schema)
    if decode is None:
        raise ValueError(f"a schema of {schema.encoding!r}, expected 'protobuf'")

    def fields(data: bytes) -> Mapping[str, Any]:
        message = decode(data)
        found = {field.name: getattr(message, field.name) for field in message.DESCRIPTOR.fields}
        stamp = found["timestamp"]
        return {**found, "stamp_ns": stamp.seconds * 1_000_000_000 + stamp.nanos}

    return fields


def _cdr(kind: str, fields: Mapping[str, Any]) -> bytes:
    head = header(int(fields["stamp_ns"]), str(fields["frame_id"]))
    if kind == CAMERA_INFO:
        message = calibration_message(
            head,
            (int(fields["height"]), int(fields["width"])),
            str(fields["distortion_model"]),
            {name: np.array(fields[name.upper()], np.float64) for name in "dkrp"},
        )
    elif kind == COMPRESSED_IMAGE:
        data = np.frombuffer(fields["data"], np.uint8)
        message = compressed_message(data, str(fields["format"]), 0, "")
        message.header = head
    elif kind == COMPRESSED_VIDEO:
        data, stamp = np.frombuffer(fields["data"], np.uint8), int(fields["stamp_ns"])
        message = video_message(data, str(fields["format"]), stamp, str(fields["frame_id"]))
    else:
        message = raw_message(
            head,
            (int(fields["height"]), int(fields["width"])),
            str(fields["encoding"]),
            int(fields["step"]),
            np.frombuffer(fields["data"], np.uint8),
        )
    return bytes(TYPES.serialize_cdr(message, kind))
