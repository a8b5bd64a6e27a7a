"""What λ is worth in backgammon, each λ with a step size of its own: points per game against pubeval.

    pip install "neuralq[plot,gnubg]"
    python scripts/td_gammon_study.py [--games 200000] [--tune-games 30000] [--seeds 2] [--csv F] [--svg F]

First every λ is trained for ``--tune-games`` games with step sizes a factor of two apart, and more of them are tried as
long as the best is at an end; the one that wins most from pubeval is kept. Then every λ is trained with its own from
other seeds for ``--games``, and measured on the way. Step sizes fall to a thirtieth over each run. All networks have
Tesauro's 198 inputs, 80 hidden units and four outputs, learn online with traces, and play themselves only.

The CSV is written after every run, and what it already holds is not run again.

``--draw F`` draws the figure of a CSV that is there.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import statistics
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuralq.backgammon import SelfPlay, SelfPlaySettings
from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.systems.backgammon.match import play_match

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIRST_STEP_SIZES = {
    0.0: (0.2, 0.4, 0.8),
    0.3: (0.2, 0.4, 0.8),
    0.7: (0.1, 0.2, 0.4),
    0.9: (0.05, 0.1),
    1.0: (0.05, 0.1),
}
FALL = 30.0
MATCH_SEED = 2_026
COLUMNS = ("stage", "lambda", "step_size", "seed", "games", "points_per_game", "standard_error", "cpu_seconds")

Row = dict[str, Any]
Case = tuple[str, float, float, int, tuple[int, ...], int]


def learn(case: Case) -> list[Row]:
    """Trains for as many games as the last of ``stops`` says, and measures at each of them."""
    stage, lambda_, step_size, seed, stops, match_games = case
    settings = SelfPlaySettings(
        num_games=stops[-1], lambda_=lambda_, step_size=step_size, step_size_end=step_size / FALL
    )
    learner, rows, spent = SelfPlay(settings, seed), [], 0.0
    for before, stop in pairwise((0, *stops)):
        start = time.process_time()
        learner.play(stop - before)
        spent += time.process_time() - start
        match = play_match(learner.network, "pubeval", match_games, MATCH_SEED, duplicate=True)
        figures = (match.points_per_game, match.standard_error, spent)
        rows.append(dict(zip(COLUMNS, (stage, lambda_, step_size, seed, stop, *figures), strict=True)))
    return rows


def in_processes(cases: Sequence[Case], processes: int) -> Iterator[list[Row]]:
    if processes == 1:
        yield from map(learn, cases)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(learn, case) for case in cases]):
            yield future.result()


def learn_all(cases: Sequence[Case], rows: list[Row], processes: int, path: Path | None) -> None:
    """Runs the cases that ``rows`` does not hold, and appends what they come to."""
    known = {tuple(row[name] for name in COLUMNS[:4]) for row in rows}
    for found in in_processes([case for case in cases if case[:4] not in known], processes):
        rows += found
        last = rows[-1]
        print(
            f"{last['stage']:<6} λ {last['lambda']:<4} α {last['step_size']:<6} seed {last['seed']:<4} "
            f"{last['games']:>9,} games  {last['points_per_game']:+.3f} ± {last['standard_error']:.3f}  "
            f"{last['cpu_seconds']:.0f} CPU-s",
            flush=True,
        )
        if path is not None:
            write(rows, path)


def tuned(rows: Sequence[Row], lambda_: float) -> dict[float, float]:
    """Points per game by step size."""
    mine = [row for row in rows if row["stage"] == "tune" and row["lambda"] == lambda_]
    return {row["step_size"]: row["points_per_game"] for row in sorted(mine, key=lambda row: row["step_size"])}


def best_step_size(rows: Sequence[Row], lambda_: float) -> float:
    points = tuned(rows, lambda_)
    return max(points, key=points.__getitem__)


def beyond(points: dict[float, float]) -> list[float]:
    """The next step size to try: none once the best has a smaller and a larger neighbour that are worse."""
    sizes = list(points)
    best = max(points, key=points.__getitem__)
    return [sizes[0] / 2] if best == sizes[0] else [sizes[-1] * 2] if best == sizes[-1] else []


def study(rows: list[Row], options: argparse.Namespace) -> None:
    sizes = {lambda_: list(FIRST_STEP_SIZES[lambda_]) for lambda_ in options.lambdas}
    while any(sizes.values()):
        cases: list[Case] = [
            ("tune", lambda_, step_size, 1, (options.tune_games,), options.match_games)
            for lambda_, tried in sizes.items()
            for step_size in tried
        ]
        learn_all(cases, rows, options.processes, options.csv)
        sizes = {lambda_: beyond(tuned(rows, lambda_)) for lambda_ in options.lambdas}
    stops = tuple(options.games * share // 40 for share in (1, 2, 4, 10, 20, 40))
    cases = [
        ("learn", lambda_, best_step_size(rows, lambda_), seed, stops, options.match_games)
        for seed in range(100, 100 + options.seeds)
        for lambda_ in options.lambdas
    ]
    learn_all(cases, rows, options.processes, options.csv)


def read(path: Path) -> list[Row]:
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v if k == "stage" else float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def write(rows: Sequence[Row], path: Path) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in sorted(rows, key=lambda row: [row[name] for name in COLUMNS[:5]]):
            writer.writerow({k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in row.items()})


def paint(figure: Figure, rows: Sequence[Row]) -> None:
    left, right = figure.subplots(1, 2)
    for i, lambda_ in enumerate(sorted({row["lambda"] for row in rows})):
        look = {"color": COLOURS[i], "marker": MARKERS[i], "label": f"λ = {lambda_:g}"}
        left.plot(*zip(*tuned(rows, lambda_).items(), strict=True), **look)
        main = [row for row in rows if row["stage"] == "learn" and row["lambda"] == lambda_]
        games = sorted({row["games"] for row in main})
        means = [statistics.mean(r["points_per_game"] for r in main if r["games"] == n) for n in games]
        right.plot(games, means, **look)
        for row in main:
            right.plot(row["games"], row["points_per_game"], ".", color=COLOURS[i], alpha=0.4)
    left.set(xscale="log", xlabel="step size at the start", ylabel="points per game against pubeval", title="Tuning")
    right.set(xscale="log", xlabel="games of self-play", title="Mean over seeds, each λ with its step size")
    right.axhline(0, color="#555555", linewidth=0.8)
    right.legend()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python scripts/td_gammon_study.py --games 20000 --tune-games 5000 --csv study.csv",
    )
    parser.add_argument("--games", type=int, default=200_000, help="of each run of the second stage (default 200,000)")
    parser.add_argument("--tune-games", type=int, default=30_000, help="of each run of the first (default 30,000)")
    parser.add_argument("--seeds", type=int, default=2, help="of the second stage (default 2)")
    parser.add_argument("--match-games", type=int, default=4_000, help="of each measurement (default 4,000)")
    parser.add_argument(
        "--lambdas", type=float, nargs="+", choices=tuple(FIRST_STEP_SIZES), default=tuple(FIRST_STEP_SIZES)
    )
    parser.add_argument("--processes", type=int, default=2, help="runs at a time (default 2)")
    parser.add_argument("--csv", type=Path, help="writes every measurement")
    parser.add_argument("--svg", type=Path, help="draws tuning and learning curves")
    parser.add_argument("--draw", type=Path, metavar="CSV", help="takes the measurements from this file")
    options = parser.parse_args()
    if options.draw is not None:
        rows = read(options.draw)
    else:
        rows = read(options.csv) if options.csv is not None and options.csv.exists() else []
        study(rows, options)
    if options.csv is not None:
        write(rows, options.csv)
        rows = read(options.csv)  # what is drawn is what was written
    if options.svg is not None:
        title = "What λ is worth in backgammon"
        about = "Points per game against pubeval by step size, and by games of self-play for each λ with its step size."
        drawn = draw_svg("td-gammon-lambda", title, about, (10, 4.2), lambda figure: paint(figure, rows))
        options.svg.write_text(drawn + "\n", encoding="utf-8")
    for lambda_ in sorted({row["lambda"] for row in rows}):
        last = [row for row in rows if row["stage"] == "learn" and row["lambda"] == lambda_]
        last = [row for row in last if row["games"] == max(row["games"] for row in last)]
        if last:
            mean = statistics.mean(row["points_per_game"] for row in last)
            each = " ".join(f"{row['points_per_game']:+.3f}" for row in last)
            print(f"λ {lambda_:<4} α {last[0]['step_size']:<6} {last[0]['games']:>9,.0f} games  {mean:+.3f}  ({each})")


if __name__ == "__main__":
    main()
