"""`make bench`: what each part costs, as ratios within one run.

    python benchmarks/speed.py [--model dyfn-mini] [--rounds 20] [--only models node]
                               [--out speed.json] [--page docs/PERFORMANCE.md]

Everything runs on one thread and is measured in turns (benchmarks/paired.py), in time of the
processor, also that of the node's process. The first row of each table is what the others are
compared with. The floor is the time of the multiplications alone, at the speed that this
processor reaches in a matrix product or a convolution, measured in the same rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import cv2  # noqa: E402 - after the variables that it reads
import numpy as np  # noqa: E402
import torch  # noqa: E402
from paired import Measured, counted, measured  # noqa: E402
from performance_page import machine, write_page  # noqa: E402

from dyfn_core import DepthStream, Frame, StreamOptions, StreamSession, load_model  # noqa: E402
from dyfn_core.models.base import GeometryModel, image_to_batch  # noqa: E402
from dyfn_core.models.moge import MoGeModel  # noqa: E402
from dyfn_core.stream.depth_stream import push_together  # noqa: E402
from dyfn_ros.demo.node_process import NodeProcess  # noqa: E402
from dyfn_ros.node.environment import prepare_environment  # noqa: E402
from dyfn_ros.recordings.open import open_recording  # noqa: E402
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording  # noqa: E402
from dyfn_ros.recordings.typestore import Lens  # noqa: E402
from dyfn_ros.replay.run import replay  # noqa: E402
from dyfn_ros.replay.settings import Outputs, Run, Source  # noqa: E402

SIZES = {"320x240": (240, 320), "640x480": (480, 640), "1280x960": (960, 1280)}
NODE_SIZE = SIZES["640x480"]
LENS = Lens("plumb_bob", (-0.3, 0.1, 0.001, -0.001, 0.0))
BACKENDS = ("onnxruntime", "openvino")
BASELINE_TOKENS = 392  # of 14 x 14 pixels: 320 x 240 in the network
VITS = {
    "encoder": "dinov2_vits14",
    "intermediate_layers": 4,
    "dim_proj": 512,
    "dim_upsample": [256, 128, 64],
    "dim_times_res_block_hidden": 2,
    "num_res_blocks": 2,
    "last_conv_channels": 32,
    "last_conv_size": 1,
    "remap_output": "exp",
}
Table = dict[str, Measured]


@dataclass(frozen=True)
class Bench:
    """What all tables share."""

    name: str
    model: GeometryModel
    recording: Path
    rounds: int

    def images(self, size: tuple[int, int], count: int | None = None) -> list[np.ndarray]:
        """The recording's first frames as H x W x 3 uint8 RGB."""
        frames = islice(open_recording(self.recording).frames(), count or self.rounds + 2)
        return [cv2.resize(f.image, size[::-1], interpolation=cv2.INTER_LINEAR) for f in frames]

    def pushes(self, frames: list[np.ndarray], stream: DepthStream) -> Callable[[int], None]:
        """A contestant: one push a round."""
        return lambda number: void(stream.push(frames[number % len(frames)]))


def void(_: object) -> None:
    """A contestant returns nothing, or its own time."""


def matrix_of(size: tuple[int, int]) -> np.ndarray:
    """Intrinsics of a usual camera."""
    height, width = size
    return np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])


def models(bench: Bench) -> Table:
    """The released architecture, the base, DyFN, and the backends that are installed."""
    frames = bench.images(SIZES["640x480"])
    released = MoGeModel.from_config(VITS).eval()
    streams = {
        "MoGe v1 ViT-S, 392 tokens": DepthStream(
            released, stabilize=False, num_tokens=BASELINE_TOKENS
        ),
        f"{bench.name}, base": DepthStream(bench.model, stabilize=False),
        f"{bench.name}, DyFN": DepthStream(bench.model),
    }
    flops = {name: counted(partial(stream.push, frames[0])) for name, stream in streams.items()}
    for backend in BACKENDS:
        try:
            streams[f"{bench.name}, DyFN, {backend}"] = DepthStream(
                load_model(bench.name, backend=backend)
            )
        except ValueError as error:
            print(f"left out: {error}", file=sys.stderr)
    return measured(
        {name: bench.pushes(frames, stream) for name, stream in streams.items()},
        bench.rounds,
        flops,
    )


def stages(bench: Bench) -> Table:
    """Parts of a push, and the session around it."""
    frames, matrix = bench.images(NODE_SIZE), matrix_of(NODE_SIZE)
    model, stream = bench.model, DepthStream(bench.model, camera_matrix=matrix)
    session = StreamSession(model, StreamOptions())
    batches = [image_to_batch(frame, model.device)[0] for frame in frames]
    with torch.inference_mode():
        latent = model.encode(batches[0])
        stabilized, state = model.stabilized(latent, None)

    def at(number: int) -> int:
        return number % len(frames)

    @torch.inference_mode()
    def encode(number: int) -> None:
        model.encode(batches[at(number)])

    @torch.inference_mode()
    def stabilize(_: int) -> None:
        model.stabilized(latent, state)

    @torch.inference_mode()
    def decode(_: int) -> None:
        model.decode(stabilized)

    def whole(number: int) -> None:
        frame = Frame(frames[at(number)], 1000 + number / 15, matrix)
        session.push(frame)

    parts = {"encode": encode, "DyFN": stabilize, "decode": decode}
    flops = {"push": counted(partial(stream.push, frames[0]))}
    flops |= {name: counted(partial(part, 0)) for name, part in parts.items()}
    push = bench.pushes(frames, stream)
    every = {"push": push, **parts, "session: push, scene cuts, as numpy": whole}
    return measured(every, bench.rounds, flops)


def resolution(bench: Bench) -> Table:
    """Images of several sizes; the network's size stays."""
    streams = {name: (bench.images(size), DepthStream(bench.model)) for name, size in SIZES.items()}
    contestants = {name: bench.pushes(*one) for name, one in streams.items()}
    return measured(contestants, bench.rounds)


def tokens(bench: Bench) -> Table:
    """Tokens a frame."""
    frames = bench.images(SIZES["640x480"])
    streams = {n: DepthStream(bench.model, num_tokens=n) for n in (192, 96, 48, 768)}
    flops = {f"{n} tokens": counted(partial(s.push, frames[0])) for n, s in streams.items()}
    contestants = {f"{n} tokens": bench.pushes(frames, s) for n, s in streams.items()}
    return measured(contestants, bench.rounds, flops)


def cameras(bench: Bench) -> Table:
    """Several cameras in one batch."""
    frames = bench.images(SIZES["640x480"])

    def together(count: int) -> Callable[[int], None]:
        streams = [DepthStream(bench.model) for _ in range(count)]
        return lambda number: void(push_together(streams, [frames[number % len(frames)]] * count))

    return measured({f"{count} in a batch": together(count) for count in (1, 2, 4)}, bench.rounds)


def length(bench: Bench) -> Table:
    """A stream at its beginning, and one that has seen 200 frames."""
    frames = bench.images(SIZES["320x240"])
    young, old = DepthStream(bench.model), DepthStream(bench.model)
    for number in range(200):
        old.push(frames[number % len(frames)])
    streams = {"from frame 1": young, "from frame 201": old}
    return measured({name: bench.pushes(frames, s) for name, s in streams.items()}, bench.rounds)


def node(bench: Bench) -> Table:
    """The node with a distorted lens and all its outputs, over DDS, beside the bare push."""
    frames, matrix = bench.images(NODE_SIZE), matrix_of(NODE_SIZE)
    stream = DepthStream(bench.model, camera_matrix=matrix)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "raw"
        written = (
            FrameToRecord(frame, None, matrix, None, 1000 + index / 15, LENS)
            for index, frame in enumerate(frames)
        )
        write_rgbd_recording(path, written, jpeg_quality=None)
        recorded = list(open_recording(path).frames())
        contestants = {"bare push": bench.pushes(frames, stream)}
        for name, compact in {"node": False, "node, points_compact": True}.items():
            contestants[name] = _live(bench.name, Path(folder), recorded, compact, stack)
        return measured(contestants, bench.rounds)


def _live(
    model: str, folder: Path, frames: list, compact: bool, stack: ExitStack
) -> Callable[[int], float]:
    """A contestant: the processor's time that the node takes for a frame."""
    domain = 1 + (os.getpid() + compact) % 100
    prepare_environment()
    os.environ |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    from dyfn_ros.demo.live_player import LivePlayer

    space = f"/dyfn_speed_{os.getpid()}_{int(compact)}"
    parameters = {
        "model": model,
        "threads": 1,
        "drop_frames": False,
        "reliability": "reliable",
        "wait_for_camera_info": True,
        "points_compact": compact,
    }
    log = folder / f"node_{int(compact)}.log"
    process = stack.enter_context(NodeProcess(log, parameters, space))
    kind = frames[0].source.kind
    player = stack.enter_context(LivePlayer(process, kind, domain, space))
    player.prime(frames[0])
    player.reset(stabilize=True)

    def push(number: int) -> float:
        before = _processor_seconds(process.pid)
        list(player.play([frames[number % len(frames)]]))
        time.sleep(0.02)  # what the middleware does after the last output
        return _processor_seconds(process.pid) - before

    return push


def _processor_seconds(pid: int) -> float:
    """Of all threads of a process so far."""
    texts = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/schedstat")]
    return sum(int(text.split()[0]) for text in texts) / 1e9


def replays(bench: Bench) -> Table:
    """A frame more in dyfn-replay: its time beyond a run that is shorter by 16 frames."""
    return _replays(bench, time.process_time)


def replays_on_the_clock(bench: Bench) -> Table:
    """The same on the clock, with the cores that this machine has, and what else runs on it."""
    return _replays(bench, time.perf_counter)


def _replays(bench: Bench, clock: Callable[[], float]) -> Table:
    few, many = 8, 24
    frames = [frame.image for frame in islice(open_recording(bench.recording).frames(), many)]

    def push(_: int) -> float:
        stream = DepthStream(bench.model)
        for number, frame in enumerate(frames):
            if number == few:
                start = clock()
            stream.push(frame)
        return clock() - start

    with tempfile.TemporaryDirectory() as folder:

        def run(count: int, write: tuple[str, ...]) -> float:
            start = clock()
            replay(
                Source(bench.recording, max_frames=count),
                Run(model=bench.name, threads=1),
                Outputs(Path(folder), write=write, progress=False),
                lambda name, device: bench.model,
            )
            return clock() - start

        def frames_more(write: tuple[str, ...], _: int) -> float:
            return run(many, write) - run(few, write)

        contestants: dict[str, Callable[[int], float]] = {f"bare push, {many - few} frames": push}
        for write in ((), ("mcap",), ("mcap", "ply", "video")):
            name = f"replay, --write {','.join(write) or 'none'}"
            contestants[name] = partial(frames_more, write)
        return measured(contestants, max(3, bench.rounds // 4))


TABLES: dict[str, Callable[[Bench], Table]] = {
    "models": models,
    "stages": stages,
    "node": node,
    "replay": replays,
    "replay on the clock": replays_on_the_clock,
    "tokens": tokens,
    "resolution": resolution,
    "cameras": cameras,
    "length": length,
}


def told(title: str, table: Table) -> Iterator[str]:
    """A line a row."""
    for name, row in table.items():
        floor = "" if row.floor is None else f"   floor {row.floor:6.1f} ms"
        spread = f"{row.low:.2f} to {row.high:.2f}"
        middle = f"{row.milliseconds:8.1f} ms x{row.ratio:.2f} ({spread})"
        yield f"{title:19s} {name:38s} {middle}{floor}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--out", type=Path, help="JSON")
    parser.add_argument("--page", type=Path, help="Markdown page whose tables are written again")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    start = time.monotonic()
    bench = Bench(options.model, load_model(options.model), options.recording, options.rounds)
    found: dict[str, Table] = {}
    for title in options.only:
        found[title] = TABLES[title](bench)
        print("\n".join(told(title, found[title])), flush=True)
    facts = {**machine(), "rounds": options.rounds, "seconds": round(time.monotonic() - start)}
    facts["load"] = f"{os.getloadavg()[2]:.1f} on {os.cpu_count()} cores"  # of 15 minutes
    plain = {t: {n: row.values() for n, row in table.items()} for t, table in found.items()}
    if options.out:
        text = json.dumps({"machine": facts, "tables": plain}, indent=2)
        options.out.write_text(text + "\n", encoding="utf-8")
    if options.page:
        intros = {title: str(TABLES[title].__doc__) for title in found}
        write_page(options.page, facts, found, intros)


if __name__ == "__main__":
    main()
