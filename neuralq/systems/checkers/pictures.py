"""What checkers shows: a board with what the search says of every move, the weights as they grow, and rote learning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.checkers.player import CheckersPlayer, RankedMove
from neuralq.systems.checkers.terms import TERMS
from neuralq.systems.checkers.training import Endgames, Wins
from neuralq_envs.checkers import Position

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["SHOWN", "announced_picture", "board_picture", "board_svg", "rote_picture", "weights_picture"]

SHOWN = "B:W9,15,28,29,30,32:B1,3,4,8,18,22"
"""The 31st of a game of the learned weights with themselves."""
_SIZE = 60


def board_picture(weights: NDArray[np.float64], depth: int = 7) -> Picture:
    """A board with an arrow for each move, and what a search with these weights says of it."""
    position = Position.from_fen(SHOWN)
    ranked = CheckersPlayer(weights, depth, seed=0).ranked(position)
    said = ", ".join(f"{one.move} {_signed(one.score)}" for one in ranked)
    caption = (
        f"{'White' if position.turn else 'Black'} to move, pieces being equal. On each move what a search of {depth} "
        f"plies says of it, in men, by the learned weights; the best in yellow. {said}."
    )
    return Picture("What the search says of every move", board_svg(position, ranked), caption)


def board_svg(position: Position, ranked: Sequence[RankedMove]) -> str:
    """A board of 480 by 480 units with arrows for moves.

    Example:
        >>> board_svg(Position.initial(), []).count("<circle")
        24
    """
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {8 * _SIZE} {8 * _SIZE}" role="img" '
        'style="display:block;width:100%;max-width:30rem" font-family="sans-serif" text-anchor="middle">'
        f"<title>{escape(f'Checkers board, {position.fen}')}</title>"
        f'<rect width="{8 * _SIZE}" height="{8 * _SIZE}" fill="#e8dcc4"/>'
    ]
    held = position.pieces()
    for square in range(1, 33):
        x, y = _middle(square)
        corner = f'x="{x - _SIZE / 2:g}" y="{y - _SIZE / 2:g}"'
        parts.append(f'<rect {corner} width="{_SIZE}" height="{_SIZE}" fill="#5f7a61"/>')
        number = f'x="{x - 0.36 * _SIZE:g}" y="{y - 0.3 * _SIZE:g}"'
        parts.append(f'<text {number} font-size="10" fill="#e8f0e8">{square}</text>')
        if square in held:
            side, is_king = held[square]
            fill, line = (("#26262d", "#9a9aa8"), ("#f9f2e3", "#8c7a5c"))[side]
            parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="{0.38 * _SIZE:g}" fill="{fill}" stroke="{line}"/>')
            if is_king:
                parts.append(f'<text x="{x:g}" y="{y + 8:g}" font-size="24" fill="{line}">♔</text>')
    for i, one in reversed(list(enumerate(ranked))):
        parts += _arrow(one, is_best=i == 0)
    return "\n".join([*parts, "</svg>"])


def _signed(score: float) -> str:
    return f"{score:+.2f}".replace("-", "−")


def _middle(square: int) -> tuple[float, float]:
    row, i = divmod(square - 1, 4)
    return (2 * i + 1.5 - row % 2) * _SIZE, (row + 0.5) * _SIZE


def _arrow(one: RankedMove, is_best: bool) -> list[str]:
    """The way of a piece, and at its end the score."""
    colour, width = ("#ffd34d", 5) if is_best else ("#ffffff", 2.5)
    points = [_middle(square) for square in one.move.squares]
    x, y = points[-1]
    way = " ".join(f"{x:g},{y:g}" for x, y in points)
    # Where two moves end on one square their labels stand on the way instead.
    x, y = (x + 2 * points[-2][0]) / 3, (y + 2 * points[-2][1]) / 3
    x, y = x + (points[-1][0] - points[-2][0]) / 4, y + (points[-1][1] - points[-2][1]) / 4
    return [
        f'<polyline points="{way}" fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linecap="round"/>',
        f'<rect x="{x - 21:g}" y="{y - 9:g}" width="42" height="18" rx="5" fill="{colour}"/>',
        f'<text x="{x:g}" y="{y + 5:g}" font-size="13" fill="#1b1f24">{_signed(one.score)}</text>',
    ]


def weights_picture(histories: Sequence[NDArray[np.float64]]) -> Picture:
    """Weights by game: one training whole, and the averages of all of them.

    Args:
        histories: weights after each game, ``[N, 14]`` each.
    """
    names, last = list(TERMS), len(histories[0])
    averages = np.array([history[last // 2 :].mean(axis=0) for history in histories])

    def paint(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, height_ratios=(3, 2))
        for i in range(1, len(names)):
            colour, style = COLOURS[(i - 1) % 7], "-" if i <= 7 else "--"
            above.plot(np.arange(1, last + 1), histories[0][:, i], style, color=colour, linewidth=1.4, label=names[i])
            below.plot(np.full(len(averages), i), averages[:, i], ".", color=colour)
        above.axvspan(last / 2, last, color="#000000", alpha=0.05, linewidth=0)
        above.set_xlabel("games of one training")
        above.set_ylabel("weight, in men")
        below.set_xticks(range(1, len(names)), names[1:], rotation=90, fontsize=9)
        below.set_ylabel("average")
        figure.legend(*above.get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=8)

    said = ", ".join(f"{name} {value:+.2f}" for name, value in zip(names, averages.mean(axis=0), strict=True))
    svg = draw_svg("weights", "Weights over games", f"Averages: {said}.", (5.2, 5.6), paint)
    counted = "; ".join(f"{name}: {what}" for name, what in TERMS.items())
    caption = (
        "Above: what one training does to its weights; averages are of the shaded half. Below: the averages of "
        "all trainings. The weight of the advantage in pieces is fixed at 1, so the others are in men. Counted are, "
        f"each less that of the other side: {counted}."
    )
    return Picture("The weights over games", svg, caption)


def rote_picture(
    studies: Mapping[str, Sequence[Sequence[Endgames]]], deeper: Sequence[Sequence[Endgames]],
    games_between: int, depths: Sequence[int],
) -> Picture:  # fmt: skip
    """Share of endgames won and positions looked at, by games that are remembered.

    Args:
        studies: by name, the tests of every training.
        deeper: the same tests without a memory, for each depth.
        games_between: games from one test to the next.
        depths: of those without a memory.
    """

    def paint(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        for (name, trainings), colour, marker in zip(studies.items(), COLOURS, MARKERS, strict=False):
            games = games_between * np.arange(len(trainings[0]))
            for axes, value in ((above, _won), (below, _nodes)):
                values = np.array([[value(one) for one in tests] for tests in trainings])
                axes.plot(games, np.median(values, axis=0), color=colour, marker=marker, label=name)
                axes.plot(games, values.T, color=colour, alpha=0.2, linewidth=0.8)
        for i, depth in enumerate(depths):
            for axes, value in ((above, _won), (below, _nodes)):
                level = float(np.median([value(tests[i]) for tests in deeper]))
                axes.axhline(level, color="#555555", linestyle=":", linewidth=1.2)
                axes.text(1, level, f" {depth} plies", transform=axes.get_yaxis_transform(), va="center", fontsize=8)
        above.set_ylabel("won (%)")
        below.set_ylabel("positions looked at\nper endgame")
        below.set_yscale("log")
        below.set_xlabel("games remembered")
        figure.legend(*above.get_legend_handles_labels(), loc="outside upper left", ncols=2)

    said = " ".join(
        f"{name}: {100 * np.median([tests[-1].won for tests in trainings]):.0f} % won after "
        f"{games_between * (len(trainings[0]) - 1):,} games."
        for name, trainings in studies.items()
    )
    svg = draw_svg("rote", "Rote learning", said, (5.2, 5.0), paint)
    caption = (
        "Three kings against one that looks five plies ahead; the program itself looks three plies ahead and takes "
        "what it remembers for its leaves. Dotted: programs without a memory that look so many plies ahead. With the "
        "ply penalty it wins more and has less to look at. Without it all wins look alike, and the more it remembers "
        "the more it wanders from one won position to another."
    )
    return Picture("Rote learning, with and without a sense of direction", svg, caption)


def _won(one: Endgames) -> float:
    return 100 * one.won


def _nodes(one: Endgames) -> float:
    return one.nodes / len(one.results)


def announced_picture(found: Sequence[Wins]) -> Picture:
    """How long a win takes that a search has seen, by ply penalty."""
    penalties = list(found[0].endgames)
    rows = [np.concatenate([one.endgames[penalty].plies for one in found]) for penalty in penalties]
    most = 21

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (penalty, plies) in enumerate(zip(penalties, rows, strict=True)):
            shares = [100 * np.mean(np.minimum(plies, most) == n) for n in range(1, most + 1, 2)]
            axes.bar(np.arange(1, most + 1, 2) + 0.55 * (i - 1), shares, 0.5, color=COLOURS[i], label=f"{penalty:g}")
        axes.set_xticks(range(1, most + 1, 2), [*map(str, range(1, most, 2)), f"≥ {most}"])
        axes.set_xlabel("plies until it is won")
        axes.set_ylabel("endgames (%)")
        figure.legend(title="ply penalty", loc="outside upper left", ncols=3)

    means = ", ".join(f"{penalty:g}: {plies.mean():.1f}" for penalty, plies in zip(penalties, rows, strict=True))
    svg = draw_svg("announced", "How long a win takes", f"Mean plies by ply penalty: {means}.", (5.2, 3.4), paint)
    caption = (
        "Three kings against one that moves at random, from positions in which a search of seven plies sees the win. "
        f"Mean plies by ply penalty: {means}. With a penalty no win takes longer than was announced."
    )
    return Picture("Of two wins the nearer one", svg, caption)
