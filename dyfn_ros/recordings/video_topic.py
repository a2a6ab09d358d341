"""Topics of compressed video: their messages decoded to raw images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.typestore import (
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FFMPEG_PACKET,
    IMAGE,
    TYPES,
    image_message,
)

VIDEOS = (COMPRESSED_VIDEO, FFMPEG_PACKET)
EXTRA = "`pip install 'dyfn_ros[video]'`"
SECOND = 1_000_000_000
# What the names of formats and encoders have in them -> the decoder of FFmpeg.
_CODECS = {"264": "h264", "avc": "h264", "265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "av1"}


class VideoTopic:
    """Decodes the messages of one topic; all others pass through.

    A message is one picture, as Foxglove's CompressedVideo and ffmpeg_image_transport have it, and
    as drivers put H.264 and H.265 into CompressedImage. Pictures come in the order in which they
    are shown, with the times of their messages.
    """

    def __init__(self, topic: str, lose: Callable[[str], None]) -> None:
        """Begin at the first message.

        Args:
            topic: The one to decode.
            lose: Takes the reason for each message that gives no picture.
        """
        self._topic = topic
        self._lose = lose
        self._format = ""
        self._decoder: Any = None
        self._waiting: dict[int, Recorded] = {}  # messages whose picture has not come
        self._count = 0

    def take(self, recorded: Recorded) -> Iterator[Recorded]:
        """The pictures that are known with this message; another topic's message as it is.

        Raises:
            RecordingError: The format is unknown, or its decoder is not installed.
        """
        if recorded.topic != self._topic:
            yield recorded
            return
        try:
            message = recorded.message()
        except RecordingError as error:
            self._lose(str(error))
            return
        if self._decoder is None:
            self._decoder = self._open(_format(message, recorded.kind))
        self._waiting[self._count] = recorded
        yield from self._decode(bytes(message.data))
        self._count += 1

    def rest(self) -> Iterator[Recorded]:
        """The pictures that are left at the end; messages without one are lost."""
        if self._decoder is not None:
            yield from self._decode(None)
        for _ in self._waiting:
            self._lose(self._no_picture())

    def _no_picture(self) -> str:
        return (
            f"{self._topic}: image skipped: no picture comes of a message of {self._format} "
            "(recorded before the first key frame, or damaged)"
        )

    def _open(self, text: str) -> Any:
        name = next((name for word, name in _CODECS.items() if word in text.lower()), None)
        if name is None:
            expected = ", ".join(dict.fromkeys(_CODECS.values()))
            raise RecordingError(
                f"{self._topic} is compressed video of format {text!r}, expected one of {expected}"
            )
        self._format = name
        try:
            import av
        except ImportError as error:
            raise RecordingError(
                f"{self._topic} is compressed video ({name}), which needs {EXTRA}"
            ) from error
        av.logging.set_level(None)  # damage is told by `lose`
        decoder = av.CodecContext.create(name, "r")
        decoder.thread_count = 1  # the same pictures each time, each as early as can be
        return decoder

    def _decode(self, data: bytes | None) -> Iterator[Recorded]:
        import av

        packet = None
        if data is not None:
            packet = av.Packet(data)
            packet.pts = packet.dts = self._count
        try:
            pictures = self._decoder.decode(packet)
        except av.error.FFmpegError:
            return  # the message stays among those without a picture
        for picture in pictures:
            recorded = self._waiting.pop(picture.pts, None)
            if recorded is not None and not picture.is_corrupt:
                yield _raw(recorded, picture.to_ndarray(format="rgb24"))
            elif recorded is not None:
                self._lose(self._no_picture())


def is_video(recorded: Recorded | None) -> bool:
    """Whether a topic whose first message this is holds compressed video."""
    if recorded is None or recorded.kind != COMPRESSED_IMAGE:
        return recorded is not None and recorded.kind in VIDEOS
    try:
        text = str(recorded.message().format).lower()
    except RecordingError:
        return False
    return any(word in text for word in _CODECS) and "jpeg" not in text and "png" not in text


def _format(message: Any, kind: str) -> str:
    return str(message.encoding if kind == FFMPEG_PACKET else message.format)


def _raw(recorded: Recorded, pixels: Any) -> Recorded:
    """The message as an Image of these pixels, with its time and frame."""
    message = recorded.message()
    head = message if recorded.kind == COMPRESSED_VIDEO else message.header
    stamp = head.timestamp if recorded.kind == COMPRESSED_VIDEO else head.stamp
    stamp_ns = stamp.sec * SECOND + stamp.nanosec
    image = image_message(pixels, "rgb8", stamp_ns, str(head.frame_id))
    return recorded._replace(kind=IMAGE, data=bytes(TYPES.serialize_cdr(image, IMAGE)))
