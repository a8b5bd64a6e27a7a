"""A game from above as an animation moved by a style sheet alone, with a way to stop it."""

from __future__ import annotations

from html import escape
from typing import NamedTuple

import numpy as np
import torch

from neuralq.figures import COLOURS
from neuralq.learners import SmdpNetwork, smdp_network_values
from neuralq.q import Rule
from neuralq.systems.advice.kernels import MOST_STEPS
from neuralq_envs.pengo_kernels import (
    BLOCK,
    FREE,
    NUM_DEALT,
    NUM_DRAWN,
    NUM_INPUTS,
    SIDE,
    Game,
    deal,
    look,
    new_game,
    play,
)

__all__ = ["Moment", "game_film", "played"]

_SECONDS_PER_MOMENT, _HOLD_SECONDS, _CELL = 0.6, 1.8, 40
_TURNS = (0, 90, 180, 270)  # of an arrow that points north
_PLAYER, _ENEMY, _FOOD, _ADVISED = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[5]


class Moment(NamedTuple):
    """A position and what is done in it.

    Args:
        game: the position.
        action: −1 where the game has ended.
        is_advised: whether a rule says so.
        total: reward so far.
    """

    game: Game
    action: int
    is_advised: bool
    total: float


def played(network: SmdpNetwork, rules: list[Rule], seed: int = 0) -> list[Moment]:
    """One greedy game.

    Example:
        >>> from neuralq.systems.advice.studies import study
        >>> moments = played(study(np.random.SeedSequence(0), num_games=1).network, [])
        >>> moments[-1].action, moments[0].total
        (-1, 0.0)
    """
    rng, game, x = np.random.default_rng(seed), new_game(), np.zeros(NUM_INPUTS)
    deal(game, rng.random(NUM_DEALT))
    moments: list[Moment] = []
    total, over = 0.0, False
    while not over and len(moments) < MOST_STEPS:
        look(game, x)
        smdp_network_values(network, x)
        action = int(network.q.argmax())
        advised = any(rule.action == action and bool(rule.holds(torch.from_numpy(x))) for rule in rules)
        moments.append(Moment(Game(*(part.copy() for part in game)), action, advised, total))
        reward, over = play(game, action, rng.random(NUM_DRAWN))
        total += reward
    return [*moments, Moment(game, -1, False, total)]


def game_film(name: str, caption: str, moments: list[Moment]) -> str:
    """One game in motion; whoever asked for less motion sees its first position.

    Args:
        name: prefix of every name in the style sheet; letters, digits and ``-``.
        caption: stands above it.
        moments: of the game.

    Example:
        >>> from neuralq_envs.pengo_kernels import new_game
        >>> moments = [Moment(new_game(), 1, True, 0.0), Moment(new_game(), -1, False, 1.0)]
        >>> game_film("one", "A game", moments).count("<g ")
        2
    """
    whole = len(moments) * _SECONDS_PER_MOMENT + _HOLD_SECONDS
    style = _blink(f"{name}-m", _SECONDS_PER_MOMENT / whole) + _blink(f"{name}-l", 1 - _begin(len(moments) - 1) / whole)
    style += f".{name}{{animation-name:{name}-m;animation-duration:{whole:.2f}s;visibility:hidden}}"
    frames = []
    for i, moment in enumerate(moments):
        last = f"animation-name:{name}-l;" if i == len(moments) - 1 else ""
        timing = f"{last}{'visibility:visible;' if i == 0 else ''}animation-delay:{_begin(i) - whole:.2f}s"
        frames.append(f'<g class="moving {name}" style="{timing}">{_drawn(moment)}</g>')
    size, said = SIDE * _CELL, escape(caption)
    legend = "".join(
        f'<span style="color:{colour}">&#9679; {what}</span> '
        for colour, what in ((_PLAYER, "player"), (_ENEMY, "enemy"), (_FOOD, "food"), (_ADVISED, "as a rule says"))
    )
    return (
        f'<div class="film"><input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
        f"<style>{style}</style>\n<p><span>{said}</span> <span>{legend}</span></p>\n"
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-2 -2 {size + 4} {size + 30}" role="img" '
        f'style="max-width:26rem" aria-label="{said}">'
        f'<rect width="{size}" height="{size}" fill="none" stroke="var(--soft)" stroke-width="2"/>{"".join(frames)}'
        f"</svg></div>"
    )


def _begin(i: int) -> float:
    return i * _SECONDS_PER_MOMENT


def _blink(name: str, share: float) -> str:
    """To be seen for this share of the whole, from its beginning; opacity would make a layer of every moment."""
    return f"@keyframes {name}{{0%{{visibility:visible}}{100 * share:.3f}%,100%{{visibility:hidden}}}}"


def _drawn(moment: Moment) -> str:
    game, parts, side = moment.game, [], _CELL - 6
    for cell in np.flatnonzero(game.cells != FREE).tolist():
        x, y = _middle(cell)
        if game.cells[cell] == BLOCK:
            corner = f'x="{x - side / 2:g}" y="{y - side / 2:g}"'
            parts.append(f'<rect {corner} width="{side}" height="{side}" rx="4" fill="var(--soft)"/>')
        else:
            parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="7" fill="{_FOOD}"/>')
    player = int(game.player[0])
    for cell, colour in ((player, _PLAYER), *((int(enemy), _ENEMY) for enemy in game.enemies if enemy >= 0)):
        x, y = _middle(cell)
        parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="14" fill="{colour}"/>')
    if moment.action >= 0:
        x, y = _middle(player)
        place = f"translate({x:g} {y:g}) rotate({_TURNS[moment.action % 4]})"
        colour, bar = _ADVISED if moment.is_advised else "var(--ink)", "M-9-33H9" if moment.action >= 4 else ""
        path = f'<path d="M0-14V-30M-6-24L0-31L6-24{bar}" transform="{place}"'
        parts.append(f'{path} stroke="{colour}" stroke-width="4" fill="none"/>')
    under = SIDE * _CELL + 20
    return f'{"".join(parts)}<text x="2" y="{under}" font-size="16" fill="var(--ink)">reward {moment.total:.1f}</text>'


def _middle(cell: int) -> tuple[float, float]:
    return (cell % SIDE + 0.5) * _CELL, (cell // SIDE + 0.5) * _CELL
