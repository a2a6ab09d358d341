"""Which worlds there are, and the endless seeded stream of shards that they give."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyfn_worlds.camera.choices import SAMPLES, USUAL
from dyfn_worlds.camera.photographer import Photographer
from dyfn_worlds.casting import Cast
from dyfn_worlds.maps.quake import GameFiles, MapError, load_map
from dyfn_worlds.render.renderer import Renderer
from dyfn_worlds.rooms.furniture import Showroom
from dyfn_worlds.rooms.rooms import furnished_room
from dyfn_worlds.scene import vary as variation
from dyfn_worlds.scene.palette import Palette
from dyfn_worlds.scene.scene import Scene
from dyfn_worlds.shards import existing_shards, write_shard

HELD_OUT_MAPS = frozenset(
    {"aggressor", "oa_bases3plus3", "oacmpdm10", "oa_dm4", "czest1tourney", "pul1ctf"}
)
HELD_OUT_SEEDS = 10


@dataclass(frozen=True)
class ShardJob:
    """How much of one kind of world to render, and how.

    clip_frames: length of a clip; 0 renders independent views, `views` of them for each shard.
    clip_fps: frames in a second of the walk; low is far from frame to frame. placement: of
    independent views, one of cameras.PLACEMENTS. pace: of clips, one of paths.PACES; None draws it.
    samples: draws within a pixel, 1 to SAMPLES.
    """

    worlds: str
    shards: int
    views: int
    clip_frames: int
    seed: int
    size: tuple[int, int]
    clip_fps: float = 5.0
    placement: str = USUAL
    pace: str | None = None
    samples: int = SAMPLES


class MapWorlds:
    """OpenArena's maps, each shard with other textures, tints and scale."""

    def __init__(self, assets: Path) -> None:
        self.files = GameFiles(sorted(assets.rglob("*.pk3")))
        self.maps = self.files.maps()
        libraries = sorted(assets.rglob("*.sh3f"))
        self.cast = Cast(self.files, Showroom(libraries) if libraries else None)
        self.pool = [
            image
            for name in sorted(self.files.members)
            if name.startswith("textures/") and name.endswith((".jpg", ".tga"))
            if zlib.crc32(name.encode()) % 4 == 0 and (image := self.files.image(name)) is not None
            if np.median(image) > 25
        ]

    def scene(self, rng: np.random.Generator, held_out: bool) -> Scene:
        names = [m for m in self.maps if (Path(m).stem in HELD_OUT_MAPS) == held_out]
        name = names[rng.integers(len(names))]
        scene = load_map(self.files, name, float(rng.uniform(30, 60)))
        if not len(scene.viewpoints):
            raise MapError(f"{name}: no entity stands in free space")
        swap = 0.0 if held_out else float(rng.choice([0.0, 0.0, 0.3, 0.8]))
        scene = variation.vary(scene, rng, self.pool, swap)
        self.cast.join(scene, rng)
        return scene


class RoomWorlds:
    """Furnished rooms; no two are alike."""

    def __init__(self, assets: Path) -> None:
        libraries = sorted(assets.rglob("*.sh3f"))
        self.showroom = Showroom(libraries) if libraries else None
        archives = sorted(assets.rglob("*.pk3"))
        maps = MapWorlds(assets) if archives else None
        self.palette = Palette.find(assets, maps.pool if maps else [])
        self.cast = Cast(maps.files if maps else None, self.showroom)

    def scene(self, rng: np.random.Generator, held_out: bool) -> Scene:
        scene = furnished_room(rng, self.showroom, self.palette)
        self.cast.join(scene, rng)
        return scene


def render(
    job: ShardJob, worlds: MapWorlds | RoomWorlds, out: Path, report: Callable[[str], None]
) -> None:
    """Writes the job's shards that are not there yet; one in HELD_OUT_SEEDS is held out."""
    renderer = Renderer(job.size)
    kind = "clip" if job.clip_frames else "frames"
    root = out / ("clips" if job.clip_frames else "frames")
    done = existing_shards(out)
    for seed in range(job.seed, job.seed + job.shards):
        held_out = seed % HELD_OUT_SEEDS == 0
        stem = f"{job.worlds}_{kind}_{seed:07d}"
        if stem in done:
            continue
        rng = np.random.default_rng([zlib.crc32(job.worlds.encode()), bool(job.clip_frames), seed])
        try:
            scene = worlds.scene(rng, held_out)
            photographer = Photographer(renderer, scene, rng, job.placement, job.pace, job.samples)
            if job.clip_frames:
                views = photographer.clip(job.clip_frames, job.clip_frames / job.clip_fps)
            else:
                views = photographer.frames(job.views)
        except (MapError, ValueError) as error:
            report(f"{stem}: skipped, {error}")
            continue
        if not job.clip_frames and len(views) < max(4, job.views // 4):
            report(f"{stem}: skipped, only {len(views)} views of {scene.name} worth keeping")
            continue
        split = "held_out" if held_out else "train"
        meta = {"world": scene.name, "kind": kind, "split": split, "seed": seed,
                "style": photographer.style.record()}  # fmt: skip
        write_shard(root / stem, views, meta)
        report(f"{stem}: {scene.name}, {len(views)} views")
