"""One camera of the node: its topics, its calibration, its stream, its numbers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.depth_stream import DepthStream
from dyfn_core.stream.saving import StateError, check_folder, path_for
from dyfn_core.stream.session import ResetRequest, StreamSession
from dyfn_ros.messages.compressed_image import decode_compressed
from dyfn_ros.messages.encodings import doubted_bits
from dyfn_ros.messages.images import MessageError, decode_image
from dyfn_ros.messages.rectify import Rectifier, RectifyRules, is_rectified
from dyfn_ros.node.metric_scale import ScaleTopics
from dyfn_ros.node.odometry import OdometryTopic, TransformTopics
from dyfn_ros.node.outputs import NodeOutputs
from dyfn_ros.node.pace import Pace
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.recent_jobs import RecentJobs
from dyfn_ros.node.statistics import FrameStatistics
from dyfn_ros.node.topics import NodeTopics

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

_SENSOR_DEPTH = 5
_LOOK_TIME = 0.1  # seconds before each frame for looks at the dropped ones

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class FrameJob:
    """One image on its way to inference.

    info: the newest CameraInfo when the image came. asked: the resets asked for before it came.
    arrived: time.monotonic().
    """

    camera: Camera
    message: Any
    info: Any
    asked: ResetRequest
    arrived: float


class Camera:
    """The callbacks only store and `submit`; the inference thread calls the other methods.

    name: "" for a camera without a name of its own. settings: the values in force, asked for
    each frame. transforms: of all cameras. submit: takes a Job, -> whether it was accepted.
    release: a CameraInfo has come. warn: for what costs a frame its use. told_reset: takes each
    reset's line. state_folder: where state files may be, unless the settings say.
    """

    def __init__(
        self,
        node: LifecycleNode,
        ports: NodeTopics,
        name: str,
        settings: Callable[[], NodeSettings],
        transforms: TransformTopics,
        submit: Callable[[FrameJob], bool],
        release: Callable[[], None],
        warn: Say,
        error: Say,
        told_reset: Say,
        state_folder: str = "",
    ) -> None:
        self.name = name
        full = node.get_fully_qualified_name().lstrip("/")
        self.title = f"{full}: {name}" if name else full
        self.statistics = FrameStatistics()
        self.active = False
        self.abandoned = False  # the node has ended; a frame that is still worked on is lost
        self.session: StreamSession | None = None  # once there is a model
        infos = (f"{one}/camera_info" if one else "camera_info" for one in settings().cameras)
        inputs = {node.resolve_topic_name(one) for one in infos}
        self.outputs = NodeOutputs(ports, self.prefix, not settings().drop_frames, inputs)
        self._node, self._settings = node, settings
        self._submit, self._release, self._warn, self._error = submit, release, warn, error
        self._told_reset = told_reset
        self._info: CameraInfo | None = None
        self._faults: list[str] = []
        self._came: RecentJobs[FrameJob] = RecentJobs()  # with drop_frames: what may be dropped
        self._placed: Frame | None = None  # the begun frame, if its pose was wanted at once
        self._state_folder = settings().state_folder or state_folder
        self._pace = Pace()
        self._subscribe(ports)
        self._calibrator = Rectifier(lambda text: warn(f"{self.info_topic}: {text}"))
        self.scale_topics = ScaleTopics(
            ports, self.prefix, (self.title, self.hardware_id), settings(), transforms
        )
        self.odometry = OdometryTopic(ports, self.prefix, settings(), transforms)

    @property
    def prefix(self) -> str:
        """Before the names of its topics and services."""
        return f"{self.name}/" if self.name else ""

    @property
    def settings(self) -> NodeSettings:
        """The values in force."""
        return self._settings()

    def _subscribe(self, ports: NodeTopics) -> None:
        settings = self.settings
        kinds, follow = ReliabilityPolicy, settings.reliability == "auto"
        qos = QoSProfile(
            depth=_SENSOR_DEPTH if settings.drop_frames else settings.queue_size,
            history=HistoryPolicy.KEEP_LAST,
            reliability=kinds.RELIABLE if settings.reliability == "reliable" else kinds.BEST_EFFORT,
        )
        topic, kind = f"{self.prefix}image", Image
        if settings.image_transport == "compressed":
            # Beside the image topic, also when that is remapped, as image_transport has it.
            topic, kind = f"{self._node.resolve_topic_name(topic)}/compressed", CompressedImage
        count = self.statistics.count
        self._images = ports.follow(
            kind, topic, self._on_image, qos, follow, lambda number: count("lost", number)
        )
        infos = f"{self.prefix}camera_info"
        self.info_topic = ports.follow(
            CameraInfo, infos, self._on_info, qos, follow, lambda number: None
        ).topic
        self._latched_info = ports.latched(CameraInfo, infos, self._on_info)

    @property
    def image_topic(self) -> str:
        """Resolved."""
        return self._images.topic

    @property
    def hardware_id(self) -> str:
        """Of diagnostics: what tells this camera from those of other nodes."""
        return self.image_topic

    @property
    def device(self) -> str:
        """That its model runs on; "" before there is one."""
        return "" if self.session is None else str(self.session.model.device)

    @property
    def reliable(self) -> bool:
        """Whether lost images are sent again."""
        return self._images.reliable

    # Executor's thread: nothing here waits for inference.

    def _on_info(self, info: CameraInfo) -> None:
        self._info = info
        self._release()

    def _on_image(self, message: Any) -> None:
        self.statistics.count("received" if self.active else "inactive")
        session = self.session
        if not self.active or session is None:
            self._came.clear()
            return
        if self._info is None:
            self._latched_info.check()
            if self.waits_for_info:
                self._warn(f"{self.image_topic}: {self.waiting}")
        job = FrameJob(self, message, self._info, session.asked, time.monotonic())
        settings = self.settings
        if settings.drop_frames or settings.max_rate:
            self._came.add(job)
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        if not self._pace.takes(settings.max_rate, stamp, job.arrived):
            self.statistics.count("skipped")
            return
        if not self._submit(job):
            self._error(
                f"{self.image_topic}: queue_size of {self.settings.queue_size} frames is "
                "full, newer frames are lost; play slower or raise it",
            )

    @property
    def waits_for_info(self) -> bool:
        """Whether frames are held until a CameraInfo comes."""
        return self._info is None and self.settings.wait_for_camera_info

    @property
    def waiting(self) -> str:
        """What holds the frames, in words."""
        return f"frames are held until a CameraInfo comes on {self.info_topic}"

    def request_reset(self, reason: str) -> None:
        """Frames that came before this call never touch the state after it. Any thread."""
        if self.session is not None:
            self.session.request_reset(reason)

    # Any thread.

    @property
    def resets(self) -> dict[str, int]:
        """How often the stream was reset, by reason."""
        return {} if self.session is None else dict(self.session.resets)

    def calibrate(self) -> str:
        """-> what is awaited. Raises ValueError when nothing is measured."""
        return self._opened().request_calibration()

    def save_state(self) -> str:
        """-> what was saved. Raises StateError."""
        return self._opened().save(self._state_file())

    def load_state(self) -> str:
        """As request_reset, with the state of a file. -> what was loaded. Raises StateError."""
        session = self._opened()
        session.options = self.settings
        return session.load(self._state_file())

    def _opened(self) -> StreamSession:
        if self.session is None:
            raise StateError("the model is not loaded yet")
        return self.session

    def _state_file(self) -> str:
        settings = self.settings
        path = path_for(settings.state_file, self.name, len(settings.cameras) > 1)
        check_folder(path, self._state_folder)
        return path

    # Inference thread.

    def open_stream(self, model: GeometryModel) -> None:
        """Once, before the first frame. Raises ValueError when a metric setting is unusable."""
        session = StreamSession(model, self.settings)
        _ = session.fingerprint  # takes seconds for a large model, which nobody waits for here
        self.scale_topics.open(session, self.settings, self._warn)
        self.odometry.open(self.settings, self._warn)
        self.session = session

    def open_outputs(self) -> None:
        """Once the stream is open: the topics that not every model fills."""
        if self._opened().model.has_normals:
            self.outputs.advertise_normals()

    def decode(self, job: FrameJob) -> tuple[Frame, CameraInfo | None]:
        """-> the frame and the CameraInfo that describes it as it now is.

        Raises MessageError when the image, or its lens, cannot be used.
        """
        settings = self.settings
        compressed = settings.image_transport == "compressed"
        most = round(settings.max_megapixels * (1 << 20))
        if compressed:
            image = decode_compressed(job.message, most, settings.image_bits, self._damaged)
        else:
            image = decode_image(job.message, most, settings.image_bits)
        kind = str(job.message.format if compressed else job.message.encoding)
        if doubt := doubted_bits(kind, image, settings.image_bits):
            self._warn(f"{self.image_topic}: {doubt}, set image_bits:=12")
        header = job.message.header
        view = self._calibrator.view(
            image,
            header.frame_id,
            job.info or self._info,
            RectifyRules(
                settings.rectified or is_rectified(self.image_topic),
                settings.distortion,
                settings.check_frame_id,
            ),
        )
        frame = Frame(
            image=view.image,
            stamp=header.stamp.sec + header.stamp.nanosec * 1e-9,
            camera_matrix=view.matrix,
            visible=view.visible,
            frame_id=header.frame_id,
        )
        return frame, view.info

    def _damaged(self, text: str) -> None:
        self.statistics.count("damaged")
        self._warn(f"{self.image_topic}: {text}")

    def begin(self, job: FrameJob, frame: Frame) -> DepthStream:
        """-> the DepthStream that the frame goes into."""
        session = self._opened()
        session.options = self.settings
        session.normals = self.outputs.wants_normals(self.settings)
        self._look_at_dropped(session, job)
        self._placed = None

        def place(frame: Frame) -> Frame:
            self._placed = self._place(job, frame)
            return self._placed

        return session.begin(frame, job.asked, place)

    def _look_at_dropped(self, session: StreamSession, job: FrameJob) -> None:
        """Let the session see the pictures that came since the frame before, and were dropped."""
        if not self.settings.scene_cut_threshold:
            self._came.clear()
            return
        until = time.monotonic() + _LOOK_TIME
        for dropped in self._came.before(job):
            if time.monotonic() > until:
                return
            try:
                session.skip(self.decode(dropped)[0])
            except MessageError:
                pass  # a bad image; it is counted as dropped
            except Exception as error:
                self._warn(f"{self.image_topic}: no look at a dropped picture: {error}")

    def _place(self, job: FrameJob, frame: Frame) -> Frame:
        until = job.arrived + self.settings.odometry_wait
        return self.odometry.placed(frame, job.message.header, until)

    def end(self, job: FrameJob, frame: Frame, prediction: Prediction) -> Prediction[np.ndarray]:
        """-> what to publish."""
        session, placed = self._opened(), self._placed
        frame = self._place(job, frame) if placed is None else placed
        found = session.end(frame, prediction)
        faults = session.faults()
        self._tell(faults)
        self.scale_topics.publish(session.scale, faults)
        return found

    def _tell(self, faults: list[str]) -> None:
        """A line in the log when frames stop having depth, and when they have it again."""
        if faults != self._faults:
            text = "; ".join(faults)
            if text:
                self._error(f"{self.image_topic}: {text}; no depth while it lasts")
            else:
                self._warn(f"{self.image_topic}: the pictures show a scene again")
        self._faults = faults

    def publish(
        self, job: FrameJob, frame: Frame, info: CameraInfo | None, found: Prediction[np.ndarray]
    ) -> None:
        """Everything that somebody wants of a finished frame."""
        header = job.message.header
        if found.reset:
            self.outputs.publish_reset(header, self.title, found.reset, self.resets)
            assert self.session is not None
            self._told_reset(f"{self.image_topic}: the stream is reset {self.session.last_reset}")
        self.statistics.valid_ratio = self.outputs.publish(
            header, frame.image, found, info, self.settings
        )
        stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        self.statistics.published(
            (self._node.get_clock().now().nanoseconds - stamp) * 1e-9,
            time.monotonic() - job.arrived,
        )

    def bad(self, job: FrameJob, error: MessageError) -> None:
        """The job's image cannot be used."""
        self.statistics.count("bad")
        self._warn(f"{self.image_topic}: {error}")

    def failed(self, job: FrameJob, error: Exception) -> None:
        """The network, or publishing, failed on the job."""
        if self.session is not None:
            self.session.fail()
        if self.abandoned or not self._node.context.ok():  # nobody to publish to
            self.statistics.count("unpublished")
            return
        self.statistics.count("failed")
        text = f"{self.image_topic}: inference failed, the stream resets"
        self._error(f"{text}: {type(error).__name__}: {error}")
