"""The learning curves of TD-Gammon runs: one CSV of all evaluations, one picture.

    python scripts/td_gammon_curve.py RUN [RUN ...] [--csv F] [--svg F]

A row for each evaluation and opponent: seed, games of self-play, CPU-seconds of training, points per game and standard
error. ``--draw F`` takes the rows from a CSV in place of runs. Example:

    neuralq train td-gammon --seed 1 --against pubeval --run-dir runs/a
    neuralq train td-gammon --seed 2 --against pubeval --run-dir runs/b
    python scripts/td_gammon_curve.py runs/a runs/b --svg curve.svg
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.folder.run_folder import read_metrics, read_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = ("seed", "games", "cpu_seconds", "opponent", "points_per_game", "standard_error", "win_rate")
OPPONENTS = ("random", "pubeval", "gnubg")

Row = dict[str, Any]


def rows_of(run: Path) -> list[Row]:
    """The evaluations of a run."""
    seed = read_seed(run)
    return [
        {
            "seed": seed,
            "games": row["games"],
            "cpu_seconds": round(row["cpu_seconds"], 1),
            "opponent": name,
            "points_per_game": round(row[f"ppg_{name}"], 4),
            "standard_error": round(row[f"ppg_{name}_standard_error"], 4),
            "win_rate": round(row[f"win_rate_{name}"], 4),
        }
        for row in read_metrics(run)
        for name in OPPONENTS
        if f"ppg_{name}" in row
    ]


def read(path: Path) -> list[Row]:
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v if k == "opponent" else float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def paint(figure: Figure, rows: Sequence[Row]) -> None:
    opponents = [name for name in OPPONENTS if any(row["opponent"] == name for row in rows)]
    for axes, opponent in zip(figure.subplots(1, len(opponents), squeeze=False)[0], opponents, strict=True):
        for i, seed in enumerate(sorted({row["seed"] for row in rows})):
            mine = [row for row in rows if row["seed"] == seed and row["opponent"] == opponent]
            games, points = [row["games"] for row in mine], [row["points_per_game"] for row in mine]
            errors = [2 * row["standard_error"] for row in mine]
            look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 3}
            axes.errorbar(games, points, errors, linewidth=1.2, elinewidth=0.8, label=f"seed {seed:g}", **look)
        axes.set(xlabel="games of self-play", ylabel="points per game", title=f"against {opponent}")
        axes.set_xlim(left=0)
        axes.legend(loc="lower right")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python scripts/td_gammon_curve.py runs/a --svg curve.svg"
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folders of runs")
    parser.add_argument("--draw", type=Path, metavar="CSV", help="takes the rows from this file")
    parser.add_argument("--csv", type=Path, help="writes every evaluation")
    parser.add_argument("--svg", type=Path, help="draws a curve for each run and opponent")
    options = parser.parse_args()
    if bool(options.runs) == (options.draw is not None):
        parser.error("give folders of runs, or --draw CSV")
    rows = [row for run in options.runs for row in rows_of(run)] if options.draw is None else read(options.draw)
    if not rows:
        parser.error("there is no evaluation yet; give runs that were started with --against")
    if options.csv is not None:
        with open(options.csv, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    if options.svg is not None:
        about = "Points per game by games of self-play, with two standard errors, one line for each seed."
        title = "Learning backgammon by self-play"
        drawn = draw_svg("td-gammon-curve", title, about, (10, 4.0), lambda figure: paint(figure, rows))
        options.svg.write_text(drawn + "\n", encoding="utf-8")
    for seed, opponent in sorted({(row["seed"], row["opponent"]) for row in rows}):
        last = [row for row in rows if (row["seed"], row["opponent"]) == (seed, opponent)][-1]
        print(
            f"seed {seed:g}  {last['games']:>9,.0f} games  against {opponent:<8} "
            f"{last['points_per_game']:+.3f} ± {last['standard_error']:.3f}"
        )


if __name__ == "__main__":
    main()
