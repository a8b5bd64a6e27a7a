"""What runs on a Ray cluster cost beside themselves: tasks a second, and whether memory grows.

    python scripts/bench_ray.py                               1,000 runs of 64 steps, two nodes of this machine
    python scripts/bench_ray.py --runs 200 --storage none

Prints, whenever a tenth of the runs has ended, the memory of the command, of a worker of Ray's, of the server of forks
and of the process beside the command (with --storage none), each by its largest, in MiB; at the end runs a second, and
Ray's own rate: tasks that do nothing, from this process.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neuralq.runs import with_preset
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.sweep import Status, create_sweep, run_sweep
from neuralq.runs.sweep.ray_cluster import RayCluster


def memory(pid: int | str) -> float:
    """MiB that a process holds of its own and shares."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except (OSError, IndexError):
        return 0.0


def largest(chosen: Callable[[str], bool]) -> float:
    """Of the processes below the cluster whose command line is chosen."""
    found = [0.0]
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            try:
                line = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                ours = os.environ["NEURALQ_BENCH_RAY"].encode() in (place / "environ").read_bytes()
            except OSError:
                continue
            if ours and chosen(line):
                found.append(memory(place.name))
    return max(found)


def nothing() -> None:
    """A task."""


def empty_tasks(number: int) -> float:
    """A second, by this process, once workers are there."""
    import ray

    task: Any = ray.remote(num_cpus=1)(nothing)
    ray.get([task.remote() for _ in range(100)])
    began = time.perf_counter()
    ray.get([task.remote() for _ in range(number)])
    return number / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=64, help="environment steps of a run")
    parser.add_argument("--storage", choices=("shared", "none"), default="shared")
    options = parser.parse_args()
    os.environ["NEURALQ_BENCH_RAY"] = f"{os.getpid()}-{time.time()}"
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray
    from ray.cluster_utils import Cluster

    cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    config = config_to_dict(
        with_preset("CartPole-v1", total_steps=options.steps, evaluation_episodes=1, resume_probe=False, monitor=False)
    )
    print(f"{'ended':>6} {'seconds':>8} {'command':>8} {'worker':>8} {'server':>8} {'shelf':>8}", flush=True)
    told, began = [0], time.perf_counter()

    def watch(status: Status) -> None:
        if status.num_finished >= told[0]:
            told[0] += options.runs // 10
            kinds = ("ray::attempt", "ray::IDLE"), ("multiprocessing.forkserver",), ("ray::Shelf",)
            workers, server, shelf = (
                largest(lambda line, words=words: any(word in line for word in words))  # type: ignore[misc]
                for words in kinds
            )
            print(
                f"{status.num_finished:>6} {time.perf_counter() - began:>8.1f} {memory('self'):>8.1f} {workers:>8.1f} "
                f"{server:>8.1f} {shelf:>8.1f}", flush=True,
            )  # fmt: skip

    try:
        with tempfile.TemporaryDirectory() as folder:
            sweep = create_sweep(Path(folder, "s"), config, range(options.runs))
            result = run_sweep(sweep, RayCluster(cluster.address, sweep.path, storage=options.storage), watch)
        seconds = time.perf_counter() - began
        finished = sum(run.state == "finished" for run in result.runs)
        print(f"{finished} of {options.runs} runs finished, {finished / seconds:.1f} a second on two cores")
        cluster.connect()
        print(f"Ray alone: {empty_tasks(5000):,.0f} tasks a second")
        ray.shutdown()
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    main()
