"""Pictures that a camera, or what is between it and the node, has spoilt."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import Image

from tests.support.faults.bench import (
    FAILING,
    FRAME,
    PACKED,
    PATIENCE,
    RAW,
    SIZE,
    Bench,
    packed,
    png,
    raw_image,
    scene,
)
from tests.support.faults.fault import Fault
from tests.support.probe import stamp_of, stamped
from tests.support.ros_graph import image_message

HEIGHT, WIDTH = SIZE
STEP = 3 * WIDTH
HUGE = 2**32 - 1
NOTHING, NO_METRES, RIGHT = "no depth", "all pixels NaN", "depth right"
Make = Callable[[Bench], Sequence[Any]]


def outcome(bench: Bench, depth: np.ndarray | None, image: np.ndarray | None) -> str:
    """Of one picture; image: the scene that it shows."""
    if depth is None:
        return NOTHING
    if np.isnan(depth).all():
        return NO_METRES
    assert image is not None, "depth of a picture that shows no scene"
    assert bench.right(depth, image), "wrong depth"
    return RIGHT


def gives(expected: str, *messages: Any, image: np.ndarray | None = None, camera: str = RAW) -> Any:
    """Sends the messages one at a time; each must come to what is expected."""

    def do(bench: Bench) -> str:
        for message in messages:
            found = outcome(bench, bench.work(camera, message), image)
            assert found == expected, f"{found}, not {expected}"
        return expected

    return do


def refused(name: str, says: str, *messages: Any, camera: str = RAW) -> Fault:
    """Pictures that are bad: the log says why, diagnostics count them, nothing comes of them."""

    def do(bench: Bench) -> str:
        since = len(bench.said)
        found = gives(NOTHING, *messages, camera=camera)(bench)
        bench.wait_said(rf"diagnostics ERROR .*\d+ images on /{camera}/image\S* could not", since)
        return found

    return Fault(name, do, (rf"WARN /{camera}/image.*{says}",), True, camera)


SCENE = scene(0)


def floats(value: np.ndarray | float) -> Image:
    pixels = np.broadcast_to(np.asarray(value, "<f4"), SIZE)
    return raw_image(pixels, WIDTH, HEIGHT, "32FC1")


def grey_floats(change: Callable[[np.ndarray], None]) -> Image:
    pixels = np.full(SIZE, 0.5, np.float32)
    change(pixels)
    return floats(pixels)


def striped(pixels: np.ndarray) -> None:
    pixels[:, ::5] = np.nan


def infinite(pixels: np.ndarray) -> None:
    pixels[3, 4] = np.inf


def beyond_one(pixels: np.ndarray) -> None:
    pixels[3, 4] = 255.0


def with_step(step: int) -> Image:
    message = image_message(SCENE)
    message.step = step
    return message


def sized(width: int, height: int, encoding: str = "rgb8") -> Image:
    return raw_image(SCENE, width, height, encoding, STEP)


def with_data(size: int) -> Image:
    return raw_image(SCENE.tobytes()[:size].ljust(size, b"\0"), WIDTH, HEIGHT, "rgb8", STEP)


LAYOUTS = (
    refused("step 0", "step is 0 bytes, but a row", with_step(0)),
    refused("step of less than a row", "step is 10 bytes, but a row", with_step(10)),
    refused("step 2³² - 1", "data has 9216 bytes, but 48 rows of step 4294967295", with_step(HUGE)),
    refused("data too short", "data has 9215 bytes, but 48 rows", with_data(9215)),
    refused("data too long", "data has 9217 bytes, but 48 rows", with_data(9217)),
    refused("no data at all", "data has 0 bytes, but 48 rows", with_data(0)),
    refused("0 x 0 pixels", "0 x 0 pixels; both must be at least 1", sized(0, 0)),
    refused("0 pixels wide", "0 x 48 pixels; both must be at least 1", sized(0, HEIGHT)),
    refused(
        "width or height 2³² - 1",
        "is 64 x 4294967295 pixels; at most 13107200 .* are decoded",
        sized(HUGE, HEIGHT),
        sized(WIDTH, HUGE),
        sized(HUGE, HUGE),
    ),
    refused(
        "width whose bytes overflow 32 bits",
        "x 1 pixels; at most 13107200",
        sized(2**32 // 3 + 1, 1),
    ),
    refused("8000 x 6000 raw pixels", "8000 x 6000 pixels; at most 13107200", sized(8000, 6000)),
    refused("encoding ''", "encoding '' is not known", sized(WIDTH, HEIGHT, "")),
    refused(
        "encoding of 100 000 characters",
        r"encoding 'x{40}\.\.\.' is not known",
        sized(WIDTH, HEIGHT, "x" * 100_000),
    ),
    refused(
        "encoding with a line break",
        r"encoding 'rgb8\\n' is not known",
        sized(WIDTH, HEIGHT, "rgb8\n"),
    ),
    refused("encoding of another case", "encoding 'RGB8' is not known", sized(*SIZE, "RGB8")),
    refused(
        "yuyv of odd width",
        "yuyv needs an even width, not 63 x 48",
        raw_image(bytes(63 * 2 * 48), 63, 48, "yuyv"),
    ),
    refused(
        "nv12 of odd height",
        "nv12 needs an even width and height",
        raw_image(bytes(64 * 47 * 2), 64, 47, "nv12", 64),
    ),
    refused(
        "bayer of 1 x 1",
        "bayer_rggb8 needs at least 2 x 2 pixels",
        raw_image(b"\x80", 1, 1, "bayer_rggb8"),
    ),
    refused("32FC1 with inf", "must have its values in 0..1", grey_floats(infinite)),
    refused("32FC1 beyond 1", "must have its values in 0..1", grey_floats(beyond_one)),
)


# What the pictures show.


def constant(level: int) -> Image:
    return image_message(np.full_like(SCENE, level))


def lasts(says: str, *messages: Any) -> Any:
    """No metres, and an ERROR while it lasts: the scale's status too."""

    def do(bench: Bench) -> str:
        since = len(bench.said)
        found = gives(NO_METRES, *messages)(bench)
        bench.wait_said(rf"diagnostics ERROR \S+ raw: .*{says}", since)
        return found

    return do


BLANK = "the picture shows nothing .covered lens, flash, darkness."
BLANK_SAYS = (rf"ERROR /raw/image: {BLANK}; no depth while it lasts", "the pictures show a scene")


def frozen(bench: Bench) -> str:
    since, image = len(bench.said), bench.fresh()
    for _ in range(20):
        depth = bench.work(RAW, image_message(image))
    assert outcome(bench, depth, None) == NO_METRES
    bench.wait_said("diagnostics ERROR \\S+ raw: .*the camera is frozen", since)
    return NO_METRES


def tiny(bench: Bench) -> str:
    """Nothing can be seen in so few pixels, or what is seen is right."""
    found = set()
    for height, width in ((1, 1), (2, 2), (1, 640), (640, 1), (7, 3), (8, 8)):
        image = bench.fresh((height, width))
        found.add(outcome(bench, bench.work(RAW, image_message(image)), image))
    return " or ".join(sorted(found))


def changing_size(bench: Bench) -> str:
    for turn in range(6):
        for _ in range(5):
            image = bench.fresh((48, 64) if turn % 2 else (36, 48))
            assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
    return RIGHT


def fails_inside(bench: Bench) -> str:
    image = bench.fresh()
    image[0, 0] = FAILING
    return gives(NOTHING, image_message(image))(bench)


def stripe(bench: Bench) -> str:
    """What has no value is black; the rest of the picture has depth."""
    pixels = bench.fresh()[..., 0] / np.float32(255)
    pixels[:, 30] = np.nan
    depth = bench.work(RAW, floats(pixels))
    assert depth is not None
    assert np.isfinite(depth).any()
    return "depth"


def twelve_bits(bench: Bench) -> str:
    """The values of the scene, in the lower 12 of 16 bits: a sixteenth of the brightness."""
    values = (bench.fresh()[..., 0].astype("<u2") * 4095) // 255
    return outcome(bench, bench.work(RAW, raw_image(values, WIDTH, HEIGHT, "mono16")), None)


def others_spoilt(bench: Bench) -> str:
    """Ten bad pictures of the one camera between ten good ones of the other."""
    for _ in range(10):
        bench.send(PACKED, packed(b"no picture"))
        image = bench.fresh()
        assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
    return f"the other camera: 10 of 10 pictures, {RIGHT}"


CONTENTS = (
    Fault("covered lens (black)", lasts(BLANK, *[constant(0)] * 10), BLANK_SAYS),
    Fault("flash (white)", lasts(BLANK, *[constant(255)] * 3), BLANK_SAYS),
    Fault("grey", lasts(BLANK, *[constant(117)] * 3), BLANK_SAYS),
    Fault("32FC1, all NaN", lasts(BLANK, floats(np.nan)), BLANK_SAYS),
    Fault("32FC1 with a stripe of NaN", stripe),
    Fault("frozen camera: the same bytes 20 times", frozen, ("ERROR .*the camera is frozen",)),
    Fault(
        "pictures of 1 x 1 to 8 x 8, 640 x 1",
        tiny,
        ("ERROR .*a latent of 1 x 1 cells has no standard deviation",),
    ),
    Fault("the size changes every 5 pictures", changing_size, ("WARN .*image size changed",)),
    Fault("inference raises", fails_inside, ("ERROR .*inference failed, the stream resets",)),
    Fault("12 bits in mono16", twelve_bits, ("WARN .*below 4096 of 65536.*set image_bits:=12",)),
    Fault(
        "another camera of the node sends rubbish",
        others_spoilt,
        ("WARN /packed/image/compressed: the 10 bytes .* are neither JPEG nor PNG",),
    ),
)

# When they were taken, by their stamps.


def stamped_at(seconds: float | None, count: int = 1) -> Any:
    """A step of the stamp from the last picture; None: stamps of 0."""

    def do(bench: Bench) -> str:
        for _ in range(count):
            image, stamp = bench.fresh(), 0 if seconds is None else bench.step(seconds)
            found = outcome(bench, bench.work(RAW, image_message(image), stamp), image)
            assert found == RIGHT
        return RIGHT

    return do


def raw_stamp(sec: int, nanosec: int) -> Any:
    """Of any numbers, valid or not."""

    def do(bench: Bench) -> str:
        image = bench.fresh()
        message = stamped(image_message(image), 0, FRAME)
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
        bench.probe.publish("/raw/image", message)
        found = bench.probe.wait(lambda: bench.depths(RAW, stamp_of(message)), PATIENCE)
        assert outcome(bench, found[-1], image) == RIGHT
        return RIGHT

    return do


BACK, GAP = "reset .*stamp went back", "reset .*gap between stamps"
STAMPS = (
    Fault("stamp 0.1 s back", stamped_at(-0.1)),
    Fault("stamp 1 s back", stamped_at(-1.0), (BACK,)),
    Fault("stamp 0", stamped_at(None), (BACK,)),
    Fault("stamp an hour ahead", stamped_at(3600.0), (GAP,)),
    Fault("equal stamps", stamped_at(0.0, 3)),
    Fault("negative stamp", raw_stamp(-5, 0), (BACK,)),
    Fault("nanoseconds 2³² - 1", raw_stamp(1_000_000, HUGE), (GAP,)),
)

# Compressed pictures.


def jpeg(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def png_of(width: int, height: int) -> bytes:
    """A black picture of few bytes."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packer = zlib.compressobj(9)
    rows = io.BytesIO()
    for _ in range(height):
        rows.write(packer.compress(bytes(width + 1)))
    rows.write(packer.flush())
    body = chunk(b"IHDR", head) + chunk(b"IDAT", rows.getvalue()) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def png_header(width: int, height: int) -> bytes:
    """Of a PNG that says it is so large."""
    data = bytearray(png(SCENE))
    data[16:24] = struct.pack(">II", width, height)
    return bytes(data)


def jpeg_header(width: int, height: int) -> bytes:
    data = bytearray(jpeg(SCENE))
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def half_with_end(data: bytes) -> bytes:
    return data[: len(data) // 2] + b"\xff\xd9"


def flipped_scan(data: bytes) -> bytes:
    """Every 20th byte of the scan is another one."""
    start = data.index(b"\xff\xda") + 20
    changed = bytearray(data)
    for place in range(start, len(data) - 2, 20):
        changed[place] ^= 0x55
    return bytes(changed)


def unpackable(name: str, says: str, *data: bytes, layout: str = "jpeg") -> Fault:
    return refused(name, says, *(packed(one, layout) for one in data), camera=PACKED)


def stray_bytes(bench: Bench) -> str:
    """As webcams send: a few bytes more before the end of a whole picture."""
    depths = []
    for stray in (b"", b"\x12" * 8):
        image = scene(7)
        data = jpeg(image)
        depths.append(bench.work(PACKED, packed(data[:-2] + stray + data[-2:], "jpeg")))
    whole, other = depths
    assert whole is not None and other is not None
    assert np.array_equal(whole, other, equal_nan=True)
    return "depth of the whole picture"


JPEG, PNG = jpeg(SCENE), png(SCENE)
FILES = (
    unpackable("JPEG cut in the middle", "ends early: 600 bytes", JPEG[:600]),
    unpackable("JPEG, half and an end", "the JPEG is damaged: .+", half_with_end(JPEG)),
    unpackable("JPEG, flipped bytes in the scan", "the JPEG is damaged: .+", flipped_scan(JPEG)),
    Fault(
        "JPEG with stray bytes before its end",
        stray_bytes,
        ("WARN .*the JPEG is damaged, but whole: .+",),
        camera=PACKED,
    ),
    unpackable("PNG cut in the middle", "ends early: 600 bytes", PNG[:600], layout="png"),
    unpackable("PNG, flipped bytes", "cannot be decoded", PNG[:60] + b"????" + PNG[64:]),
    unpackable(
        "PNG that says 50 000 x 50 000, JPEG that says 65 535 x 65 535",
        "pixels; at most 13107200 .* are decoded",
        png_header(50_000, 50_000),
        jpeg_header(65_535, 65_535),
    ),
    unpackable(
        "PNG of 8192 x 8192 in few bytes",
        "8192 x 8192 pixels; at most 13107200 .* are decoded",
        png_of(8192, 8192),
    ),
    unpackable(
        "JPEG that says 8000 x 8000",
        "8000 x 8000 pixels; at most 13107200 .* are decoded",
        jpeg_header(8000, 8000),
    ),
    unpackable("no bytes, random bytes", "are neither JPEG nor PNG", b"", bytes(range(256))),
    unpackable("a header alone", "ends early|no header says its size", JPEG[:20], PNG[:20]),
    unpackable(
        "a depth image's format", "is a depth image", PNG, layout="16UC1; compressedDepth png"
    ),
)

FAULTS = (*LAYOUTS, *CONTENTS, *STAMPS, *FILES)
