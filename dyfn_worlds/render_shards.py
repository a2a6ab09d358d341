"""What dyfn-worlds does once its command line is read."""

from __future__ import annotations

import argparse
import sys

from tqdm import tqdm

from dyfn_worlds.generate import MapWorlds, RoomWorlds, ShardJob, render


def execute(options: argparse.Namespace) -> None:
    """Render what the parser of `cli` has read. Raises OSError, ValueError or ImportError."""
    job = ShardJob(
        options.worlds,
        options.shards,
        options.views,
        options.clip_frames,
        options.seed,
        options.size,
        options.clip_fps,
        options.placement,
        options.pace,
        options.samples,
    )
    if not options.assets.is_dir():
        raise NotADirectoryError(f"--assets {options.assets}: no such folder")
    kind = MapWorlds if options.worlds == "maps" else RoomWorlds
    worlds: MapWorlds | RoomWorlds = kind(options.assets)
    with tqdm(total=options.shards, unit="shard", file=sys.stderr) as bar:

        def report(line: str) -> None:
            bar.update()
            bar.set_postfix_str(line[-60:])

        render(job, worlds, options.out, report)
