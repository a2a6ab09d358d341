"""The ROS 2 node `stream_depth`: images in, depth and clouds out, one frame after the other."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_srvs.srv import Trigger

from dyfn_ros import messages
from dyfn_ros.camera_stream import CameraStream, Geometry, stream_maker
from dyfn_ros.environment import prepare_environment
from dyfn_ros.messages import MessageError
from dyfn_ros.parameters import NodeParameters, Settings, usage
from dyfn_ros.throttle import Throttle
from dyfn_ros.worker import FrameWorker

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

ModelLoader = Callable[[str, str], "GeometryModel"]

_SENSOR_DEPTH = 5
_OUTPUT_DEPTH = 5
_LOSSLESS_DEPTH = 100  # of the outputs; a cloud of 640 x 480 is 10 MB
_PATIENCE = 4.0  # seconds; ROS launch loses its own after 5


@dataclass(frozen=True)
class Job:
    """One image on its way to inference.

    info: the newest CameraInfo when the image came. epoch: resets before it came.
    """

    message: Any
    info: Any
    epoch: int


@dataclass
class Counts:
    """Frames since the start.

    bad: not decodable. failed: inference raised. unpublished: the shutdown came first.
    """

    received: int = 0
    published: int = 0
    bad: int = 0
    failed: int = 0
    unpublished: int = 0


def load_bundled(name: str, device: str) -> GeometryModel:
    """load_model, with its imports (seconds) made where nobody waits for them."""
    from dyfn_core.models import load_model

    return load_model(name, device=device)


class StreamDepthNode(Node):
    """Topics, service and parameters: docs/node.md.

    Callbacks only store and queue; decoding, inference and publishing happen in one worker
    thread. `model_failed` is done, with the reason, when the model could not be loaded.
    """

    def __init__(self, load: ModelLoader = load_bundled, **node_options: Any) -> None:
        super().__init__("stream_depth", **node_options)
        self._table = NodeParameters(self)
        settings = self._table.settings
        self._load = load
        self._throttle = Throttle()
        self._camera: CameraStream
        self._info: CameraInfo | None = None
        self._epoch = 0
        self.counts = Counts()
        self.model_failed: Future = Future()
        self.worker: FrameWorker[Job] = FrameWorker(
            self._work,
            prepare=self._load_model,
            failed=lambda error: self.model_failed.set_result(error),
            keep_all=not settings.drop_frames,
            capacity=settings.queue_size,
            held=settings.wait_for_camera_info,
        )
        self._advertise()
        self._subscribe(settings)
        self.worker.start()

    @property
    def settings(self) -> Settings:
        return self._table.settings

    def _warn(self, text: str) -> None:
        if line := self._throttle(text):
            self.get_logger().warning(line)

    def _error(self, text: str) -> None:
        if line := self._throttle(text):
            self.get_logger().error(line)

    def _advertise(self) -> None:
        self._depth = self._publisher(Image, "~/depth/image")
        self._depth_info = self._publisher(CameraInfo, "~/depth/camera_info")
        self._points = self._publisher(PointCloud2, "~/points")
        self.create_service(Trigger, "~/reset", self._on_reset)

    def _publisher(self, kind: type, topic: str) -> Publisher:
        depth = _OUTPUT_DEPTH if self.settings.drop_frames else _LOSSLESS_DEPTH
        return self.create_publisher(
            kind,
            topic,
            QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _subscribe(self, settings: Settings) -> None:
        if settings.image_transport == "compressed":
            # Beside the image topic, also when that is remapped, as image_transport has it.
            topic = f"{self.resolve_topic_name('image')}/compressed"
            self._images = self._subscription(CompressedImage, topic, self._on_image)
        else:
            self._images = self._subscription(Image, "image", self._on_image)
        self._infos = self._subscription(CameraInfo, "camera_info", self._on_info)

    def _subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None]
    ) -> Subscription:
        settings = self.settings
        best_effort = not settings.reliable
        qos = QoSProfile(
            depth=_SENSOR_DEPTH if settings.drop_frames else settings.queue_size,
            history=HistoryPolicy.KEEP_LAST,
            reliability=(
                ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
            ),
        )
        options = QoSOverridingOptions.with_default_policies()
        return self.create_subscription(kind, topic, callback, qos, qos_overriding_options=options)

    # Executor's thread: nothing here waits for inference.

    def _on_info(self, info: CameraInfo) -> None:
        self._info = info
        self.worker.release()

    def _on_image(self, message: Any) -> None:
        self.counts.received += 1
        if not self.worker.submit(Job(message, self._info, self._epoch)):
            self._error(
                f"{self._images.topic_name}: queue_size of {self.settings.queue_size} frames is "
                "full, newer frames are lost; play slower or raise it",
            )

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Frames that came before the reset never touch the state after it."""
        self._epoch += 1
        dropped = self.worker.discard() if self.settings.drop_frames else 0
        response.success = True
        response.message = f"the next frame starts anew ({dropped} waiting frames dropped)"
        self.get_logger().info(f"reset {self._epoch}: {response.message}")
        return response

    # Worker's thread.

    def _load_model(self) -> None:
        import torch

        settings = self.settings
        if settings.threads:
            torch.set_num_threads(settings.threads)
        device = settings.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        model = self._load(settings.model, device)

        self._camera = CameraStream(stream_maker(model))
        if self.context.ok():  # loading takes long enough to be interrupted
            self.get_logger().info(
                f"{settings.model} on {device}; depth is right up to one scale, which is not metres"
            )

    def _work(self, job: Job) -> None:
        """One frame; whatever goes wrong with it, the next one is tried."""
        try:
            self._process(job)
        except MessageError as error:
            self.counts.bad += 1
            self._warn(f"{self._images.topic_name}: {error}")
        except Exception as error:
            if not self.context.ok():  # shut down under our feet: there is nobody to publish to
                self.counts.unpublished += 1
                return
            self.counts.failed += 1
            text = f"{self._images.topic_name}: inference failed, the stream starts anew"
            self._error(f"{text}: {type(error).__name__}: {error}")

    def _process(self, job: Job) -> None:
        settings = self.settings
        decode = messages.decode_image
        if settings.image_transport == "compressed":
            decode = messages.decode_compressed
        image = decode(job.message)
        info, matrix = self._calibration(job, image)
        stamp = job.message.header.stamp
        geometry = self._camera.push(
            image,
            matrix,
            stamp=stamp.sec + stamp.nanosec * 1e-9,
            epoch=job.epoch,
            stabilize=settings.stabilize,
            num_tokens=settings.num_tokens,
        )
        self._publish(job.message.header, image, geometry, info)
        self.counts.published += 1

    def _calibration(
        self, job: Job, image: np.ndarray
    ) -> tuple[CameraInfo | None, np.ndarray | None]:
        """The CameraInfo and intrinsics to use, or neither and a warning that says why."""
        info = job.info or self._info
        if info is None:
            return None, None
        topic = self._infos.topic_name
        try:
            rectified = self.settings.rectified
            calibration = messages.decode_camera_info(info, *image.shape[:2], rectified=rectified)
        except MessageError as error:
            self._warn(f"{topic}: {error}; going on without intrinsics")
            return None, None
        if calibration.distorted:
            self._warn(
                f"{topic}: the lens is distorted (D is not 0), which is not undone here; "
                "rectified images (parameter `rectified`) give better geometry",
            )
        return info, calibration.matrix

    def _publish(
        self, header: Any, image: np.ndarray, geometry: Geometry, info: CameraInfo | None
    ) -> None:
        """Each message is built only when somebody subscribes."""
        settings = self.settings
        valid = in_range(geometry, settings.min_depth, settings.max_depth)
        if settings.publish_depth:
            if self._depth.get_subscription_count():
                self._depth.publish(messages.depth_message(header, geometry.depth, valid))
            if self._depth_info.get_subscription_count():
                self._depth_info.publish(_sibling_info(header, info, geometry))
        if settings.publish_points and self._points.get_subscription_count():
            cloud = messages.pack_cloud(geometry.points, valid, image)
            self._points.publish(messages.cloud_message(header, cloud))

    def close(self) -> bool:
        """Stop the worker and say what became of the frames. -> whether the worker is done."""
        done = self.worker.stop(_PATIENCE)
        logger, counts = self.get_logger(), self.counts
        self.destroy_node()  # first: a signal has ended the context that rosout needs
        dropped = self.worker.dropped + counts.unpublished
        logger.info(
            f"{counts.received} frames received, {counts.published} worked on, {dropped} dropped, "
            f"{counts.bad} bad, {counts.failed} failed; {self._epoch} resets"
        )
        return done


def in_range(geometry: Geometry, near: float, far: float) -> np.ndarray:
    """H x W bool: valid and near <= depth <= far; far 0 is no limit."""
    valid = geometry.valid & (geometry.depth >= near)
    return valid & (geometry.depth <= far) if far else valid


def _sibling_info(header: Any, info: CameraInfo | None, geometry: Geometry) -> CameraInfo:
    """The camera_info beside the depth image: the camera's own, or the model's estimate."""
    if info is None:
        height, width = geometry.depth.shape
        return messages.camera_info_message(header, geometry.camera_matrix, height, width)
    sibling = copy.copy(info)
    sibling.header = header
    return sibling


def _start(args: Sequence[str] | None, load: ModelLoader) -> StreamDepthNode | None:
    """The node; None, and the reason on stderr, when ROS or the parameters do not allow one."""
    try:
        usage(sys.argv if args is None else args)
        rclpy.init(args=None if args is None else list(args))
        return StreamDepthNode(load)
    except (ParameterException, RuntimeError) as error:  # RuntimeError: what rcl does not accept
        print(f"stream_depth: {error}", file=sys.stderr)
        return None


def _spin(node: StreamDepthNode) -> int:
    """Until the context ends or the model fails. -> exit code."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin_until_future_complete(node.model_failed)
    if not node.model_failed.done():
        return 0
    node.get_logger().fatal(f"cannot run: {node.model_failed.result()!r}")
    return 1


def main(args: Sequence[str] | None = None, load: ModelLoader = load_bundled) -> int:
    """-> exit code: 0 after SIGINT or SIGTERM, 1 when the node cannot run.

    args: the command line; None takes sys.argv. load: (name, device) -> model.
    """
    prepare_environment()
    node: StreamDepthNode | None = None
    code = 0
    try:
        node = _start(args, load)
        code = 1 if node is None else _spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    done = node is None or node.close()
    rclpy.try_shutdown()
    if not done:  # a download, or a huge model: the interpreter cannot end under a running thread
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
