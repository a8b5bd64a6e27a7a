"""The page of a TD-Gammon run: points against opponents, the curve of them, and how it opens a game."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.apps.web.play_turns import WaysToPlay, notation
from neuralq.figures import COLOURS, MARKERS, band, draw_svg, steps_axis, tame
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.files import as_float, read_json, read_rows
from neuralq.runs.folder.run_folder import warn_of_lost_rows
from neuralq.runs.report.curves import mark_changes
from neuralq.runs.report.outcome import sentence
from neuralq.runs.report.page import Page, facts_table, html_table, short_number, tiles
from neuralq.runs.report.readings import Row, read_present_summary, read_told_changes, rows_by_step
from neuralq.systems.backgammon.agent import BackgammonAgent, RankedTurn
from neuralq.systems.backgammon.config import TdGammonConfig, config_from_dict
from neuralq.systems.backgammon.run import load_agent
from neuralq.types import Floats
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.drawing import svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["write_gammon_report"]

_STYLE = """
.boards { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: .6rem; }
.boards figure { margin: 0; }
.scroll td { white-space: nowrap; }
.boards svg { display: block; width: 100%; height: auto; border-radius: 6px; }
"""
_DRAWN = ((3, 1), (4, 2), (6, 5))
"""Openings of which a board is shown."""


def write_gammon_report(run_dir: str | Path) -> Path:
    """Writes ``report.html`` into the folder of a TD-Gammon run and returns its path; may be called while it goes on.

    Raises:
        RunFolderError: a file of the folder is damaged; names it.
        MissingExtra: matplotlib is not installed.
    """
    folder = Path(run_dir)
    rows, config = read_rows(folder / "metrics.jsonl"), read_json(folder / "config.json")
    summary = read_present_summary(folder, rows)
    warn_of_lost_rows(folder, len(rows), summary.pop("num_rows", None))
    page = Page("TD-Gammon: what was learned", lead=_lead(rows), style=_STYLE)
    try:
        agent: BackgammonAgent | None = load_agent(folder)
    except (CheckpointError, ValueError) as error:
        agent, why = None, str(error)
    page.table(tiles(_tiles(rows, summary, config, agent)))
    page.heading("Learning curve")
    changes = read_told_changes(folder)
    page.figure(
        gammon_svg(rows, [at for at, _ in changes]),
        "Points per game of money play without a cube: a gammon counts two, a backgammon three. The band is one "
        "standard error wide on each side.",
    )
    page.heading("How it opens")
    if agent is None:
        page.paragraph(f"Its weights cannot be read: {why}.", warning=True)
    else:
        _openings(page, agent)
    page.heading("How it was made")
    if agent is not None:
        page.paragraph(_asked(config_from_dict(config)))
    for _, words in changes:
        page.paragraph(sentence(words))
    page.folded("Everything that was recorded", facts_table(summary) if summary else "<p>Not recorded.</p>")
    page.folded("Effective configuration", facts_table(config))
    versions = folder / "versions.json"
    page.folded("Versions", facts_table(read_json(versions)) if versions.exists() else "<p>Not recorded.</p>")
    return page.write(folder / "report.html")


def _asked(config: TdGammonConfig) -> str:
    """What the run was asked for."""
    own = config.settings
    rates = f"α from {own.step_size:g} to {own.step_size_end:.2g}"
    end = "" if own.lambda_end in (None, own.lambda_) else f" to {own.lambda_end:g}"
    return (
        f"Asked for: {config.budget:,} games by TD(λ) in {own.mode} mode, λ {own.lambda_:g}{end}, {rates}, "
        f"{own.inputs} inputs, seed {config.seed}."
    )


def _opponents(rows: Sequence[Row]) -> list[str]:
    names = (name for row in rows for name in row if row.get("kind") == "evaluation")
    ours = (name.removeprefix("ppg_") for name in names if name.startswith("ppg_"))
    return [name for name in dict.fromkeys(ours) if not name.endswith("_standard_error")]


def points_against(rows: Sequence[Row], opponent: str) -> tuple[Floats, Floats, Floats]:
    """Games behind each evaluation, points per game against an opponent, and their standard error.

    Example:
        >>> row = {"kind": "evaluation", "env_steps": 9, "games": 2, "ppg_random": 0.5, "ppg_random_standard_error": 1}
        >>> points_against([row], "random")
        (array([2.]), array([0.5]), array([1.]))
    """
    names = ("games", f"ppg_{opponent}", f"ppg_{opponent}_standard_error")
    found = [[as_float(row.get(name)) for name in names] for _, row in rows_by_step(rows, "evaluation")]
    table = np.array(found, np.float64).reshape(-1, 3)
    games, points, errors = table[np.isfinite(table).all(axis=1)].T
    return games, points, errors


def _lead(rows: Sequence[Row]) -> str:
    for opponent in reversed(_opponents(rows)):  # the strongest stands last
        games, points, errors = points_against(rows, opponent)
        if len(games):
            did = "wins" if points[-1] >= 0 else "loses"
            return (
                f"After {games[-1]:,.0f} games against itself it {did} {abs(points[-1]):.3f} ± {errors[-1]:.3f} points "
                f"per game against {_named(opponent)}."
            )
    return "No match has been recorded yet."


def _named(opponent: str) -> str:
    return {"random": "random play", "gnubg": "GNU Backgammon"}.get(opponent, opponent)


def _tiles(
    rows: Sequence[Row], summary: Mapping[str, Any], config: Mapping[str, Any], agent: BackgammonAgent | None
) -> list[tuple[str, str, str]]:
    played, found = as_float(config.get("evaluation_games")), []
    for opponent in _opponents(rows):
        games, points, errors = points_against(rows, opponent)
        if not len(games):
            continue
        row = rows_by_step(rows, "evaluation")[-1][1]
        half = 1.96 * errors[-1]
        won = as_float(row.get(f"win_rate_{opponent}"))
        interval = f"95 % interval {points[-1] - half:+.3f} to {points[-1] + half:+.3f}"
        remark = f"points per game, {played:,.0f} games, {interval}"
        remark += f"; {won:.1%} won" if np.isfinite(won) else ""
        found.append((f"against {_named(opponent)}", f"{points[-1]:+.3f} ± {errors[-1]:.3f}", remark))
        best = int(points.argmax())
        if points[best] > points[-1]:
            found.append(
                (f"best against {_named(opponent)}", f"{points[best]:+.3f}", f"after {games[best]:,.0f} games")
            )
    last = rows_by_step(rows, "train")[-1][1] if rows_by_step(rows, "train") else {}
    count, turns, seconds = (
        as_float(summary.get(name, last.get(name))) for name in ("games", "env_steps", "cpu_seconds")
    )
    if np.isfinite(count):
        spent = f"{turns:,.0f} turns, {short_number(seconds)} CPU-seconds of training"
        found.append(("games against itself", f"{count:,.0f}", spent))
    if agent is not None:
        net = agent.network
        size = f"{len(net.w) - 1} inputs, {net.num_hidden} hidden units, {net.num_outputs} outputs"
        found.append(("network", f"{net.flat.size:,} weights", size))
    return found


def gammon_svg(rows: Sequence[Row], changed_at: Sequence[float] = (), *, name: str = "learning-curve") -> str:
    """Points per game against each opponent over games of self-play, with standard errors.

    Args:
        rows: of metrics.
        changed_at: turns behind it when the run went on with other settings; marked at the games of that time.
        name: prefix of the ids in the SVG.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    curves = {opponent: points_against(rows, opponent) for opponent in _opponents(rows)}
    curves = {opponent: curve for opponent, curve in curves.items() if len(curve[0])}

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for number, (opponent, (games, points, errors)) in enumerate(curves.items()):
            colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
            band(axes, games, points - errors, points + errors, colour)
            axes.plot(games, tame(points), color=colour, marker=marker, label=f"against {_named(opponent)}")
        mark_changes(axes, _games_at(rows, changed_at))
        axes.axhline(0.0, color="#555555", linestyle=":", linewidth=1.2)
        if not curves:
            axes.text(0.5, 0.5, "no match yet", transform=axes.transAxes, ha="center", color="#555555")
        steps_axis(axes, "games against itself")
        axes.set_ylabel("points per game")
        figure.legend(loc="outside upper left", ncols=2)

    ends = "; ".join(f"{points[-1]:+.3f} against {_named(name)}" for name, (_, points, _) in curves.items())
    return draw_svg(name, "Learning curve", f"Points per game: {ends or 'no match yet'}.", (5.2, 3.6), paint)


def _games_at(rows: Sequence[Row], turns: Sequence[float]) -> list[float]:
    """Games behind the run after so many turns."""
    known = np.array([[as_float(row.get(name)) for name in ("env_steps", "games")] for row in rows]).reshape(-1, 2)
    known = known[np.isfinite(known).all(axis=1)]
    known = known[np.argsort(known[:, 0], kind="stable")]
    return [float(np.interp(at, *known.T)) for at in turns] if len(known) else []


def _openings(page: Page, agent: BackgammonAgent) -> None:
    """A table of the fifteen first rolls, and boards of some."""
    start = Position.initial()
    page.paragraph(
        "What it plays first, and the points per game and chances that it expects from there. Chances of a win include "
        "gammons." + (" Its one output knows no gammons." if agent.network.num_outputs == 1 else "")
    )
    boards, body = [], []
    for dice in ((a, b) for a in range(2, 7) for b in range(1, a)):
        paths = WaysToPlay(start, dice).paths()
        best, second = agent.ranked_turns(start, dice, 2)
        played, other = (notation(paths[one.position.other + one.position.own]) for one in (best, second))
        chances = best.chances
        body.append([
            f"{dice[0]}-{dice[1]}", played, f"{best.equity:+.3f}", f"{chances.win:.0%}", f"{chances.gammon:.0%}",
            f"{other} ({second.equity - best.equity:+.3f})",
        ])  # fmt: skip
        if dice in _DRAWN:
            boards.append(_board(best, f"{dice[0]}-{dice[1]}: {played}, {best.equity:+.3f}"))
    page.table('<div class="boards">\n' + "\n".join(boards) + "\n</div>")
    head = ("roll", "plays", "expects", "wins", "gammons", "instead of")
    page.table(html_table("The fifteen opening rolls", head, body))


def _board(turn: RankedTurn, words: str) -> str:
    """The board that a turn leaves, seen by the side that has played it."""
    after = turn.position
    drawn = svg(list(after.other), list(after.own), False, 0, None)
    return f"<figure>{drawn}<figcaption>{words}</figcaption></figure>"
