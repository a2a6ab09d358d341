"""Each line of docs/recordings.md that says what becomes of a recording holds."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from dyfn_core.scoring.plausibility import Plausibility
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import Recording
from dyfn_ros.recordings.open import open_recording
from tests.support.formats_of_bags import BAGS, COUNT, Maker
from tests.support.formats_of_folders import FOLDERS
from tests.support.formats_of_messages import FILES, MESSAGES
from tests.support.formats_of_other_folders import OTHER_FOLDERS
from tests.support.numbered import numbers

PAGE = Path(__file__).parents[3] / "docs" / "recordings.md"
MAKERS: dict[str, Maker] = {**BAGS, **FILES, **MESSAGES, **FOLDERS, **OTHER_FOLDERS}


class Line(NamedTuple):
    """what: the recording. becomes: read, images, doubted, part or refused. said: of a message."""

    what: str
    becomes: str
    said: str


def documented() -> list[Line]:
    """The lines of the tables whose middle column is one of the words."""
    row = re.compile(r"\| (.+?) \| (read|images|doubted|part|refused) \| ?(.*?) ?\|")
    return [
        Line(*match.groups())
        for match in map(row.fullmatch, PAGE.read_text().splitlines())
        if match
    ]


def said_by(recording: Recording) -> tuple[list[int | None], list[str]]:
    """Numbers of the frames' depths, unless these are wrong, and all that is said."""
    frames = list(recording.frames())
    plausible = Plausibility(len(frames))
    for frame in frames:
        plausible.push(frame.image, frame.depth, frame.stamp_ns, frame.camera_matrix)
    said = [*recording.notes.warnings, *recording.doubts(), *plausible.warnings(None)]
    try:
        found = numbers(frames)
    except AssertionError:  # of other values than the frames'
        found = [-1] * len(frames)
    return found, said


def test_the_lists_are_the_same() -> None:
    assert [line.what for line in documented()] == [*MAKERS]


@pytest.mark.parametrize("line", documented(), ids=lambda line: line.what)
def test_a_recording_becomes_what_is_documented(tmp_path: Path, line: Line) -> None:
    expected = [part.strip("`") for part in line.said.split(" ... ") if part]
    folder = tmp_path / "made"
    folder.mkdir()
    path = MAKERS[line.what](folder)
    if line.becomes == "refused":
        with pytest.raises(RecordingError) as caught:
            for _ in open_recording(path).frames():
                pass
        assert all(part in str(caught.value) for part in expected), caught.value
        return
    recording = open_recording(path)
    found, said = said_by(recording)
    losses = [*recording.notes.losses]
    wanted = {"read": [*range(COUNT)], "images": [None] * COUNT}.get(line.becomes)
    assert wanted is None or found == wanted, (found, said, losses)
    assert bool(losses) == (line.becomes == "part"), losses
    if not expected:
        assert not said
    told = " | ".join([*said, *losses])
    assert all(part in told for part in expected), told
