"""What training the systems of the chapter costs, beside the same loops as the Python they are written in.

    python scripts/bench_systems.py                     # every system
    python scripts/bench_systems.py ase-ace --rounds 5
    python scripts/bench_systems.py --json

Each row is CPU time of one process with one thread, the median of some rounds without compilation. The Python side is
the same code with ``NUMBA_DISABLE_JIT=1``, on a smaller amount of work, and is given for the whole. For example:

    ase-ace          60 trials of ASE/ACE                                 0.00 s    Python       0.9 s     293x

``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import NamedTuple


class Work(NamedTuple):
    """One row: what is done, how to do so much of it, how much compiled and in Python, and what it may cost."""

    summary: str
    run: Callable[[int], object]
    amount: int
    python_amount: int
    most_seconds: float | None = None


def pole_ase_ace(num_trials: int) -> None:
    from neuralq.systems.ase_ace.trials import train

    train(0, long_trial_steps=10_000, most_failures=num_trials)


def advised(num_games: int) -> None:
    import numpy as np

    from neuralq.systems.advice.rules import GOOD
    from neuralq.systems.advice.studies import study

    study(np.random.SeedSequence(0), GOOD, num_games=num_games, test_every=max(num_games, 500))


def classifiers(num_problems: int) -> None:
    from neuralq.systems.bucket_brigade.lives import live

    live(0, num_problems=num_problems)


def transition_hierarchies(num_steps: int) -> None:
    from neuralq.systems.child.lives import live

    live(0, mazes=(9,), from_nothing=True, limit=num_steps)


def compositional(num_trials: int) -> None:
    import numpy as np

    from neuralq.systems.hierarchies.studies import modules_study

    modules_study(np.random.SeedSequence(0), num_trials=num_trials, test_every=num_trials, num_practised=num_trials)


def elevators(num_hours: int) -> None:
    import numpy as np

    from neuralq.systems.elevators.training import Settings, train

    train(np.random.SeedSequence(0), Settings(num_hours))


def fit_to_slopes(num_steps: int) -> None:
    import numpy as np

    from neuralq.learners import fit_slopes, new_slope_net

    rng = np.random.default_rng(0)
    s, slope = rng.normal(size=(2, 20, 2))
    fit_slopes(new_slope_net(2, 10, rng), s, rng.normal(size=20), slope, num_steps=num_steps)


def obelix_behaviours(num_steps: int) -> None:
    from neuralq.systems.obelix.lives import spend

    spend(0, "behaviours", "table", num_steps=max(num_steps, 4))


def lin_replay(num_plays: int) -> None:
    import numpy as np

    from neuralq.systems.lin.trainings import TEST_EVERY, Settings, train

    settings = Settings(replays=(12, 4), num_plays=max(num_plays, TEST_EVERY), num_test_plays=1)
    train(np.random.SeedSequence(0), settings)


def littman_sarsa(num_steps: int) -> None:
    from neuralq.systems.littman.trainings import train

    train(0, num_steps=num_steps)


def mccallum_tree(num_trials: int) -> None:
    """Most of it is NumPy on small arrays, and compiled by nobody."""
    from neuralq.systems.mccallum.trials import NUM_LAST, train

    train(0, "USM", max(num_trials, NUM_LAST))


def pole_q_lambda(num_trials: int) -> None:
    from neuralq.systems.peng_williams.trials import Settings, train

    train(0, Settings(0.5, long_trial_steps=10_000, most_failures=num_trials))


def job_shop(num_episodes: int) -> None:
    from neuralq.systems.job_shop.system import problems_of
    from neuralq.systems.job_shop.trials import Settings, train

    train(0, problems_of(100, 0), problems_of(50, 1) if num_episodes > 50 else (), Settings(num_episodes))


def checkers_learning(num_games: int) -> None:
    from neuralq.systems.checkers.training import train

    train(0, num_games)


def checkers_perft(num_positions: int) -> None:
    """Ways to play nine moves, as those to play six from each of the 302 boards after three."""
    from neuralq_envs.checkers import Position
    from neuralq_envs.checkers.rules import perft

    boards = [Position.initial()]
    for _ in range(3):
        boards = [move.position for board in boards for move in board.moves()]
    ways = sum(perft(one.own, one.other, one.kings, 6) for one in boards[:num_positions])
    assert num_positions < len(boards) or ways == 3_963_680


WORK = {
    "advice": Work("8,000 games of Pengo with advice, 400 of test", advised, 8000, 20),
    "ase-ace": Work("60 trials of ASE/ACE", pole_ase_ace, 60, 20),
    "bucket-brigade": Work("10,000 problems of ZCS in Woods1", classifiers, 10_000, 20),
    "checkers": Work("500 games learned from, three plies", checkers_learning, 500, 1, 10.0),
    "checkers-perft": Work("perft 9, 3,963,680 ways", checkers_perft, 302, 2, 1.0),
    "child": Work("200,000 steps in the ninth maze, from nothing", transition_hierarchies, 200_000, 2000),
    "ebnn": Work("3,000 steps on 20 points and their slopes", fit_to_slopes, 3000, 100),
    "elevators": Work("10,000 simulated hours of elevators", elevators, 10_000, 10, most_seconds=15.0),
    "hierarchies": Work("4,000 trials of CQ-L, half of them composite", compositional, 2000, 50),
    "job-shop": Work("6,000 episodes of repair, 51 tasks", job_shop, 6000, 20, most_seconds=5.0),
    "lin": Work("300 plays of QCON-R in Lin's world", lin_replay, 300, 25),
    "littman": Work("1,000,000 steps of Sarsa(λ) on percepts", littman_sarsa, 1_000_000, 2000),
    "mccallum": Work("200 trials of USM in the M", mccallum_tree, 200, 200),
    "obelix": Work("8,000 steps of three behaviours, table", obelix_behaviours, 8000, 200),
    "peng-williams": Work("150 trials of Q(λ), λ = .5", pole_q_lambda, 150, 50),
}


def measured(name: str, rounds: int, python: bool) -> float:
    """CPU seconds of the whole amount, in a process of its own."""
    amount = WORK[name].python_amount if python else WORK[name].amount
    command = [sys.executable, __file__, "--child", name, str(amount), str(1 if python else rounds)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_DISABLE_JIT": str(int(python))}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    if ended.returncode != 0:
        sys.exit(f"{name} failed:\n{ended.stderr}")
    return float(ended.stdout.split()[-1]) * WORK[name].amount / amount


def child(name: str, amount: int, rounds: int) -> None:
    run = WORK[name].run
    run(1)  # compiles
    seconds = []
    for _ in range(rounds):
        began = time.process_time()
        run(amount)
        seconds.append(time.process_time() - began)
    print(statistics.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(WORK)} (default: all)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    parser.add_argument("--child", nargs=3, metavar=("NAME", "AMOUNT", "ROUNDS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        name, amount, rounds = arguments.child
        child(name, int(amount), int(rounds))
        return
    unknown = [name for name in arguments.names if name not in WORK]
    if unknown:
        parser.error(f"no such system: {', '.join(unknown)}; there are {', '.join(WORK)}")
    found = {}
    for name in arguments.names or WORK:
        work = WORK[name]
        compiled, python = measured(name, arguments.rounds, False), measured(name, arguments.rounds, True)
        found[name] = {"seconds": compiled, "python_seconds": python, "most_seconds": work.most_seconds}
        limit = "" if work.most_seconds is None else f"    (at most {work.most_seconds:g} s)"
        ratio = python / max(compiled, 1e-9)
        print(
            f"{name:<16} {work.summary:<48} {compiled:8.2f} s    Python {python:9.1f} s  {ratio:6.0f}x{limit}",
            flush=True,
        )
    if arguments.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
