"""Recordings replayed on a Ray cluster; needs the extra `ray`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from dyfn_core.extras import missing
from dyfn_core.files import OutputError
from dyfn_ros.replay.jobs import CRASHED, BatchJob, Outcome, Runner, outcome_of
from dyfn_ros.replay.run import ModelLoader
from dyfn_ros.replay.settings import PredictionTopic, ReplayJob

LOCAL = "local"  # Ray's own word for a cluster of this machine, made for this run


def ray_runner(address: str, jobs: int = 1) -> Runner:
    """A runner for the cluster at `address` ("auto", "HOST:PORT", "ray://HOST:PORT" or "local").

    Its machines must have this package installed and see the recordings, the output folder and
    model files at the same paths. A recording whose worker dies is tried once more. Raises
    OutputError without the library, ConnectionError without the cluster.
    """
    try:
        import ray
    except ImportError as error:
        raise OutputError(f"--ray needs Ray: {missing(error)}") from error

    def run(waiting: Sequence[BatchJob], loader: ModelLoader) -> Iterator[tuple[BatchJob, Outcome]]:
        if not waiting:
            return
        cpus = jobs * max(_needs(one.job)["num_cpus"] or 1 for one in waiting)
        ours: dict[str, Any] = {
            "num_cpus": cpus,
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
        }
        ray.init(address, log_to_driver=False, **(ours if address == LOCAL else {}))
        try:
            yield from _outcomes(ray, waiting, loader)
        finally:
            ray.shutdown()

    return run


def _outcomes(
    ray: Any, jobs: Sequence[BatchJob], loader: ModelLoader
) -> Iterator[tuple[BatchJob, Outcome]]:
    tasks = {}
    for job in jobs:
        remote = ray.remote(max_retries=1, **_needs(job.job))(outcome_of)
        tasks[remote.remote(job.job, loader)] = job
    while tasks:
        done, _ = ray.wait(list(tasks))
        for task in done:
            try:
                outcome = ray.get(task)
            except ray.exceptions.RayError as error:
                first = str(error).strip().splitlines()[0]
                outcome = Outcome(CRASHED, f"{type(error).__name__}: {first}")
            yield tasks.pop(task), outcome


def _needs(job: ReplayJob) -> dict[str, int]:
    if isinstance(job.run, PredictionTopic):
        return {"num_cpus": 1, "num_gpus": 0}
    return {"num_cpus": job.run.threads, "num_gpus": int("cuda" in job.run.device)}
