"""Shoots a scene: chooses views, exposes as a camera does, and writes down how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dyfn_worlds.camera.cameras import CameraLens, FreeSpace, placed_view
from dyfn_worlds.camera.choices import SAMPLES, SUBPIXELS, USUAL
from dyfn_worlds.camera.paths import CameraPath, random_path
from dyfn_worlds.camera.staging import LightScript, stage, stand
from dyfn_worlds.render.occlusion import shade_corners
from dyfn_worlds.render.renderer import Picture, RenderCamera, Renderer, Shading
from dyfn_worlds.scene.actors import STILL, Moment, Placement
from dyfn_worlds.scene.scene import Scene
from dyfn_worlds.shards import RenderedView

PROBE_SHRINK = 4
MAX_SUBFRAMES = 8
PIXELS_A_SUBFRAME = 1.6
GAINS = (0.05, 40.0)


@dataclass(frozen=True)
class Style:
    """One camera and its settings, the same for a whole shard.

    brightness: mean pixel value that the automatic exposure aims at; lag: share of the error in
    stops that is left after a second; shutter: seconds; corners: strength of ambient occlusion.
    """

    gloss: float
    contrast: float
    brightness: float
    lag: float
    shutter: float
    corners: float

    @staticmethod
    def sample(rng: np.random.Generator) -> Style:
        blurred = rng.random() < 0.4
        return Style(
            gloss=float(rng.uniform(0, 0.8)),
            contrast=float(rng.uniform(0.2, 1) * (rng.random() < 0.85)),
            brightness=float(np.clip(rng.lognormal(np.log(106), 0.22), 50, 165)),
            lag=float(rng.choice([0.02, 0.2, 0.5, 0.75])),
            shutter=float(np.clip(rng.lognormal(np.log(0.016), 0.6), 0.004, 0.06)) * blurred,
            corners=float(rng.uniform(0.3, 1.0)),
        )

    def record(self) -> dict[str, float]:
        return {k: round(float(v), 5) for k, v in self.__dict__.items()}


def _always(moment: Moment, seconds: float) -> Moment:
    return moment


class Photographer:
    """Looks before it shoots: exposure from a small probe, and views not worth keeping refused.

    samples: draws within a pixel of a sharp picture, 1 to SAMPLES; a blurred one has the same
    share of its sub-frames.
    """

    def __init__(
        self,
        renderer: Renderer,
        scene: Scene,
        rng: np.random.Generator,
        placement: str = USUAL,
        pace: str | None = None,
        samples: int = SAMPLES,
    ) -> None:
        self.placement, self.pace, self.samples = placement, pace, samples
        self.renderer, self.scene, self.rng = renderer, scene, rng
        self.space = FreeSpace(scene)
        self.style = Style.sample(rng)
        renderer.load(scene)

    def exposure(self, camera: RenderCamera, moment: Moment = STILL) -> float | None:
        """What brings the mean to this shoot's brightness; None for a view not worth keeping."""
        picture = self.renderer.draw(camera, self._look(1.0), moment, PROBE_SHRINK)
        image, depth = picture.image, picture.depth
        solid = np.isfinite(depth)
        if solid.mean() < 0.5 or np.quantile(depth, 0.02) < 0.2:
            return None
        plain = 0.4 if self.placement in ("steep", "close", "above") else 0.85
        low, middle, high = np.quantile(depth[solid], [0.05, 0.5, 0.95])
        if middle > 25 or (high < 1.7 * low and self.rng.random() < plain):
            return None
        mean = max(float(image[solid].mean()), 2.0)
        contrast = image[solid].std() / mean
        if contrast < 0.08 or (contrast < 0.22 and self.rng.random() < 0.88):
            return None
        return float(np.clip((self.style.brightness / mean) ** 2, *GAINS))

    def frames(self, count: int) -> list[RenderedView]:
        """`count` independent views; fewer when the scene has not enough worth keeping."""
        views: list[RenderedView] = []
        for _ in range(count * 6):
            if len(views) == count:
                break
            lens = CameraLens.sample(self.rng, self.renderer.size)
            camera = placed_view(self.space, self.rng, lens, self.scene.interests, self.placement)
            moment = Moment(self._extras(camera), self._lamps(), float(self.rng.uniform(0.6, 1.3)))
            exposure = self.exposure(camera, moment)
            if exposure is None:
                continue
            exposure *= 2 ** float(self.rng.normal(0, 0.35))
            shaken = self._shaken(camera)
            views.append(self._shoot(shaken.at, partial(_always, moment), 0.5, exposure, "view"))
        return views

    def clip(self, count: int, seconds: float) -> list[RenderedView]:
        """`count` consecutive views of one path, exposure following with a lag.

        Raises ValueError when no path is found on which most views are worth keeping.
        """
        for _ in range(8):
            lens = CameraLens.sample(self.rng, self.renderer.size)
            path = random_path(self.space, self.rng, lens, seconds, self.scene.interests, self.pace)
            times = (np.arange(count) + 0.5) * seconds / count
            probes = [self.exposure(path.at(t)) for t in times[:: max(1, count // 16)]]
            good = [e for e in probes if e is not None]
            if len(good) >= 0.75 * len(probes):
                return self._film(path, times, seconds, good[0])
        raise ValueError("no camera path worth keeping found")

    def _film(
        self, path: CameraPath, times: np.ndarray, seconds: float, exposure: float
    ) -> list[RenderedView]:
        actors = self.scene.actors
        ways = stage(self.space, self.rng, actors, path, seconds) if actors else []
        lamps = len(self.scene.lights)
        script = LightScript.sample(self.rng, lamps, seconds)

        def moment(t: float) -> Moment:
            return Moment(tuple(w.at(t) for w in ways), *script.at(t, lamps))

        views: list[RenderedView] = []
        keep = self.style.lag ** (seconds / len(times))
        exposure *= 2 ** float(self.rng.normal(0, 0.4))
        for t in times:
            view = self._shoot(path.at, moment, float(t), exposure, script.kind)
            metres, degrees = path.speed(float(t))
            view.record.update(
                pace=path.pace, speed=round(metres, 4), turn=round(degrees, 2),
                jitter=round(path.jitter, 4),
            )  # fmt: skip
            views.append(view)
            aim = exposure * (self.style.brightness / max(float(view.image.mean()), 4.0)) ** 2
            exposure *= float(np.clip(aim / exposure, 0.02, 50)) ** (1 - keep)
            exposure = float(np.clip(exposure, *GAINS))
        return views

    def _look(self, exposure: float) -> Shading:
        return Shading(exposure, self.style.gloss, self.style.contrast)

    def _shoot(
        self,
        camera: Callable[[float], RenderCamera],
        moment: Callable[[float], Moment],
        t: float,
        exposure: float,
        lighting: str,
    ) -> RenderedView:
        """One view at time t, its light integrated over the shutter time; depth is that of t."""
        now, look = moment(t), self._look(exposure)
        sharp = self.renderer.draw(camera(t), look, now)
        blur = self._blur(camera, sharp, now, t)
        share = self.samples / SAMPLES
        steps = int(np.clip(np.ceil(share * blur / PIXELS_A_SUBFRAME), 1, share * MAX_SUBFRAMES))
        if steps > 1:
            offsets = self.style.shutter * ((np.arange(steps) + 0.5) / steps - 0.5)
            parts = [self.renderer.draw(camera(t + o), look, moment(t + o)) for o in offsets]
        else:  # several samples within a pixel, since no camera has jagged edges
            nudged = [self._nudged(camera(t), by) for by in SUBPIXELS[: self.samples - 1]]
            parts = [sharp, *(self.renderer.draw(at, look, now) for at in nudged)]
        squares = np.sum([np.square(part.image, dtype=np.float32) for part in parts], axis=0)
        image = np.sqrt(squares / len(parts)).astype(np.uint8)
        image = shade_corners(image, sharp.depth, camera(t).focal[0], self.style.corners)
        record: dict[str, object] = {
            "exposure": round(exposure, 5),
            "blur_px": round(blur, 2) if steps > 1 else 0.0,
            "subframes": steps,
            "lighting": lighting,
            "lamps": [round(g, 4) for g in now.lamps],
            "ambient": round(now.ambient, 4),
            "moving": [self._placed(p) for p in now.placements],
        }
        return RenderedView(image, sharp.depth, camera(t), sharp.moving, record)

    def _nudged(self, camera: RenderCamera, pixels: tuple[float, float]) -> RenderCamera:
        height, width = self.renderer.size
        (x, y), (cx, cy) = pixels, camera.centre
        return replace(camera, centre=(cx + x / width, cy + y / height))

    def _placed(self, place: Placement) -> dict[str, object]:
        return {
            "actor": self.scene.actors[place.actor].name,
            "position": [round(x, 4) for x in place.position],
            "yaw": round(place.yaw, 4),
            "walking": place.walking,
        }

    def _blur(
        self, camera: Callable[[float], RenderCamera], picture: Picture, now: Moment, t: float
    ) -> float:
        """Pixels that the picture smears within the shutter time, at its nearer surfaces."""
        if not self.style.shutter:
            return 0.0
        half = self.style.shutter / 2
        a, b = camera(t - half), camera(t + half)
        turn = a.pose[:3, :3].T @ b.pose[:3, :3]
        angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        near = max(float(np.quantile(picture.depth, 0.2)), 0.3)
        shift = float(np.linalg.norm(a.pose[:3, 3] - b.pose[:3, 3])) / near
        if any(p.walking for p in now.placements) and picture.moving.any():
            nearest = float(picture.depth[picture.moving].min())
            shift = max(shift, 1.2 * self.style.shutter / max(nearest, 0.3))
        return (angle + shift) * a.focal[0] * self.renderer.size[1]

    def _shaken(self, camera: RenderCamera) -> CameraPath:
        """A second of movement through a single view, so that it can be blurred."""
        position = camera.pose[:3, 3]
        forward, down = camera.pose[:3, 2], camera.pose[:3, 1]
        yaw, pitch = np.arctan2(forward[1], forward[0]), np.arcsin(np.clip(forward[2], -1, 1))
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        roll = np.arctan2(-float(down @ right), float(camera.pose[:3, 0] @ right))
        turn = self.rng.normal(size=3) * self.rng.lognormal(np.log(0.35), 0.8) * [1, 0.6, 0.3]
        drift = self.rng.normal(0, 0.3, 3)
        t = np.linspace(-0.5, 0.5, 61)[:, None]
        angles = np.array([yaw, pitch, roll]) + t * turn
        return CameraPath(position + t * drift, angles, CameraLens(camera.focal), "view")

    def _extras(self, camera: RenderCamera) -> tuple[Placement, ...]:
        if not self.scene.actors or self.rng.random() < 0.55:
            return ()
        count = int(self.rng.integers(1, 4))
        return stand(self.space, self.rng, self.scene.actors, camera, count)

    def _lamps(self) -> tuple[float, ...]:
        """Some lamps off or dimmed, now and then."""
        gains = np.where(self.rng.random(len(self.scene.lights)) < 0.15, 0.1, 1.0)
        return tuple(float(g) for g in gains * self.rng.uniform(0.7, 1.2, len(gains)))
