"""How many stored values of depth are a metre, and what hints at it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from dyfn_core.data.rgbd.cameras import published_camera
from dyfn_core.data.rgbd.names import FIRST_TIME, times_in, visible_files

MILLIMETRES, TUM_UNIT = 1000.0, 5000.0  # stored depth values per metre
SETTINGS_SUFFIXES, LONGEST_SETTINGS = (".json", ".yaml", ".yml"), 1 << 16
_DEPTH_SCALE = re.compile(
    r"(?i)(?:\b(?:png_)?depth_?(?:scale|map_?factor)|\bscale)\"?\s*[:=]\s*(\d+\.?\d*(?:e[+-]?\d+)?)"
)


def signs_of_another(folder: Path, images: Sequence[Path]) -> Iterator[str]:
    """What says that the depth of a folder is not in millimetres.

    Args:
        folder: of a layout without lists.
        images: those of its colour files that have depth.

    Yields:
        Sentences.
    """
    times = times_in(images)
    if times and any(time > FIRST_TIME and time % 1 for time in times):
        yield "files named by times, as TUM RGB-D's are, whose depth has 5000 values a metre"
    elif published_camera(folder) is not None or next(folder.glob("*.freiburg"), None):
        yield "a folder as of TUM RGB-D or ICL-NUIM, whose depth has 5000 values a metre"
    for path in visible_files(folder):
        settings = path.suffix.lower() in SETTINGS_SUFFIXES and path.is_file()
        if settings and path.stat().st_size < LONGEST_SETTINGS:
            said = _DEPTH_SCALE.search(path.read_text("utf-8", "replace"))
            if said and float(said.group(1)) not in (0.0, MILLIMETRES, 1 / MILLIMETRES):
                yield f"{path.name} says {said.group(0)!r}, which may be of the depth"
