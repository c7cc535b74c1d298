"""Engines: who runs the points of a sweep. Rows do not depend on it."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from srs_twin.errors import InputError
from srs_twin.process_server import start_server
from srs_twin.processes import Done, each
from srs_twin.sweep.points import Experiment, Point
from srs_twin.sweep.task import Row, run_point

# No reports to anybody, and workers that take this environment as it is instead of building it anew.
_RAY_SETTINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
# A Ray of our own serves nobody else. Under this name Ray keeps to the loopback address, on Linux as well.
_LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}

Engine = Callable[[Experiment, Sequence[Point]], Iterator[Done[Row]]]


def local(workers: int | None = None) -> Engine:
    """Return the engine that runs points in processes of this machine.

    Threads, or `mujoco.batch` for twins of one model, would be no faster (see benchmarks/sweeps.py), and one
    run that goes down would take the others along.

    Args:
        workers: how many processes; default one a processor.
    """

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
        start_server("srs_twin.sweep.warm")
        return each(partial(run_point, experiment), points, workers=workers)

    return run


def on_ray(address: str | None = None, workers: int | None = None) -> Engine:
    """Return the engine that runs points on a Ray cluster, or on a Ray of this machine's own.

    Args:
        address: of a cluster, as `ray.init` takes it; None starts one here, which ends with the sweep.
        workers: processors of one started here; default all.

    Raises:
        InputError: Ray is not installed, or an address goes with a number of workers.
    """
    for name, value in (_RAY_SETTINGS | ({} if address else _LOOPBACK_ONLY)).items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise InputError("--engine ray needs Ray; install it with: pip install 'srs-twin[ray]'") from error
    if address is not None and workers is not None:
        raise InputError("--workers belongs to a Ray of this machine's own; a cluster has the workers it has")

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
        try:
            if address:
                ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
            else:
                ray.init(
                    num_cpus=workers, include_dashboard=False, log_to_driver=False,
                    logging_level=logging.ERROR,
                )  # fmt: skip
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"Ray cannot be reached at {address or 'this machine'}: {error}") from error
        try:
            yield from _shared_out(experiment, points)
        finally:
            ray.shutdown()

    return run


def _shared_out(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
    """Keep two points a processor under way; yield as they finish."""
    import ray

    task = ray.remote(max_retries=3)(run_point)
    common = ray.put(experiment)
    slots = max(2, int(2 * ray.cluster_resources().get("CPU", 1)))
    under_way: dict[object, int] = {}
    coming = iter(enumerate(points))
    while True:
        while len(under_way) < slots and (new := next(coming, None)) is not None:
            under_way[task.remote(common, new[1])] = new[0]
        if not under_way:
            return
        for finished in ray.wait(list(under_way), num_returns=1)[0]:
            number = under_way.pop(finished)
            try:
                yield Done(number, ray.get(finished), None)
            except ray.exceptions.RayError as error:
                yield Done(number, None, error)


ENGINES = ("local", "ray")
