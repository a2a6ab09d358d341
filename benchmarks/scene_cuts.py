"""False alarms and misses of the scene cut detector, on made cuts and on what only looks like one.

    python benchmarks/scene_cuts.py --real hololens_room --rendered data/clips [--out out/cuts]
    python benchmarks/scene_cuts.py --real hololens_room --apart 10

Cuts: two frames that look more than 70 degrees apart (real: one recording, so the same room and
light), or come from different rendered clips. No cuts: consecutive frames; fast rotation (frames
apart by 8 to 20 degrees, 80 to 200 degrees a second at 10 Hz); exposure jumps (gain 0.37..2.7,
gamma 0.7..1.4, in one frame); occlusion (20 to 50% of the next frame covered by another scene).
The threshold is chosen on the rendered frames and reported on the real ones. --apart RATE: every
k-th frame of the real recording, k = 1 to 10, as if it had RATE frames a second.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dyfn_core.stream.scene_cut import (
    THRESHOLD,
    SceneCutDetector,
    colour_difference,
    leniency,
    moving_seconds,
    picture_features,
    scene_difference,
    structure_difference,
)

Pair = tuple[np.ndarray, np.ndarray]
CUT = "cut"
SCORES: dict[str, Callable] = {
    "colour histogram": colour_difference,
    "structure": structure_difference,
    "both": scene_difference,
}


@dataclass(frozen=True)
class Clip:
    """images: N x H x W x 3 uint8 RGB. axes: N x 3, where the camera looks, in one world.
    poses: N x 4 x 4, camera to world."""

    images: list[np.ndarray]
    axes: np.ndarray
    poses: np.ndarray


def read_clip(folder: Path) -> Clip:
    rendered = (folder / "meta.json").exists()
    paths = sorted((folder if rendered else folder / "rgb").glob("*.jpg"))
    images = [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in paths]
    if rendered:
        poses = np.array(json.loads((folder / "meta.json").read_text())["poses"])
    else:
        poses = np.loadtxt(folder / "poses.txt")
    poses = poses.reshape(-1, 4, 4)
    return Clip(images, poses[:, :3, 2], poses)


def angle(clip: Clip, one: int, other: int) -> float:
    """Degrees between two frames' optical axes."""
    return float(np.degrees(np.arccos(np.clip(clip.axes[one] @ clip.axes[other], -1, 1))))


class Cases:
    """Pairs of frames by kind, drawn with a seed."""

    def __init__(
        self, clips: Sequence[Clip], others: Sequence[Clip], seed: int, count: int
    ) -> None:
        self.clips, self.others, self.count = clips, others, count
        self.rng = np.random.default_rng(seed)

    def all(self) -> dict[str, list[Pair]]:
        kinds = {
            CUT: self.cut,
            "consecutive": self.consecutive,
            "fast rotation": self.rotation,
            "exposure jump": self.exposure,
            "occlusion": self.occlusion,
        }
        return {name: [make() for _ in range(self.count)] for name, make in kinds.items()}

    def _clip(self) -> Clip:
        return self.clips[self.rng.integers(len(self.clips))]

    def cut(self) -> Pair:
        if len(self.clips) > 1:
            one, other = self.rng.choice(len(self.clips), 2, replace=False)
            return self._any(self.clips[one]), self._any(self.clips[other])
        return self._apart(self.clips[0], 70, 180, 10**9)

    def consecutive(self) -> Pair:
        clip = self._clip()
        index = int(self.rng.integers(len(clip.images) - 1))
        return clip.images[index], clip.images[index + 1]

    def rotation(self) -> Pair:
        return self._apart(None, 8, 20, 12)

    def exposure(self) -> Pair:
        before, now = self.consecutive()
        gain = np.exp(self.rng.choice([-1, 1]) * self.rng.uniform(0.3, 1.0))
        bright = gain * (now / 255.0) ** self.rng.uniform(0.7, 1.4)
        return before, (255 * np.clip(bright, 0, 1)).astype(np.uint8)

    def occlusion(self) -> Pair:
        before, now = self.consecutive()
        height, width = now.shape[:2]
        cover = self._any(self.others[self.rng.integers(len(self.others))])
        cover, now = cv2.resize(cover, (width, height)), now.copy()
        columns = int(width * self.rng.uniform(0.2, 0.5))
        side = slice(0, columns) if self.rng.random() < 0.5 else slice(width - columns, width)
        now[:, side] = cover[:, side]
        return before, now

    def _any(self, clip: Clip) -> np.ndarray:
        return clip.images[self.rng.integers(len(clip.images))]

    def _apart(self, clip: Clip | None, least: float, most: float, frames: int) -> Pair:
        while True:
            picked = clip or self._clip()
            one, other = self.rng.integers(len(picked.images), size=2)
            near = one != other and abs(int(one) - int(other)) <= frames
            if near and least <= angle(picked, int(one), int(other)) <= most:
                return picked.images[one], picked.images[other]


def scores(cases: dict[str, list[Pair]]) -> dict[str, dict[str, np.ndarray]]:
    """Difference by candidate and kind; a pair that cannot be compared is no cut: -1."""
    looks = {
        kind: [(picture_features(a), picture_features(b)) for a, b in pairs]
        for kind, pairs in cases.items()
    }
    return {
        name: {
            kind: np.nan_to_num(np.array([score(*pair) for pair in pairs]), nan=-1.0)
            for kind, pairs in looks.items()
        }
        for name, score in SCORES.items()
    }


def curve(found: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Miss rate and false alarm rate (mean over the kinds) by threshold, and the area above."""
    thresholds = np.unique(np.concatenate([*found.values()]))
    misses = np.array([(found[CUT] <= t).mean() for t in thresholds])
    kinds = [kind for kind in found if kind != CUT]
    alarms = np.array([np.mean([(found[k] > t).mean() for k in kinds]) for t in thresholds])
    return misses, alarms, float(np.trapezoid(misses[::-1], alarms[::-1]))


def chosen(found: dict[str, np.ndarray]) -> float:
    """The threshold with the smallest cost, where a false alarm weighs as much as three misses:
    it costs a stream that was fine its memory and its metric calibration."""
    thresholds = np.unique(np.concatenate([*found.values()]))
    misses, alarms, _ = curve(found)
    return float(thresholds[(misses + 3 * alarms).argmin()])


def table(sets: dict[str, dict[str, dict[str, np.ndarray]]], chosen_on: str) -> str:
    kinds = [kind for kind in next(iter(next(iter(sets.values())).values())) if kind != CUT]
    lines = [
        f"| frames | detector | threshold | ROC area | missed | {' | '.join(kinds)} |",
        f"| --- | --- | --- | --- | --- |{' --- |' * len(kinds)}",
    ]
    for title, by_score in sets.items():
        for name, found in by_score.items():
            threshold = chosen(sets[chosen_on][name])
            alarms = [f"{(found[kind] > threshold).mean():.1%}" for kind in kinds]
            lines.append(
                f"| {title} | {name} | {threshold:.3f} | {1 - curve(found)[2]:.4f} | "
                f"{(found[CUT] <= threshold).mean():.1%} | {' | '.join(alarms)} |"
            )
    return "\n".join(lines)


def fixed_table(sets: dict[str, dict[str, dict[str, np.ndarray]]], values: list[float]) -> str:
    """Of "both", at some thresholds."""
    found = next(iter(sets.values()))["both"]
    kinds = [kind for kind in found if kind != CUT]
    lines = [
        f"| frames | threshold | missed | {' | '.join(kinds)} |",
        f"| --- | --- | --- |{' --- |' * len(kinds)}",
    ]
    for title, by_score in sets.items():
        for value in values:
            found = by_score["both"]
            alarms = " | ".join(f"{(found[kind] > value).mean():.1%}" for kind in kinds)
            lines.append(f"| {title} | {value} | {(found[CUT] <= value).mean():.1%} | {alarms} |")
    return "\n".join(lines)


def draw(path: Path, sets: dict[str, dict[str, dict[str, np.ndarray]]]) -> None:
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, (title, by_score) in zip(figure.subplots(1, 2), sets.items(), strict=True):
        for name, found in by_score.items():
            misses, alarms, _ = curve(found)
            axes.plot(alarms, 1 - misses, label=name)
        axes.set(xlim=(0, 0.4), ylim=(0.6, 1.005), title=title)
        axes.set(xlabel="false alarm rate, mean of the four kinds", ylabel="cuts found")
        axes.legend(loc="lower right")
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))


def running(clips: Sequence[Clip], threshold: float) -> str:
    """The whole detector, with its hysteresis, over the clips one after the other."""
    detector, found, alarms, pictures = SceneCutDetector(threshold), 0, 0, 0
    for number, clip in enumerate(clips):
        for index, image in enumerate(clip.images):
            cut = detector.push(image)
            pictures += 1
            if index == 0:
                found += cut and number > 0
            else:
                alarms += cut
    return (
        f"{found} of {len(clips) - 1} cuts found, {alarms} false alarms in {pictures} frames "
        f"({1000 * alarms / pictures:.1f} in 1000)"
    )


def apart_table(clip: Clip, rate: float, threshold: float, count: int, seed: int) -> str:
    """False cuts, of every k-th frame of a walk without a cut, and misses of made cuts as far
    apart in time: with one threshold for all, with that of the time, and of time and poses."""
    looks = [picture_features(image) for image in clip.images]
    cuts = Cases([clip], [clip], seed, count)
    made = [scene_difference(*map(picture_features, cuts.cut())) for _ in range(count)]
    lines = [
        "| every | seconds | false cuts, one threshold | time | time and poses "
        "| missed, one threshold | time | time and poses of a camera at rest |",
        f"|{' --- |' * 8}",
    ]
    for step in range(1, 11):
        found = [scene_difference(*pair) for pair in zip(looks, looks[step:], strict=False)]
        moved = [
            leniency(moving_seconds(step / rate, *pair))
            for pair in zip(clip.poses, clip.poses[step:], strict=False)
        ]
        late = leniency(step / rate)
        shares = [
            np.mean(np.array(found) > threshold),
            np.mean(np.array(found) > threshold * late),
            np.mean(np.array(found) > threshold * np.array(moved)),
            *[np.mean(np.array(made) <= threshold * factor) for factor in (1, late, 1)],
        ]
        lines.append(
            f"| {step} | {step / rate:.1f} | {' | '.join(f'{share:.1%}' for share in shares)} |"
        )
    return "\n".join(lines)


def cost(images: Sequence[np.ndarray], threshold: float) -> float:
    """CPU milliseconds a frame of 640 x 480: median of single frames."""
    large = [cv2.resize(image, (640, 480)) for image in images[:100]]
    detector, times = SceneCutDetector(threshold), []
    for image in large:
        begin = time.thread_time()
        detector.push(image)
        times.append(time.thread_time() - begin)
    return 1000 * float(np.median(times))


def main() -> None:
    """Print the tables and draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", type=Path, required=True, help="RGB-D folder with poses.txt")
    parser.add_argument("--rendered", type=Path, help="folder of rendered clips")
    parser.add_argument("--apart", type=float, metavar="RATE", help="every k-th frame instead")
    parser.add_argument("--every", type=int, default=4, help="use every Nth clip")
    parser.add_argument("--count", type=int, default=500, help="pairs of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/cuts"))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.apart:
        clip = read_clip(options.real)
        print(apart_table(clip, options.apart, THRESHOLD, options.count, options.seed))
        return
    if options.rendered is None:
        parser.error("--rendered is needed, unless --apart is given")
    folders = sorted(meta.parent for meta in options.rendered.glob("*/meta.json"))
    clips = [read_clip(folder) for folder in folders[:: options.every]]
    real = [read_clip(options.real)]
    makers = {
        "rendered": Cases(clips, clips, options.seed, options.count),
        "real": Cases(real, clips, options.seed, options.count),
    }
    sets = {title: scores(cases.all()) for title, cases in makers.items()}
    print(f"{options.count} pairs of each kind; thresholds chosen on the rendered frames\n")
    print(table(sets, "rendered"))
    default = SceneCutDetector().threshold
    print("\n" + fixed_table(sets, [0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7]))
    print(f"\nIn sequence, default threshold {default}: rendered {running(clips, default)};")
    print(f"real {running(real, default)}.")
    print(f"{cost(real[0].images, default):.2f} ms of CPU a frame of 640 x 480")
    draw(options.out / "roc.png", sets)


if __name__ == "__main__":
    main()
