"""Messages of an MCAP file in whatever encoding -> the CDR bytes of their ROS 2 type."""

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
EXTRA = "`pip install 'dyfn_ros[foxglove]'`"


@dataclass(frozen=True)
class Form:
    """What the messages of a topic are.

    encoding: as the channel names it. kind: ROS 2 type; of an encoding that is not read, a text
    that is no type and says so. to_cdr: a message's bytes -> those of the ROS 2 type; raises one
    of DAMAGE.
    """

    encoding: str
    kind: str
    to_cdr: Callable[[bytes], bytes]


def message_form(encoding: str, schema: Schema | None) -> Form:
    """cdr and ros1 of any type, json and protobuf of Foxglove's images, video and calibration."""
    name = "" if schema is None else schema.name
    if encoding == "cdr":
        return Form(encoding, ros_type(name), plain)
    if encoding == "ros1":
        kind = ros_type(name)
        return Form(encoding, kind, lambda data: bytes(TYPES.ros1_to_cdr(data, kind)))
    why = "which is not read"
    if schema is not None and name in FOXGLOVE:
        kind = FOXGLOVE[name]
        if encoding == "json":
            return Form(encoding, kind, lambda data: _cdr(kind, _from_json(data)))
        if encoding == "protobuf":
            try:
                decode = _protobuf(schema)
                return Form(encoding, kind, lambda data: _cdr(kind, decode(data)))
            except ImportError:
                why = f"which needs {EXTRA}"
            except DAMAGE as error:
                why = f"whose schema cannot be used ({reason(error)})"
    return Form(encoding, f"{name}, encoded as {encoding}, {why}", lambda data: data)


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
