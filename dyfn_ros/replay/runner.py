"""Frames through the stream session that the node runs."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.session import StreamSession
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.replay.pose_feed import PoseFeed
from dyfn_ros.replay.reader import ReferenceFeed
from dyfn_ros.replay.settings import Run

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

_RESET_LINES = 100  # of the first resets; all of them are counted


@dataclass(frozen=True)
class RunFrame:
    """A frame and what the stream made of it.

    Attributes:
        frame: As it was read.
        prediction: The stream's output, at the image's resolution.
        stamp: Seconds.
        latency: Seconds that the stream took.
    """

    frame: RecordedFrame
    prediction: Prediction[np.ndarray]
    stamp: float
    latency: float


class StreamRunner:
    """One stream session over the frames of a recording."""

    def __init__(
        self,
        run: Run,
        model: GeometryModel,
        references: ReferenceFeed | None,
        poses: PoseFeed | None = None,
    ) -> None:
        """Start the session; a saved state is loaded.

        Args:
            run: The options.
            model: As load_model returns it.
            references: Measurements for the metric scale; None: there are none.
            poses: Of the camera; None: unknown.

        Raises:
            ValueError: An option is wrong, or the state does not fit (StateError).
        """
        self._run, self._references, self._poses = run, references, poses
        self._session = StreamSession(model, run.stream)
        self._state: dict[str, str] = {}
        self._reset_lines: list[str] = []
        if run.save_state:
            _check_folder(run.stream.state_file)
        if run.load_state:
            self._state["loaded"] = self._session.load()

    def frames(self, frames: Iterable[RecordedFrame]) -> Iterator[RunFrame]:
        """Push frames, one at a time.

        Args:
            frames: In order.

        Yields:
            Each frame with the session's output.
        """
        for frame in frames:
            if self._poses is not None:
                self._poses.look(frame)
            start = time.perf_counter()
            stamp = _seconds(frame)
            if self._references is not None:
                for when, reference in self._references.before(frame):
                    self._session.add_reference(when, reference)
            placed = None if self._poses is None else self._poses.pose(frame)
            pushed = Frame(
                frame.image,
                stamp,
                frame.camera_matrix,
                frame.visible,
                frame.frame_id,
                None if placed is None else placed.pose,
                None if placed is None else placed.variance,
            )
            prediction = self._session.push(pushed)
            if prediction.reset and len(self._reset_lines) < _RESET_LINES:
                self._reset_lines.append(self._session.last_reset)
            yield RunFrame(frame, prediction, stamp, time.perf_counter() - start)

    def skip(self, frame: RecordedFrame) -> None:
        """A frame between the last one and the next that is not worked on: it may begin another
        scene."""
        self._session.skip(Frame(frame.image, _seconds(frame), frame_id=frame.frame_id))

    @property
    def metres_per_unit(self) -> float | None:
        """See StreamSession.metres_per_unit."""
        return self._session.metres_per_unit

    def finish(self) -> None:
        """Save the state, if that is asked for. Raises StateError."""
        if self._run.save_state:
            self._state["saved"] = self._session.save()

    def facts(self) -> dict[str, Any]:
        """What metrics.json has of the session: resets, metric scale, saved state."""
        found: dict[str, Any] = {"resets": dict(self._session.resets)}
        if unusable := self._session.unusable_pictures:
            found["pictures_without_depth"] = dict(unusable)
        if self._reset_lines:
            found["reset_log"] = self._reset_lines
        if self._run.stream.metric_source != "none":
            found["metric_scale"] = self._session.scale.described()
        if self._poses is not None and (facts := self._poses.facts()):
            found["odometry"] = facts
        return {**found, **({"state": self._state} if self._state else {})}

    def warnings(self) -> dict[str, int]:
        """What a user should look at, with how often."""
        found = dict.fromkeys(self._session.problems(), 1)
        for reason, count in sorted(self._session.unusable_pictures.items()):
            found[f"pictures without depth: {reason}"] = count
        if self._poses is not None:
            found |= self._poses.warnings()
            for reason, count in sorted(self._session.unused_references.items()):
                found[f"odometry: frames without points: {reason}"] = count
        if self._references is None:
            return found
        topic = self._references.topic.name
        if self._references.is_truth:
            found[f"{topic} is both the reference and the ground truth of the scores"] = 1
        for reason, count in sorted(self._session.unused_references.items()):
            found[f"{topic}: measurements or points not used: {reason}"] = count
        return found

    def doubts(self) -> list[str]:
        """What makes the poses implausible, a sentence each."""
        return [] if self._poses is None else self._poses.doubts()

    def losses(self) -> dict[str, int]:
        """Measurements and poses that could not be read, with how often."""
        found = {} if self._poses is None else self._poses.losses()
        return found | ({} if self._references is None else self._references.losses())


def _seconds(frame: RecordedFrame) -> float:
    seconds, nanoseconds = divmod(frame.stamp_ns, 1_000_000_000)
    return seconds + nanoseconds * 1e-9


def _check_folder(state_file: str) -> None:
    """A long run must not end with a state that cannot be saved."""
    folder = Path(state_file).expanduser().parent
    if not folder.is_dir():
        raise ValueError(f"state_file is {state_file!r}, but {folder} is no folder")
