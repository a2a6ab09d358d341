"""The lifecycle node `stream_depth`: several cameras, one model, one inference thread."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from dyfn_core.models import load_model, resolve_device
from dyfn_core.models.export.backends import kept_exports, on_backend
from dyfn_core.stream.resets import RESET_SERVICE, TIME_JUMP
from dyfn_core.stream.saving import StateError
from dyfn_ros.node.camera import Camera, FrameJob
from dyfn_ros.node.diagnostics import Report, node_diagnostics
from dyfn_ros.node.file_work import FileWork
from dyfn_ros.node.inference import run_jobs
from dyfn_ros.node.log_throttle import Throttle
from dyfn_ros.node.odometry import TransformTopics
from dyfn_ros.node.pace import Chatter
from dyfn_ros.node.parameters.declare import NodeParameters
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.service_guard import guard_services
from dyfn_ros.node.topics import NodeTopics
from dyfn_ros.node.workers import DeviceWorkers

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

ModelLoader = Callable[[str, str], "GeometryModel"]

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_PATIENCE = 4.0  # seconds that a transition waits for the frame being worked on
_LAST_PATIENCE = 2.0  # the same at the end of the process, see end_request.BOUND
_FOLLOW = 0.5  # seconds between looks at who publishes
_RESETS = 5  # a second, by the services, before waiting frames are dropped no longer
_POLL = 0.1  # seconds between looks at what else may end the wait for a model


class StreamDepthNode(LifecycleNode):
    """Topics, services, parameters and states: docs/node.md.

    Callbacks only store and queue; decoding, inference and publishing happen in one worker
    thread, which lives from configure to cleanup.

    ending: whether the process is asked to end; a model is then waited for no longer.
    """

    def __init__(
        self,
        load: ModelLoader = load_model,
        ending: Callable[[], bool] = lambda: False,
        **node_options: Any,
    ) -> None:
        super().__init__("stream_depth", enable_logger_service=True, **node_options)
        self._throttle, self._reset_throttle = Throttle(), Throttle()
        guard_services(self, self._warn)
        self._load, self._ending = load, ending
        self._phase = "unconfigured"
        self._callback_errors = 0
        self._loaded: list[str] = []  # devices with a model
        self._worker: DeviceWorkers[FrameJob] | None = None
        self._abandoned: list[DeviceWorkers[FrameJob]] = []  # that did not end in time
        self._cameras: list[Camera] = []
        self._made: list[Callable[[], Any]] = []  # what cleanup undoes
        self._table = NodeParameters(self, lambda: self._phase != "unconfigured")
        for text in self._table.unused():
            self.get_logger().warning(text)
        given = self.settings.state_file  # what is set later must not choose the folder
        self._state_folder = str(Path(given).expanduser().parent) if given else ""
        self._files = FileWork()
        self._resetting = Chatter(_RESETS)
        self._twins = 0  # other nodes of this name
        self._ports = NodeTopics(self, self._warn)
        self._diagnostics = self.create_publisher(
            DiagnosticArray,
            "/diagnostics",
            QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    @property
    def settings(self) -> NodeSettings:
        """The values in force."""
        return self._table.settings

    @property
    def title(self) -> str:
        """What diagnostics call this node: its name, with its namespace."""
        return self.get_fully_qualified_name().lstrip("/")

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """See rclpy; also values that one camera is to have for itself from now on."""
        return self._table.set(parameter_list, super().set_parameters_atomically)

    @property
    def worker_error(self) -> BaseException | None:
        """What the worker ended with, when it has ended by itself."""
        return None if self._worker is None else self._worker.error

    def _warn(self, text: str) -> None:
        if line := self._throttle(text):
            self.get_logger().warning(line)

    def _error(self, text: str) -> None:
        if line := self._throttle(text):
            self.get_logger().error(line)

    def _tell_reset(self, text: str) -> None:
        if line := self._reset_throttle(text):
            self.get_logger().warning(line)

    def callback_failed(self, error: Exception) -> None:
        """A callback raised, which nobody foresaw: it is counted, and the node goes on."""
        self._callback_errors += 1
        place = "".join(traceback.format_tb(error.__traceback__)[-1:]).strip()
        self._error(f"a callback failed: {type(error).__name__}: {error} ({place})")

    # Transitions.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Topics, services, and the model, which is loaded while this waits."""
        try:
            return self._configure(state)
        except Exception as error:  # rclpy goes to on_error without a word
            self.get_logger().error(f"cannot configure: {error}")
            raise

    def _configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        settings = self.settings
        try:
            devices = self._devices()
        except ValueError as error:
            self.get_logger().error(f"cannot configure: {error}")
            return FAILURE
        self._worker = DeviceWorkers(
            devices,
            lambda jobs: run_jobs(jobs, self.settings.batch),
            prepare=partial(self._load_model, devices),
            keep_all=not settings.drop_frames,
            capacity=settings.queue_size,
            held=[self._table.camera(name).wait_for_camera_info for name in settings.cameras],
        )
        transforms = TransformTopics(self._ports, settings)
        self._cameras = [
            self._make_camera(i, name, transforms) for i, name in enumerate(settings.cameras)
        ]
        self._make_services()
        self._worker.start()
        while not self._interrupted and not self._worker.wait_prepared(_POLL):
            self._ports.check_publishers()
        if self._worker.error is not None:
            self.get_logger().error(f"cannot configure: {self._worker.error!r}")
        if self._worker.error is not None or self._interrupted:
            self._release_all(0.0)
            return FAILURE
        for camera in self._cameras:
            camera.open_outputs()
        self._phase = "inactive"
        return super().on_configure(state)

    def _devices(self) -> list[str]:
        """Of each camera. Raises ValueError for one that is not here."""
        found = []
        for name in self.settings.cameras:
            try:
                found.append(str(resolve_device(self._table.camera(name).device)))
            except ValueError as error:
                raise ValueError(f"{name}: {error}" if name else str(error)) from error
        return ["cuda:0" if one == "cuda" and "cuda:0" in found else one for one in found]

    @property
    def _interrupted(self) -> bool:
        return self._ending() or not self.context.ok()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Frames that come from now on are worked on."""
        result = super().on_activate(state)
        if result == SUCCESS:
            self._phase = "active"
            self._set_active(True)
            for camera in self._cameras:
                count = self.count_publishers(camera.image_topic)
                now = f"{count} publish it" if count else "nobody publishes it yet"
                self.get_logger().info(f"waiting for images on {camera.image_topic} ({now})")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop what waits and publish nothing more; the streams keep their memory."""
        self._set_active(False)
        self._phase = "inactive"
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give the model, the topics and the memory back."""
        self._release_all()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As cleanup; the node cannot be configured again."""
        self._release_all()
        self._phase = "finalized"
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """A transition raised: back to unconfigured with nothing left over."""
        self.get_logger().error(f"a transition from {state.label} failed")
        self._release_all()
        return SUCCESS

    def _set_active(self, active: bool) -> None:
        for index, camera in enumerate(self._cameras):
            camera.active = active
            if not active and self._worker is not None:
                self._worker.discard(index)

    def _release_all(self, patience: float = _PATIENCE) -> None:
        """Undo configure. patience: seconds for the frame that is being worked on."""
        self._set_active(False)
        if self._worker is not None and not self._worker.stop(patience):
            self._abandoned.append(self._worker)
            for camera in self._cameras:
                camera.abandoned = True
        if self._phase in ("inactive", "active"):
            for line in self._summary():
                self.get_logger().info(line)
        for undo in reversed(self._made):
            undo()
        self._made = []
        self._ports.close()
        self._cameras, self._worker, self._loaded = [], None, []
        self._phase = "unconfigured"

    # What a configured node is made of.

    def _make_camera(self, index: int, name: str, transforms: TransformTopics) -> Camera:
        worker = self._worker
        assert worker is not None
        return Camera(
            self,
            self._ports,
            name,
            partial(self._table.camera, name),
            transforms,
            submit=lambda job: worker.submit(job, index),
            release=lambda: worker.release(index),
            warn=self._warn,
            error=self._error,
            told_reset=self._tell_reset,
            state_folder=self._state_folder,
        )

    def _make_services(self) -> None:
        """Trigger services, the clock's jump callback, and the timer of the diagnostics."""
        everyone = list(range(len(self._cameras)))
        prefixes = {"~": everyone}
        prefixes.update({f"~/{c.name}": [i] for i, c in enumerate(self._cameras) if c.name})
        answers: dict[str, Callable[..., Trigger.Response]] = {
            "reset": self._on_reset,
            "save_state": partial(self._on_state, "save_state"),
            "load_state": partial(self._on_state, "load_state"),
            "calibrate": self._on_calibrate,
        }
        for prefix, indices in prefixes.items():
            for name, answer in answers.items():
                group = MutuallyExclusiveCallbackGroup()  # who waits for a disk keeps nobody
                service = self.create_service(
                    Trigger, f"{prefix}/{name}", partial(answer, indices), callback_group=group
                )
                self._made.append(partial(self.destroy_service, service))
        self._made.append(self._watch_clock().unregister)
        for name in self._ports.unused_overrides():
            self._warn(f"{name} was given, but there is no such topic or policy; it has no effect")
        for callback, period in (
            (self.publish_diagnostics, self.settings.diagnostics_period),
            (self._ports.check_publishers, _FOLLOW),
            (self._look_for_twins, _FOLLOW),
        ):
            timer = self.create_timer(period, callback, MutuallyExclusiveCallbackGroup())
            self._made.append(partial(self.destroy_timer, timer))

    def _watch_clock(self) -> Any:
        """Jumps of ROS time (use_sim_time); a looping bag without a clock shows in stamps only."""
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1)
        )
        return self.get_clock().create_jump_callback(threshold, post_callback=self._on_jump)

    # Executor's thread.

    def _on_jump(self, jump: TimeJump) -> None:
        seconds = jump.delta.nanoseconds * 1e-9
        for index, camera in enumerate(self._cameras):
            settings = camera.settings
            forward = bool(settings.max_gap) and seconds > settings.max_gap
            if seconds < -settings.stamp_tolerance or forward:
                self._reset(index, TIME_JUMP)

    def _on_reset(
        self, indices: list[int], _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        often = self._resetting()
        if often:
            self._warn(
                f"more than {_RESETS} resets a second are asked for: the stream keeps no memory; "
                "frames that wait are worked on first, so that depth goes on"
            )
        dropped = sum(self._reset(index, RESET_SERVICE, not often) for index in indices)
        response.success = True
        response.message = f"the next frame resets the stream ({dropped} waiting frames dropped)"
        if line := self._throttle(f"reset: {response.message}"):
            self.get_logger().info(line)
        return response

    def _on_calibrate(
        self, indices: list[int], _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Measure the scale anew, by what comes from now on; success when all cameras can."""
        lines, response.success = [], True
        for camera in (self._cameras[index] for index in indices):
            title = f"{camera.name}: " if camera.name else ""
            try:
                lines.append(title + camera.calibrate())
            except ValueError as error:
                response.success = False
                lines.append(f"{title}{error}")
        response.message = "; ".join(lines)
        if line := self._throttle(f"calibrate: {response.message}"):
            self.get_logger().info(line)
        return response

    async def _on_state(
        self, what: str, indices: list[int], _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """save_state or load_state of each camera; success when all of them worked."""
        lines, response.success = [], True
        for camera in (self._cameras[index] for index in indices):
            title = f"{camera.name}: " if camera.name else ""
            try:
                lines.append(title + await self._files.run(getattr(camera, what), self.executor))
            except StateError as error:
                response.success = False
                lines.append(f"{title}{error}")
            except Exception as error:  # which nobody foresaw; the client waits for an answer
                self.callback_failed(error)
                response.success = False
                lines.append(f"{title}{type(error).__name__}: {error}")
        response.message = "; ".join(lines)
        logger = self.get_logger()
        if response.success:
            logger.info(f"{what}: {response.message}")
        else:
            logger.error(f"{what}: {response.message}")
        return response

    def _reset(self, index: int, reason: str, drop: bool = True) -> int:
        """drop: what waits, if frames may be dropped. -> how many were."""
        self._cameras[index].request_reset(reason)
        if self._worker is None or not self.settings.drop_frames or not drop:
            return 0
        return self._worker.discard(index)

    def _look_for_twins(self) -> None:
        """Two nodes of one name answer each other's services, and their outputs mix."""
        own = (self.get_name(), self.get_namespace())
        self._twins = max(0, self.get_node_names_and_namespaces().count(own) - 1)
        if self._twins:
            self._warn(self._twin_problem)

    @property
    def _twin_problem(self) -> str:
        """ "" when there is no other node of this name."""
        if not self._twins:
            return ""
        return (
            f"{self._twins} other node is called {self.get_fully_qualified_name()} too, or was "
            "killed lately: their topics and services are the same, give each its own name or "
            "namespace (-r __node:=NAME, -r __ns:=/NAME)"
        )

    def publish_diagnostics(self) -> None:
        """One status for the node and one for each camera."""
        if self._diagnostics.get_subscription_count() == 0:
            return
        report = Report(
            name=self.title,
            phase=self._phase,
            settings=self.settings,
            device=", ".join(self._loaded),
            error=self.worker_error,
            twins=self._twin_problem,
            callback_errors=self._callback_errors,
            mismatches=self._ports.mismatches,
            cameras=self._cameras,
            dropped=[self._dropped(index) for index in range(len(self._cameras))],
        )
        message = node_diagnostics(report)
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    # Inference thread.

    def _load_model(self, devices: list[str], device: str) -> None:
        """devices: of each camera. device: whose cameras get a model."""
        import torch

        settings = self.settings
        if settings.threads:
            torch.set_num_threads(settings.threads)
        model = on_backend(self._load(settings.model, device), settings.backend)
        cameras = [one for one, own in zip(self._cameras, devices, strict=True) if own == device]
        for camera in cameras:
            camera.open_stream(model)
        self._loaded.append(device)
        if not self._interrupted:  # loading takes long enough
            sources = {camera.settings.metric_source for camera in cameras} - {"none"}
            unit = f"metres come from {', '.join(sorted(sources))}"
            if not sources:
                unit = "depth is right up to one scale, which is not metres"
            where = f"{device}, in {model.backend}" + kept_exports(model)
            self.get_logger().info(f"{settings.model} on {where}; {unit}")
            if model.quantity == "disparity":
                self.get_logger().warning(
                    f"{settings.model} predicts disparity, right up to scale and shift: the depth "
                    "published is its inverse over the first frame's median, so shapes are bent "
                    "as far as that shift is not 0; no metric scale makes it metres"
                )
            elif model.quantity == "affine_depth":
                self.get_logger().warning(
                    f"{settings.model} predicts depth up to scale and shift, and the shift is "
                    "taken for 0: shapes are bent as far as it is not; metric_source:=reference "
                    "with calibration_fit:=scale_shift finds both"
                )
            elif model.knows_metres and "model" not in sources:
                self.get_logger().info(
                    f"{settings.model} knows metres itself: metric_source:=model uses them"
                )

    # The end.

    def _dropped(self, index: int) -> int:
        return 0 if self._worker is None else self._worker.dropped(index)

    def _summary(self) -> list[str]:
        """What became of the frames of each camera."""
        lines = []
        for index, camera in enumerate(self._cameras):
            counts = camera.statistics.counts
            skipped = f"{counts['skipped']} skipped, " if counts["skipped"] else ""
            lines.append(
                f"{camera.name + ': ' if camera.name else ''}{counts['received']} frames received, "
                f"{counts['published']} worked on, "
                f"{self._dropped(index) + counts['unpublished']} dropped, {skipped}"
                f"{counts['bad']} bad, {counts['failed']} failed; "
                f"{sum(camera.resets.values())} resets"
            )
        return lines

    def close(self) -> bool:
        """Say what became of the frames, and release everything. -> whether no thread is left."""
        self._release_all(_LAST_PATIENCE)
        self.destroy_node()
        return all(worker.stop(0.0) for worker in self._abandoned)
