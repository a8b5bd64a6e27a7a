"""What a sweep costs beside its runs: the same runs one after the other in one warm process, and by ``neuralq sweep``.

    python scripts/bench_sweep.py                          200 runs of about a second, 2 at a time
    python scripts/bench_sweep.py --runs 50 --steps 5k     short ones

Prints a line for each: runs, CPU-seconds in all (children included), wall-seconds, and both per run; then the ratio of
CPU-seconds, which other programs on the machine change less than wall-seconds, and of wall-seconds to the best that so
many processes could do. A warm process is the fairest peer: it has paid for imports and kernels before the first run.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from neuralq.apps.cli.numbers import whole_number
from neuralq.runs import with_preset
from neuralq.runs.control import CONTROL
from neuralq.runs.recipe.config import RunConfig, config_to_dict
from neuralq.runs.sweep import LocalProcesses, create_sweep, run_sweep


def cpu_seconds() -> float:
    """Of this process and all children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def timed(work: Callable[[], Any]) -> tuple[float, float]:
    """CPU-seconds and wall-seconds of a piece of work."""
    cpu, wall = cpu_seconds(), time.perf_counter()
    work()
    return cpu_seconds() - cpu, time.perf_counter() - wall


def in_one_process(config: RunConfig, number: int, folder: Path) -> None:
    """So many runs, one after the other."""
    for seed in range(number):
        CONTROL.train(replace(config, seed=seed), folder / f"seed-{seed}")


def by_a_sweep(config: RunConfig, number: int, workers: int, folder: Path) -> None:
    """The same runs in processes of their own; forks are counted once their server has ended with them."""
    sweep = create_sweep(folder, config_to_dict(config), range(number))
    result = run_sweep(sweep, LocalProcesses(workers, config_to_dict(config)))
    assert len(result.returns) == number, result.plain()


def of_a_child(work: Callable[[], Any]) -> tuple[float, float]:
    """The same in a child of its own, with everything that it starts: the server of forks is among that."""
    wall = time.perf_counter()
    child = os.fork()
    if child == 0:
        try:
            work()
            from multiprocessing.forkserver import _forkserver

            _forkserver._stop()  # type: ignore[attr-defined]  # waits for it, so that its time and its children's are counted
            os._exit(0)
        except BaseException as error:
            print(repr(error), flush=True)
            os._exit(1)
    _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit("the sweep failed")
    return used.ru_utime + used.ru_stime, time.perf_counter() - wall


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="of the sweep")
    parser.add_argument("--alone", type=int, default=20, help="runs in one process")
    parser.add_argument("--steps", type=whole_number, default=15_000, help="environment steps of a run")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    options = parser.parse_args()
    config = with_preset("CartPole-v1", total_steps=options.steps)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        in_one_process(config, 1, folder / "warm")
        alone = timed(lambda: in_one_process(config, options.alone, folder / "alone"))
        sweep = of_a_child(lambda: by_a_sweep(config, options.runs, options.workers, folder / "sweep"))
    print(f"{'':<28} {'runs':>5} {'CPU-s':>8} {'wall-s':>8} {'CPU-s a run':>12} {'wall-s a run':>13}")
    for title, number, (cpu, wall) in (
        ("one warm process", options.alone, alone),
        (f"sweep, {options.workers} at a time", options.runs, sweep),
    ):
        print(f"{title:<28} {number:>5} {cpu:>8.1f} {wall:>8.1f} {cpu / number:>12.3f} {wall / number:>13.3f}")
    cpu_ratio = (sweep[0] / options.runs) / (alone[0] / options.alone)
    wall_ratio = (sweep[1] / options.runs) / (alone[1] / options.alone / options.workers)
    print(f"CPU-seconds {cpu_ratio:.3f} of the runs' own, wall-seconds {wall_ratio:.3f} of the runs' own / workers")


if __name__ == "__main__":
    main()
