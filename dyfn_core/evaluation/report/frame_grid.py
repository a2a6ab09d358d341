"""Frames of one sequence side by side: input, truth, every variant, every error; colour bars."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from dyfn_core.evaluation.report.colours import (
    MAX_ERROR,
    colour_depth,
    colour_error,
    depth_range,
)
from dyfn_core.evaluation.report.pictures import DepthSnapshot, encode_picture, snapshot
from dyfn_core.prediction import DEPTH
from dyfn_core.scoring.protocols import align_depth

CAPTION, BAR, GAP = 22, 44, 2  # pixels of the picture
PAPER = 255
STOPS = 64  # of a colour bar's gradient
ERROR_UNIT = "error |d - p| / d, share of the true depth d"


@dataclass(frozen=True)
class ShownFrames:
    """The kept frames of a variant, and what aligns its predictions to the truth.

    scale, shift: one alignment for all frames (the video protocol's), so that drift shows; 1 and
    0 without truth. quantity: depth or disparity.
    """

    snapshots: Sequence[DepthSnapshot]
    scale: float = 1.0
    shift: float = 0.0
    quantity: str = DEPTH

    def depths(self) -> dict[int, np.ndarray]:
        """Aligned depth by frame."""
        return {
            s.index: align_depth(s.depth, self.scale, self.shift, self.quantity)
            for s in self.snapshots
        }


@dataclass(frozen=True)
class ColourBar:
    """What colours mean. label: quantity and unit. colours: STOPS x 3 uint8 RGB, evenly spaced.
    ticks: share of the bar -> text."""

    label: str
    colours: np.ndarray
    ticks: Mapping[float, str]


@dataclass(frozen=True)
class FrameGrid:
    """Rows of pictures, all of a row of one size. rows: label -> a picture (H x W x 3 uint8 RGB)
    for each of the columns."""

    columns: Sequence[str]
    rows: Mapping[str, Sequence[np.ndarray]]
    bars: Sequence[ColourBar]
    alt: str = "frames"


def frame_grid(
    variants: Mapping[str, ShownFrames], label: Callable[[int], str] = str, alt: str = "frames"
) -> FrameGrid:
    """Draw the same frames of one or more variants.

    Args:
        variants: Name -> its frames; the first one's are shown, and what others have of them.
        label: Names a frame.
        alt: What is shown, for those who cannot see it.

    Returns:
        A row a frame: input, truth, depth of each variant, error of each; without truth the
        depths alone, each over its own median. One range of colours for all depths.

    Raises:
        ValueError: No frame was kept.
    """
    first = next(iter(variants.values()))
    if not first.snapshots:
        raise ValueError("no frame was kept for the strip")
    truths = {s.index: s.truth for s in first.snapshots if s.truth is not None}
    depths = {name: shown.depths() for name, shown in variants.items()}
    if not truths:
        depths = {name: _over_median(found) for name, found in depths.items()}
    shown = [*truths.values()] or [d for found in depths.values() for d in found.values()]
    near, far = depth_range(shown)
    rows = {}
    for one in first.snapshots:
        nothing = np.full(one.depth.shape, np.nan)
        maps = [found.get(one.index, nothing) for found in depths.values()]
        cells = [one.image, *(colour_depth(depth, near, far) for depth in maps)]
        if truths:
            truth = truths.get(one.index, nothing)
            cells.insert(1, colour_depth(truth, near, far))
            cells += [colour_error(depth, truth) for depth in maps]
        rows[label(one.index)] = cells
    names = [*variants]
    columns = ["input", "ground truth", *names, *(f"error, {name}" for name in names)]
    unit = "depth, m" if truths else "depth over its median of these frames (no unit)"
    bars = [depth_bar(near, far, unit), error_bar()]
    if not truths:
        columns, bars = ["input", *names], bars[:1]
    return FrameGrid(columns, rows, bars, alt)


def _over_median(depths: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    values = [d[np.isfinite(d) & (d > 0)] for d in depths.values()]
    joined = np.concatenate([v for v in values if v.size] or [np.ones(1)])
    return {index: depth / np.median(joined) for index, depth in depths.items()}


def depth_bar(near: float, far: float, label: str) -> ColourBar:
    """The colours of colour_depth between near and far, in their unit; the scale is logarithmic."""
    colours = colour_depth(np.geomspace(near, far, STOPS)[None], near, far)[0]
    ticks = {share: near * (far / near) ** share for share in (0.0, 0.25, 0.5, 0.75, 1.0)}
    return ColourBar(label, colours, {share: f"{value:.2g}" for share, value in ticks.items()})


def error_bar() -> ColourBar:
    """The colours of colour_error."""
    errors = np.linspace(0, MAX_ERROR, STOPS)[None]
    colours = colour_error(1 + errors, np.ones_like(errors))[0]
    top = f"{MAX_ERROR:.0%} and more"
    return ColourBar(ERROR_UNIT, colours, {0.0: "0", 0.5: f"{MAX_ERROR / 2:.0%}", 1.0: top})


def grid_html(grid: FrameGrid) -> str:
    """The grid for a report; narrow windows break each row in two."""
    cells = []
    for number, (label, pictures) in enumerate(grid.rows.items()):
        for column, picture in enumerate(pictures):
            data = base64.b64encode(encode_picture(picture, ".jpg")).decode("ascii")
            name = grid.columns[column]
            alt = escape(f"{grid.alt}, {label}: {name}", quote=True)
            mark = f"<b>{escape(label)}</b>" if column == 0 else ""
            cells.append(
                f"<figure{'' if number else ' class=first'}><figcaption>{escape(name)}"
                f'</figcaption><img alt="{alt}" src="data:image/jpeg;base64,{data}">{mark}</figure>'
            )
    count = len(grid.columns)
    half = count if count <= 3 else math.ceil(count / 2)
    return (
        f'<div class="frames" style="--columns:{count};--half:{half}">{"".join(cells)}</div>'
        f'<div class="bars">{"".join(map(_bar_html, grid.bars))}'
        '<span class="none"><i></i>no value</span></div>'
    )


def _bar_html(bar: ColourBar) -> str:
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*colour) for colour in bar.colours)
    ticks = "".join(f"<span>{escape(text)}</span>" for text in bar.ticks.values())
    return (
        f'<div class="bar"><span>{escape(bar.label)}</span>'
        f'<i style="background:linear-gradient(90deg,{stops})"></i><div>{ticks}</div></div>'
    )


def grid_picture(grid: FrameGrid) -> np.ndarray:
    """The grid as one picture with captions and colour bars, H x W x 3 uint8 RGB."""
    width = next(iter(grid.rows.values()))[0].shape[1] + GAP
    rows = [_captions(grid.columns, width)]
    for label, pictures in grid.rows.items():
        cells = [np.pad(p, ((1, 1), (1, 1), (0, 0))) for p in pictures]
        corner = (5, cells[0].shape[0] - 7)
        _write(cells[0], label, corner, thickness=3)
        _write(cells[0], label, corner, (255, 255, 255))
        rows.append(np.hstack(cells))
    return np.vstack([*rows, draw_bars(grid.bars, width * len(grid.columns))])


def _captions(names: Sequence[str], width: int) -> np.ndarray:
    bar = np.full((CAPTION, width * len(names), 3), PAPER, np.uint8)
    for column, name in enumerate(names):
        text = np.full((CAPTION, width - 4, 3), PAPER, np.uint8)  # a long name ends at its column
        _write(text, name, (2, 16))
        bar[:, column * width + 2 : column * width + width - 2] = text
    return bar


def draw_bars(bars: Sequence[ColourBar], width: int) -> np.ndarray:
    """Colour bars side by side with their labels and ticks, BAR x width x 3 uint8 RGB."""
    drawn = np.full((BAR, width, 3), PAPER, np.uint8)
    room = width // len(bars)
    for number, bar in enumerate(bars):
        left, length = number * room + 4, max(room - 50, 20)
        places = np.linspace(0, len(bar.colours) - 1, length).round().astype(int)
        drawn[18:28, left : left + length] = bar.colours[places]
        _write(drawn, bar.label, (left, 12))
        for share, text in bar.ticks.items():
            _write(
                drawn, text, (left + int(share * (length - 1)) - round(3.5 * len(text) * share), 41)
            )
    return drawn


def _write(
    image: np.ndarray,
    text: str,
    corner: tuple[int, int],
    colour: tuple[int, int, int] = (0, 0, 0),
    thickness: int = 1,
) -> None:
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.42
    cv2.putText(image, text, corner, font, size, colour, thickness, cv2.LINE_AA)


class FrameStrip:
    """Keeps a few evenly spaced frames of a sequence.

    quantity: what is added as depth; disparity is drawn as the inverse of the aligned one.
    """

    def __init__(
        self, expected_frames: int, count: int = 6, width: int = 240, quantity: str = DEPTH
    ) -> None:
        self.quantity = quantity
        last = max(expected_frames - 1, 0)
        self.wanted = {round(i) for i in np.linspace(0, last, min(count, last + 1))}
        self.width = width
        self.snapshots: list[DepthSnapshot] = []

    def add(
        self, index: int, image: np.ndarray, depth: np.ndarray, truth: np.ndarray | None
    ) -> None:
        """Keep the frame if it is one of the wanted ones; arrays as in DepthSnapshot, any size."""
        if index not in self.wanted:
            return
        self.snapshots.append(snapshot(index, image, depth, truth, self.width))

    def shown(self, scale: float = 1.0, shift: float = 0.0) -> ShownFrames:
        """The kept frames, aligned by one scale and shift."""
        return ShownFrames(self.snapshots, scale, shift, self.quantity)

    def draw(self, scale: float = 1.0, shift: float = 0.0) -> np.ndarray:
        """One row a frame: input, ground truth, depth, error (the middle and last need truth).

        scale, shift: one alignment for all frames (the video protocol's), so that drift shows.
        Returns H x W x 3 uint8 RGB. Raises ValueError when no frame was kept.
        """
        return grid_picture(frame_grid({"depth": self.shown(scale, shift)}))
