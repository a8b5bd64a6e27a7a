"""Runs on a Ray cluster: one task of Ray's for each, which Ray begins again where a worker or a node is lost."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import re
import signal
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neuralq.checks import MissingExtra, check_choice
from neuralq.runs.sweep.engine import Ended
from neuralq.runs.sweep.ray_node import Shelf, attempt, last_line
from neuralq.runs.sweep.task import Task

__all__ = ["RayCluster", "require_ray"]

_LEAST_AT_A_TIME = 8
_MARKS = ("sweep.json", "study.json")
_COUNTED_SECONDS = 10.0
"""Between looks at how large the cluster is."""
_CONNECT_SECONDS = 5.0
_GONE_SECONDS = 10.0
"""For so long its head may not answer before a cluster is taken for gone."""
_CLOSE_SECONDS = 20.0


def require_ray() -> Any:
    """The module ray.

    Raises:
        MissingExtra: it is not installed.
    """
    # Pages of what Ray's daemons logged would go to standard output whenever a node is lost; read as Ray is imported.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise MissingExtra("runs on a Ray cluster need the package ray: pip install 'neuralq[ray]'") from error


class RayCluster:
    """One task of Ray's for each run, with what it asks of a node.

    A run whose worker or node is lost is begun again from its newest checkpoint, wherever there is room. With the
    command its runs end. What a run leaves is the same, bit for bit, as from a process of this machine, on processors
    of the same kind.

    Args:
        address: of the head, "host:port", or "auto" for the cluster that this machine belongs to.
        folder: of all the runs: a sweep's or a study's.
        num_cpus: that a run takes of a node.
        num_gpus: likewise; a part of one is allowed.
        storage: "shared" where every node sees the folder by its name; "none" where runs are to be sent home.

    Raises:
        MissingExtra: Ray is not installed.
        ConnectionError: there is no cluster at the address, or it cannot be used from here.
        ValueError: for resources that no run can have.
    """

    def __init__(
        self, address: str, folder: Path, num_cpus: float = 1.0, num_gpus: float = 0.0, storage: str = "shared"
    ) -> None:
        check_choice("storage", storage, ("shared", "none"))
        for name, value in (("cpus", num_cpus), ("gpus", num_gpus)):
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
        self._ray = require_ray()
        self._folder = os.path.abspath(folder)
        self._mark = next((name for name in _MARKS if Path(folder, name).exists()), "")
        self._asks = {"CPU": num_cpus, "GPU": num_gpus}
        self._running: dict[Any, Task] = {}
        self.address = _connect(self._ray, address)
        self._seen = self._looked = time.monotonic()
        self._counted, self._most = -math.inf, _LEAST_AT_A_TIME
        if not any(all(n["Resources"].get(k, 0) >= v for k, v in self._asks.items()) for n in self._alive()):
            warnings.warn(
                f"no node of the cluster at {self.address} has {num_cpus:g} CPUs and {num_gpus:g} GPUs; runs wait "
                "until one comes",
                stacklevel=2,
            )
        self._attempt = self._ray.remote(num_cpus=num_cpus, num_gpus=num_gpus, max_retries=-1)(attempt)
        self._shelf = self._beside() if storage == "none" else None

    def _beside(self) -> Any:
        """The shelf, on this machine: it writes the folder of the sweep."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=False)
        options = {"num_cpus": 0, "max_restarts": -1, "max_task_retries": -1, "scheduling_strategy": here}
        return self._ray.remote(**options)(Shelf).remote(self._folder)

    @property
    def title(self) -> str:
        """For people."""
        return f"Ray at {self.address}"

    def has_room(self) -> bool:
        """Whether Ray shall be given another task: twice as many as can go on at a time, so that no node waits."""
        now = time.monotonic()
        if now - self._counted > _COUNTED_SECONDS and _answers(self.address, 1.0):  # else asking would end this process
            self._counted = now
            held = {k: sum(node["Resources"].get(k, 0) for node in self._alive()) for k in self._asks}
            at_a_time = min((held[k] / v for k, v in self._asks.items() if v > 0), default=held["CPU"])
            self._most = max(_LEAST_AT_A_TIME, int(2 * at_a_time))
        return len(self._running) < self._most

    def _alive(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def start(self, task: Task) -> None:
        """Give Ray a task."""
        name = os.path.relpath(os.path.abspath(task.path), self._folder)
        reference = self._attempt.remote(self._folder, self._mark, name, task.config, task.options, self._shelf)
        self._running[reference] = task

    def collect(self, seconds: float) -> list[Ended]:
        """What has ended, as soon as something has.

        Raises:
            ConnectionError: if the head of the cluster is gone.
        """
        self._look_at_the_head()
        if not self._running:
            time.sleep(seconds)
            return []
        most = len(self._running)
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        if ready and most > 1:
            ready, _ = self._ray.wait(list(self._running), num_returns=most, timeout=0)
        return [Ended(self._running.pop(reference), self._reason(reference)) for reference in ready]

    def _reason(self, reference: Any) -> str:
        from ray import exceptions

        try:
            return str(self._ray.get(reference))
        except exceptions.TaskCancelledError:  # before it had begun
            return ""
        except exceptions.RayTaskError as error:
            found = re.search(r"ip=([\w.:]+)", str(error))
            node = found[1] if found else "unknown"
            if "No module named 'neuralq" in str(error):
                return f"node {node} has no neuralq: install there what is installed here"
            return f"{last_line(error)} (on node {node})"
        except exceptions.RayError as error:
            return last_line(error)

    def running(self) -> list[Task]:
        """What Ray was given and has not ended."""
        return list(self._running.values())

    def stop(self) -> None:
        """Ask every run to save and end; those that wait for a node do not begin."""
        for reference in self._running:
            self._ray.cancel(reference, force=False)

    def close(self) -> None:
        """Leave the cluster, which ends what is left of ours there."""
        self._running.clear()
        # Where the head is gone this may wait for minutes for it to come back.
        leaving = threading.Thread(target=self._ray.shutdown, daemon=True)
        leaving.start()
        leaving.join(_CLOSE_SECONDS)

    def _look_at_the_head(self) -> None:
        now = time.monotonic()
        if now - self._looked < 1.0:
            return
        self._looked = now
        if _answers(self.address, 1.0):
            self._seen = time.monotonic()
        elif now - self._seen > _GONE_SECONDS:
            raise ConnectionError(f"the head of the cluster at {self.address} is gone; run the command again")


def _connect(ray: Any, address: str) -> str:
    """Makes this process one of the cluster's; the address of the head."""
    if "://" in address or address == "local":
        raise ConnectionError(
            f"--ray takes the head of a cluster that this machine belongs to, HOST:PORT or auto, got {address!r}; to "
            "make it belong: ray start --address=HOST:PORT --num-cpus=0"
        )
    if address != "auto" and not _answers(address, _CONNECT_SECONDS):
        raise ConnectionError(f"nothing answers at {address!r}; begin a cluster with: ray start --head --port=6379")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with _own_signals():
        try:
            ray.init(address=address, log_to_driver=False, logging_level="ERROR", configure_logging=False)
        except Exception as error:  # of many kinds: another version of Ray or Python there, no node of it here
            raise ConnectionError(f"cannot use the cluster at {address!r}: {last_line(error)}") from error
    return str(ray.get_runtime_context().gcs_address)


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """Ray puts its own handlers in; those that were there are put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


def _answers(address: str, seconds: float) -> bool:
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), seconds):
            return True
    except (OSError, ValueError, OverflowError):
        return False
