"""dyfn-worlds: renders training worlds to disk."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from dyfn_worlds.generate import MapWorlds, RoomWorlds, ShardJob, render


def parse_arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="dyfn-worlds", description=__doc__)
    parser.add_argument("--assets", type=Path, required=True, help="folder that holds the art")
    parser.add_argument("--worlds", choices=("maps", "rooms"), default="maps")
    parser.add_argument("--out", type=Path, required=True, help="folder of shards to add to")
    parser.add_argument("--shards", type=int, default=100, help="shards to render")
    parser.add_argument("--views", type=int, default=24, help="independent views in a shard")
    parser.add_argument("--clip-frames", type=int, default=0, help="render clips of this length")
    parser.add_argument("--clip-fps", type=float, default=5.0, help="frames a second of a clip")
    parser.add_argument("--seed", type=int, default=0, help="first seed; a shard has one each")
    parser.add_argument("--size", default="240x320", help="HEIGHTxWIDTH in pixels")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    options = parse_arguments(argv)
    height, width = (int(x) for x in options.size.split("x"))
    size = (height, width)
    job = ShardJob(
        options.worlds,
        options.shards,
        options.views,
        options.clip_frames,
        options.seed,
        size,
        options.clip_fps,
    )
    kind = MapWorlds if options.worlds == "maps" else RoomWorlds
    worlds: MapWorlds | RoomWorlds = kind(options.assets)
    with tqdm(total=options.shards, unit="shard", file=sys.stderr) as bar:

        def report(line: str) -> None:
            bar.update()
            bar.set_postfix_str(line[-60:])

        render(job, worlds, options.out, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
