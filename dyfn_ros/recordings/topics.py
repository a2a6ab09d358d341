"""Which topics of a recording are the camera, its calibration, and its ground truth."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

from dyfn_ros.messages.compressed_depth import is_compressed_depth
from dyfn_ros.messages.compressed_image import TRANSPORTS
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
# Names in lower case. A device that is called after its depth says nothing about its topics.
_DEVICE = re.compile(r"depth_?(?:cam(?:era)?|sensor|device|module)s?\d*(?=[/_]|$)")
_OF_DEPTH = re.compile(r"depth|disparity")
# A namespace, not the name of a picture.
_COLOUR_SPACE = re.compile(r"/(?:rgb|colou?r|bgr)[a-z]?_?\d*/")
_REGISTERED = re.compile(r"aligned|registered|depth_to_(?:rgb|colou?r)")
_OTHER_LIGHT = re.compile(
    r"infra|thermal|lwir|lepton|boson|flir|optris|temperature|amplitude|intensity|confidence"
    r"|(?:^|[/_])n?ir_?\d*(?:[/_]|$)"
)
_SAYS_DEPTH = re.compile(r"depth|range|distance|(?:^|[/_])(?:tof|z)\d*(?:[/_]|$)")
_OF_SDK = re.compile(r"(/device_\d+/sensor_\d+)/Depth_\d+/image/data")
WIDE_GREY = {"mono16", *DEPTH_ENCODINGS}  # what shows no colours
_NO_PICTURE = re.compile(r"(?:8S|16S|32S|32F|64F)C\d+")  # numbers: labels, normals, flow
_EIGHT_BITS = re.compile(r"(?:rgb|bgr|mono)a?8|8UC\d")
# Parts of names that say what an image is, not whose.
_WHAT = re.compile(
    r"(?:rgb|colou?r|bgr|depth|disparity|image|raw|rect(?:ified)?|registered|aligned|to|points?"
    r"|camera|cam|compressed|compressedDepth|data|stream|ground|truth|gt|[_\d])+"
)
DISPARITY = "disparity"
DISPARITY_IMAGE = "stereo_msgs/msg/DisparityImage"


@dataclass(frozen=True)
class Topics:
    """image: colour, raw or compressed. camera_info, depth, depth_info: None to do without.

    depth: images or clouds; depth_info: the CameraInfo of depth images that have their own.
    remarks: what was chosen by a name or an encoding alone, and what else there is.
    lost: what cannot be read of the topics that might have been these.
    """

    image: str
    camera_info: str | None
    depth: str | None
    depth_info: str | None = None
    remarks: tuple[str, ...] = field(default=(), compare=False)
    lost: tuple[str, ...] = field(default=(), compare=False)

    @property
    def names(self) -> dict[str, str | None]:
        """What they are used for -> their names."""
        return {
            "image": self.image,
            "camera_info": self.camera_info,
            "depth": self.depth,
            "depth_info": self.depth_info,
        }


@dataclass
class _Found:
    """What the image topics hold, by their first messages.

    colours, depths: candidates, each in one transport. encodings: of raw images. unread: of the
    topics that are of depth by their names, those that are not read as depth by themselves, with
    what they hold. damaged: of topics whose first messages cannot be read, why.
    """

    colours: list[str]
    depths: list[str]
    encodings: dict[str, str]
    unread: dict[str, str]
    damaged: dict[str, str]


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
    images, and of the others those of 16 bits of grey, count when there are no others. Of several
    CameraInfos, the sibling of the image topic is taken; of several depths, see _nearest. A
    PointCloud2 is depth when it is named, and so is disparity. Raises RecordingError: a named topic
    that is absent or of another type, no image topic, several candidates.
    """
    kinds = _kinds(storage)
    found = _classify(storage, kinds)
    visible = [n for n in found.colours if not _OTHER_LIGHT.search(n.lower())] or found.colours
    pictures = [n for n in visible if not _NO_PICTURE.fullmatch(found.encodings.get(n, ""))]
    visible = pictures or visible
    coloured = [n for n in visible if found.encodings.get(n) not in WIDE_GREY] or visible
    chosen = _named(path, kinds, image, set(PICTURES)) or _only(path, kinds, coloured, "image")
    if chosen is None:
        raise _no_image(path, storage, kinds, found)
    depths = [d for d in found.depths if d != chosen]
    truth = _optional(
        path,
        kinds,
        depth,
        {IMAGE, COMPRESSED_IMAGE, POINT_CLOUD},
        _nearest(depths, chosen),
    )
    info = _optional(path, kinds, camera_info, {CAMERA_INFO}, _infos(kinds, chosen))
    remarks = [] if depth is not None else [*_depth_remarks(found, depths, chosen, truth)]
    clouds = [name for name, kind in kinds.items() if kind == POINT_CLOUD]
    if truth is None and depth is None and clouds:
        remarks.append(f"{', '.join(sorted(clouds))}: ground truth when --depth-topic names it")
    if camera_info is None and info is not None and _apart(chosen, info):
        remarks.append(
            f"{info} is the only CameraInfo, in another namespace than {chosen}: of another "
            "camera? --camera-info-topic none does without"
        )
    if image is None and len(coloured) < len(visible):
        wide = ", ".join(f"{n} ({found.encodings[n]})" for n in visible if n not in coloured)
        remarks.append(f"not used: {wide}; 16 bits of grey are depth when --depth-topic says so")
    images_own = truth is not None and kinds[truth] != POINT_CLOUD
    own = [name for name in _siblings(kinds, truth or "") if images_own and name != info]
    return Topics(
        image=chosen,
        camera_info=info,
        depth=truth,
        depth_info=_optional(path, kinds, depth_info, {CAMERA_INFO}, own),
        remarks=tuple(remarks),
        lost=() if image and depth else tuple(_lost(found, {chosen, truth})),
    )


def _lost(found: _Found, used: Collection[str | None]) -> Iterator[str]:
    """The images or depth that might have been chosen if they could be read."""
    for name, text in found.damaged.items():
        if name not in used:
            yield f"not used: {text}"


def _depth_remarks(
    found: _Found, depths: list[str], image: str, truth: str | None
) -> Iterator[str]:
    """What a user should know about the depth topic that was found, or that was not."""
    for name, held in sorted(found.unread.items()):
        # Beside the truth, a picture of depth is no other candidate.
        if truth is None or not _EIGHT_BITS.fullmatch(found.encodings.get(name, "rgb8")):
            yield (
                f"{name} is of depth by its name, and is not used: it holds {held}; expected "
                "16UC1, 32FC1, mono16, a 16-bit PNG or compressedDepth"
            )
    if truth is None:
        return
    others = ", ".join(name for name in depths if name != truth)
    if others:
        yield f"{truth} is taken for the depth, for its name; there are also {others}"
    if not _SAYS_DEPTH.search(truth.lower()):
        encoding = found.encodings.get(truth, "16 bits of grey")
        yield (
            f"{truth} is taken for depth by its encoding {encoding}, its name does not say so; "
            "--depth-topic none does without"
        )
    if _apart(image, truth):
        yield (
            f"{truth} is the only depth, in another namespace than {image}: of another camera? "
            "--depth-topic none does without"
        )


def topic_remarks(storage: Storage, topics: Topics) -> list[str]:
    """What is recorded, or should be, and is not used although that might be expected."""
    twins = _fuller_twins(storage, [topics.image, topics.depth])
    return [*topics.remarks, *twins, *_empty(storage)]


def _kinds(storage: Storage) -> dict[str, str]:
    """Message type of every topic that holds messages."""
    return {name: topic.kind for name, topic in storage.topics.items() if topic.count}


def _no_image(path: Path, storage: Storage, kinds: dict[str, str], found: _Found) -> RecordingError:
    text = f"no colour image topic; it holds {_listing(kinds, kinds)}"
    pictures = [name for name, kind in kinds.items() if kind in PICTURES]
    if found.damaged:
        text += f"; {'; '.join(found.damaged.values())}"
    elif pictures:
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
    depths = _classify(storage, kinds).depths if name is None and kind == IMAGE else [*kinds]
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


def realsense_scale(storage: Storage, depth: str | None) -> float | None:
    """Stored values per metre of a depth topic in a bag of the RealSense SDK, which records the
    sensor's unit beside it; None without one."""
    place = _OF_SDK.fullmatch(depth or "")
    unit = f"{place.group(1)}/option/Depth_Units/value" if place else ""
    if unit not in storage.topics:
        return None
    message = _first(storage, unit)
    metres = float(getattr(message, "data", 0.0))
    return round(1 / metres, 3) if metres > 0 else None


def image_topics(path: Path, storage: Storage) -> list[str]:
    """Every colour image topic, one of each that is recorded both raw and compressed.

    Raises RecordingError when there is none.
    """
    kinds = _kinds(storage)
    found = _classify(storage, kinds)
    colours = found.colours
    if not colours:
        raise _no_image(path, storage, kinds, found)
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


def _classify(storage: Storage, kinds: dict[str, str]) -> _Found:
    """Colour and depth candidates, by the first message of each image topic."""
    found = _Found([], [], {}, {}, {})
    for name, kind in sorted(kinds.items()):
        if kind == DISPARITY_IMAGE:
            found.unread[name] = kind
        message = _first(storage, name) if kind in PICTURES else None
        if message is None:
            continue
        if isinstance(message, RecordingError):
            found.damaged[name] = str(message)
            continue
        held = str(message.encoding if kind == IMAGE else getattr(message, "format", kind))
        if kind == IMAGE:
            found.encodings[name] = held
        if _is_depth(name, kind, message):
            if DISPARITY in name.lower():
                found.unread[name] = f"{held}, by its name disparity"
            elif not _OTHER_LIGHT.search(name.lower()):
                found.depths.append(name)
        elif _pictures_depth(name):
            found.unread[name] = f"{kind} {held!r}"
        else:
            found.colours.append(name)
    found.colours = _one_of_twins(storage, found.colours)
    found.depths = _one_of_twins(storage, found.depths)
    return found


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
    """The first message that can be read; the error when none of the first few can."""
    problem: RecordingError | None = None
    for recorded in islice(storage.messages([name]), TRIES):
        try:
            return recorded.message()
        except RecordingError as error:  # counted when it is read as a frame
            problem = error
    return problem


def _nearest(depths: list[str], image: str) -> list[str]:
    """Of the depths of the image's device, those that share most namespaces with it: the one in the
    image's own, else the one that is registered by its name, else that says depth, else all."""
    whose = _whose(image)
    own = [name for name in depths if whose and _whose(name)[: len(whose)] == whose]
    depths = own or depths
    parts = image.split("/")[:-1]
    shared = {name: _shared(parts, name.split("/")[:-1]) for name in depths}
    depths = [name for name in depths if shared[name] == max(shared.values())]
    space = TRANSPORTS.sub("", image).rsplit("/", 1)[0] + "/"
    near = [name for name in depths if name.startswith(space)]
    registered = [name for name in depths if _REGISTERED.search(name.lower())]
    named = [name for name in depths if _SAYS_DEPTH.search(name.lower())]
    return next((found for found in (near, registered, named) if len(found) == 1), depths)


def _shared(one: list[str], other: list[str]) -> int:
    """How many parts two names have in common from the start."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False)))


def _apart(one: str, other: str) -> bool:
    """Whether two topics are of different things by their namespaces."""
    ours, theirs = _whose(one), _whose(other)
    return bool(ours and theirs and ours[0] != theirs[0])


def _whose(name: str) -> list[str]:
    """The namespaces of a topic that do not say what it holds."""
    parts = TRANSPORTS.sub("", name).strip("/").split("/")[:-1]
    return [part for part in parts if not _WHAT.fullmatch(part.lower())]


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
