"""What the worlds' extras cost: CPU seconds of a frame with and without each, in one process.

python benchmarks/world_cost.py --assets ART
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dyfn_worlds.camera.cameras import CameraLens, random_view
from dyfn_worlds.camera.choices import SAMPLES
from dyfn_worlds.camera.photographer import Photographer
from dyfn_worlds.camera.staging import stand
from dyfn_worlds.generate import RoomWorlds
from dyfn_worlds.render.occlusion import shade_corners
from dyfn_worlds.render.renderer import Renderer, Shading
from dyfn_worlds.scene.actors import Moment

VIEWS = 12


def cpu(run: Callable[[], object]) -> float:
    """CPU milliseconds of all threads."""
    start = time.process_time()
    run()
    return 1000 * (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--assets", type=Path, required=True)
    parser.add_argument("--rooms", type=int, default=4)
    options = parser.parse_args()
    worlds, renderer = RoomWorlds(options.assets), Renderer((240, 320))
    rows: dict[str, list[float]] = {"plain": [], "moving": [], "corners": []}
    for seed in range(options.rooms):
        rng = np.random.default_rng([seed, 1])
        photographer = Photographer(renderer, worlds.scene(rng, False), rng)
        scene, space = photographer.scene, photographer.space
        for _ in range(VIEWS):
            lens = CameraLens.sample(rng, renderer.size)
            camera = random_view(space, rng, lens, scene.interests)
            moment = Moment(stand(space, rng, scene.actors, camera, 3))
            renderer.draw(camera)
            rows["plain"].append(cpu(lambda c=camera: renderer.draw(c)))  # type: ignore[misc]
            rows["moving"].append(cpu(lambda c=camera, m=moment: renderer.draw(c, Shading(), m)))  # type: ignore[misc]
            picture = renderer.draw(camera)
            rows["corners"].append(
                cpu(lambda p=picture: shade_corners(p.image, p.depth, 0.8, 1.0))  # type: ignore[misc]
            )
        for samples in range(SAMPLES, 0, -1):  # the same clip each time
            filming = Photographer(renderer, scene, np.random.default_rng(seed), samples=samples)
            times = rows.setdefault(f"clip frame, samples {samples}", [])
            times.append(cpu(lambda p=filming: p.clip(24, 4.8)) / 24)  # type: ignore[misc]
    for name, times in rows.items():
        ratio = np.mean(times) / np.mean(rows["plain"])
        print(f"{name}: {np.mean(times):.1f} ms of CPU, {ratio:.2f} times a plain frame")


if __name__ == "__main__":
    main()
