"""Which topics of a recording are the camera, its calibration, and its ground truth."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from dyfn_ros.messages.compressed_depth import is_compressed_depth
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.storage.base import Storage
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FFMPEG_PACKET,
    IMAGE,
    POINT_CLOUD,
)

NONE = "none"  # what a user writes to do without a topic
DEPTH_ENCODINGS = {"16UC1", "32FC1"}
PICTURES = (IMAGE, COMPRESSED_IMAGE, COMPRESSED_VIDEO, FFMPEG_PACKET)
TRIES = 16  # messages of a topic, to see what it holds
TRANSPORTS = re.compile(r"/(compressed|compressedDepth|ffmpeg)$")
# Names in lower case. A device that is called after its depth says nothing about its topics.
_DEVICE = re.compile(r"depth_?(?:cam(?:era)?|sensor|device|module)s?\d*(?=[/_]|$)")
_OF_DEPTH = re.compile(r"depth|disparity")
# A namespace, not the name of a picture.
_COLOUR_SPACE = re.compile(r"/(?:rgb|colou?r|bgr)[a-z]?_?\d*/")
_REGISTERED = re.compile(r"aligned|registered")
_OTHER_LIGHT = re.compile(
    r"infra|thermal|lwir|lepton|amplitude|intensity|confidence|(?:^|[/_])ir_?\d*(?:[/_]|$)"
)


@dataclass(frozen=True)
class Topics:
    """image: colour, raw or compressed. camera_info, depth, depth_info: None to do without.

    depth: images or clouds; depth_info: the CameraInfo of depth images that have their own.
    """

    image: str
    camera_info: str | None
    depth: str | None
    depth_info: str | None = None


def choose_topics(
    path: Path,
    storage: Storage,
    image: str | None = None,
    camera_info: str | None = None,
    depth: str | None = None,
    depth_info: str | None = None,
) -> Topics:
    """Take the named topics, and find the others by type when there is one candidate.

    An image counts as depth when its encoding is 16UC1 or 32FC1 (mono16 when its name says
    depth) and its name does not say infrared, thermal or the like. A topic recorded both raw and
    compressed is one candidate: the one with more messages, of equals the raw one. Infrared
    images count when there are no others. Of several CameraInfos, the sibling of the image topic
    is taken; of several depths, the one in the image's namespace. A PointCloud2 is depth when it
    is named. Raises RecordingError: a named topic that is absent or of another type, no image
    topic, several candidates.
    """
    kinds = _kinds(storage)
    colours, depths = _classify(storage, kinds)
    visible = [name for name in colours if not _OTHER_LIGHT.search(name.lower())] or colours
    chosen = _named(path, kinds, image, set(PICTURES)) or _only(path, kinds, visible, "image")
    if chosen is None:
        raise _no_image(path, storage, kinds)
    truth = _optional(
        path,
        kinds,
        depth,
        {IMAGE, COMPRESSED_IMAGE, POINT_CLOUD},
        _nearest([d for d in depths if d != chosen], chosen),
    )
    info = _optional(path, kinds, camera_info, {CAMERA_INFO}, _infos(kinds, chosen))
    images_own = truth is not None and kinds[truth] != POINT_CLOUD
    own = [name for name in _siblings(kinds, truth or "") if images_own and name != info]
    return Topics(
        image=chosen,
        camera_info=info,
        depth=truth,
        depth_info=_optional(path, kinds, depth_info, {CAMERA_INFO}, own),
    )


def topic_remarks(storage: Storage, topics: Topics) -> list[str]:
    """What is recorded, or should be, and is not used although that might be expected."""
    return [*_fuller_twins(storage, [topics.image, topics.depth]), *_empty(storage)]


def _kinds(storage: Storage) -> dict[str, str]:
    """Message type of every topic that holds messages."""
    return {name: topic.kind for name, topic in storage.topics.items() if topic.count}


def _no_image(path: Path, storage: Storage, kinds: dict[str, str]) -> RecordingError:
    text = f"no colour image topic; it holds {_listing(kinds, kinds)}"
    pictures = [name for name, kind in kinds.items() if kind in PICTURES]
    if pictures:
        text += "; --image-topic takes one that is taken for depth or a picture of depth"
    return RecordingError("; ".join([f"{path}: {text}", *_empty(storage)]))


def _empty(storage: Storage) -> list[str]:
    """Of the topics that might have been used, those without messages."""
    names = {
        name: topic.kind
        for name, topic in storage.topics.items()
        if not topic.count and topic.kind in (*PICTURES, CAMERA_INFO)
    }
    if not names:
        return []
    return [
        f"recorded without messages: {_listing(names, names)} (did the recorder's quality of "
        "service match the publisher's?)"
    ]


def _fuller_twins(storage: Storage, used: list[str | None]) -> list[str]:
    """Of each used topic, the transports that hold more messages."""
    found = []
    for name in filter(None, used):
        count = storage.topics[name].count
        for twin, topic in storage.topics.items():
            same = TRANSPORTS.sub("", twin) == TRANSPORTS.sub("", name)
            if same and topic.kind in PICTURES and topic.count > count:
                found.append(f"{name} holds {count} messages, {twin} {topic.count}")
    return found


def choose_reference(path: Path, storage: Storage, name: str | None, kind: str) -> str:
    """The topic of measurements for a metric scale.

    Args:
        path: The recording, for errors.
        storage: The same, opened.
        name: The topic; None: the only one of the type (of images, the only depth image topic).
        kind: Message type.

    Returns:
        Its name as recorded.

    Raises:
        RecordingError: The topic is absent or of another type, or there are several.
    """
    kinds = _kinds(storage)
    depths = _classify(storage, kinds)[1] if name is None and kind == IMAGE else [*kinds]
    candidates = sorted(topic for topic in depths if kinds[topic] == kind)
    found = _named(path, kinds, name, {kind}) or _only(path, kinds, candidates, "reference")
    if found is None:
        raise RecordingError(
            f"{path}: no topic of {kind} for the metric scale; it holds {_listing(kinds, kinds)}"
        )
    return found


def listed_topics(storage: Storage) -> str:
    """Every topic that holds messages, with its type, for messages to a user."""
    kinds = _kinds(storage)
    return _listing(kinds, kinds)


def image_topics(path: Path, storage: Storage) -> list[str]:
    """Every colour image topic, one of each that is recorded both raw and compressed.

    Raises RecordingError when there is none.
    """
    kinds = _kinds(storage)
    colours, _ = _classify(storage, kinds)
    if not colours:
        raise _no_image(path, storage, kinds)
    return colours


def _optional(
    path: Path, kinds: dict[str, str], name: str | None, types: set[str], candidates: list[str]
) -> str | None:
    if name == NONE:
        return None
    what = "camera-info" if types == {CAMERA_INFO} else "depth"
    return _named(path, kinds, name, types) or _only(path, kinds, candidates, what)


def _named(path: Path, kinds: dict[str, str], name: str | None, types: set[str]) -> str | None:
    """The topic a user named; the base name of a compressed topic will do."""
    if name is None:
        return None
    for known in (name, f"{name}/compressed", f"{name}/compressedDepth", f"{name}/ffmpeg"):
        if kinds.get(known) in types:
            return known
    ours_first = sorted(types, key=lambda kind: (not kind.startswith("sensor_msgs"), kind))
    expected = " or ".join(ours_first)
    if name in kinds:
        raise RecordingError(f"{path}: topic {name} is {kinds[name]}, expected {expected}")
    raise RecordingError(
        f"{path}: no topic {name}, expected one of {_listing(kinds, kinds)} that is {expected}"
    )


def _only(path: Path, kinds: dict[str, str], candidates: list[str], what: str) -> str | None:
    if len(candidates) > 1:
        # There is no reference in training data.
        key = "" if what == "reference" else f" ({what.replace('-', '_')}_topic in training data)"
        raise RecordingError(
            f"{path}: several topics may be the {what}; choose one with --{what}-topic{key}: "
            f"{_listing(kinds, candidates)}"
        )
    return candidates[0] if candidates else None


def _listing(kinds: dict[str, str], names: list[str] | dict[str, str]) -> str:
    return ", ".join(f"{name} ({kinds[name]})" for name in sorted(names)) or "no messages"


def _classify(storage: Storage, kinds: dict[str, str]) -> tuple[list[str], list[str]]:
    """Colour and depth candidates, by the first message of each image topic."""
    colours: list[str] = []
    depths: list[str] = []
    for name, kind in sorted(kinds.items()):
        if kind not in PICTURES:
            continue
        message = _first(storage, name)
        if message is None:
            continue
        if _is_depth(name, kind, message):
            if not _OTHER_LIGHT.search(name.lower()):
                depths.append(name)
        elif not _pictures_depth(name):
            colours.append(name)
    return _one_of_twins(storage, colours), _one_of_twins(storage, depths)


def _is_depth(name: str, kind: str, message: Any) -> bool:
    if kind == COMPRESSED_IMAGE:
        return is_compressed_depth(message)
    if kind != IMAGE:
        return False
    named = message.encoding == "mono16" and "depth" in name.lower()
    return message.encoding in DEPTH_ENCODINGS or named


def _pictures_depth(name: str) -> bool:
    """Whether an image is, by its name, a coloured picture of depth.

    The innermost namespace that says colour or depth decides.
    """
    words = _DEVICE.sub("", TRANSPORTS.sub("", name).lower())
    inner = _COLOUR_SPACE.split(words)[-1]
    return bool(_OF_DEPTH.search(inner))


def _first(storage: Storage, name: str) -> Any:
    """The first message that can be read; None when none of the first few can."""
    for recorded in islice(storage.messages([name]), TRIES):
        try:
            return recorded.message()
        except RecordingError:  # counted when it is read as a frame
            continue
    return None


def _nearest(depths: list[str], image: str) -> list[str]:
    """The depths in the namespace of the image when that is one, else those that are registered
    by their name when that is one, else all."""
    space = TRANSPORTS.sub("", image).rsplit("/", 1)[0] + "/"
    near = [name for name in depths if name.startswith(space)]
    registered = [name for name in depths if _REGISTERED.search(name.lower())]
    return next((found for found in (near, registered) if len(found) == 1), depths)


def _one_of_twins(storage: Storage, names: list[str]) -> list[str]:
    """Of a topic in several transports the one with the most messages, of equals the raw one."""
    kept: dict[str, str] = {}
    order = sorted(names, key=lambda n: (-storage.topics[n].count, len(TRANSPORTS.findall(n)), n))
    for name in order:
        kept.setdefault(TRANSPORTS.sub("", name), name)
    return sorted(kept.values())


def _infos(kinds: dict[str, str], image: str) -> list[str]:
    """CameraInfo candidates; the image's sibling alone when it is there."""
    infos = sorted(name for name, kind in kinds.items() if kind == CAMERA_INFO)
    return _siblings(kinds, image) or infos


def _siblings(kinds: dict[str, str], image: str) -> list[str]:
    """The CameraInfo beside an image topic, or where the RealSense SDK puts it."""
    base = TRANSPORTS.sub("", image)
    beside = base.rsplit("/", 1)[0] + "/camera_info"
    of_sdk = base.removesuffix("/image/data") + "/info/camera_info"
    found = [name for name in (beside, of_sdk) if kinds.get(name) == CAMERA_INFO]
    return found[:1]
