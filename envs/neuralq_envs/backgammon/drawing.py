"""The board in letters and as SVG, seen by one player: its home is at the bottom right, its points numbered from 1.

Player 0 plays X, or the light checkers; player 1 plays O, or the dark ones. More than five checkers on a point are
drawn as five with their number on the last.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

__all__ = ["svg", "text"]

_SIGNS = "XO"
_TALLEST = 5
_OFF = 15

# SVG: units of one column, in which a checker is as wide.
_SIZE = 40
_HEIGHT = 13  # columns; 26 half points fit in it, with a margin for the numbers
_FILL = {"X": "#f5efe0", "O": "#3b3b44"}
_INK = {"X": "#3b3b44", "O": "#f5efe0"}


def text(near: Sequence[int], far: Sequence[int], near_moves: bool, seat: int, dice: tuple[int, int] | None) -> str:
    r"""The board as 13 lines of letters.

    Args:
        near: checkers of the player who looks, on its points 1 to 24 and its bar, 25 numbers.
        far: those of the other player, counted from the other end.
        near_moves: whether the player who looks is to move.
        seat: that player, 0 or 1.
        dice: what has been rolled, or None.

    Example:
        >>> start = [0, 0, 0, 0, 0, 5, 0, 3, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0]
        >>> print("\n".join(text(start, start, True, 0, (3, 1)).splitlines()[:4]))
        +13-14-15-16-17-18-+---+-19-20-21-22-23-24-+  O: 167 pips, 0 off
        | X           O    |   |  O              X |
        | X           O    |   |  O              X |
        | X           O    |   |  O                |
    """
    signs = _SIGNS[seat], _SIGNS[1 - seat]
    columns = [_column(near, far, point, signs) for point in range(24)]
    top, bottom = columns[12:], columns[11::-1]
    bars = _stack(far[24], signs[1]), _stack(near[24], signs[0])
    lines = ["+13-14-15-16-17-18-+---+-19-20-21-22-23-24-+  " + _account(far, signs[1], not near_moves, dice)]
    lines += [_row(top, bars[0], height) for height in range(_TALLEST)]
    lines += ["|                  |BAR|                   |"]
    lines += [_row(bottom, bars[1], height) for height in reversed(range(_TALLEST))]
    lines += ["+12-11-10--9--8--7-+---+--6--5--4--3--2--1-+  " + _account(near, signs[0], near_moves, dice)]
    return "\n".join(lines) + "\n"


def _column(near: Sequence[int], far: Sequence[int], point: int, signs: tuple[str, str]) -> str:
    """What lies on a point, from the rim inwards, five letters; point 0 is the near player's ace point."""
    return _stack(near[point], signs[0]) if near[point] else _stack(far[23 - point], signs[1])


def _stack(count: int, sign: str) -> str:
    """``count`` signs; of more than five the last gives way to their number, as one hexadecimal digit."""
    return (sign * count).ljust(_TALLEST) if count <= _TALLEST else sign * (_TALLEST - 1) + f"{count:x}"


def _row(columns: Sequence[str], bar: str, height: int) -> str:
    cells = [f" {column[height]} " for column in columns]
    return f"|{''.join(cells[:6])}| {bar[height]} | {''.join(cells[6:])}|"


def _account(row: Sequence[int], sign: str, moves: bool, dice: tuple[int, int] | None) -> str:
    pips = sum((i + 1) * n for i, n in enumerate(row))
    rolled = "" if not moves else ", to move" if dice is None else f", to play {dice[0]}-{dice[1]}"
    return f"{sign}: {pips} pips, {_OFF - sum(row)} off{rolled}"


def svg(near: Sequence[int], far: Sequence[int], near_moves: bool, seat: int, dice: tuple[int, int] | None) -> str:
    """The board as a picture of 600 by 520 units, which scales to the place it is put in.

    Each point, the bar and the trays are groups with ``data-point`` 1 to 24, ``bar`` or ``off`` as the player who
    looks counts them, each checker a circle of class ``x`` or ``o``; so a page can find and change them.

    Args:
        near: checkers of the player who looks, on its points 1 to 24 and its bar, 25 numbers.
        far: those of the other player, counted from the other end.
        near_moves: whether the player who looks is to move.
        seat: that player, 0 or 1.
        dice: what has been rolled, or None.

    Example:
        >>> start = [0, 0, 0, 0, 0, 5, 0, 3, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0]
        >>> svg(start, start, True, 0, None).count("<circle")
        30
    """
    signs = _SIGNS[seat], _SIGNS[1 - seat]
    width, height = 15 * _SIZE, _HEIGHT * _SIZE
    label = f"Backgammon board. {_account(far, signs[1], not near_moves, dice)}. " + _account(
        near, signs[0], near_moves, dice
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" font-family="sans-serif" '
        f'font-size="{_SIZE * 0.4:g}" text-anchor="middle"><title>{label}</title>',
        f'<rect width="{width}" height="{height}" fill="#7a5c43"/>',
        *(_rectangle(column, 6, "#d9c7a3") for column in (0.5, 7.5)),
        *(part for point in range(24) for part in _point(near, far, point, signs)),
        *_pile("bar", 7, near[24], signs[0], at_top=False),
        *_pile("bar", 7, far[24], signs[1], at_top=True),
        *_pile("off", 14.25, _OFF - sum(near), signs[0], at_top=False),
        *_pile("off", 14.25, _OFF - sum(far), signs[1], at_top=True),
        *_dice(dice, signs[0] if near_moves else signs[1], 10.5 if near_moves else 3.5),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _rectangle(column: float, columns: float, colour: str) -> str:
    return (
        f'<rect x="{column * _SIZE:g}" y="{_SIZE}" width="{columns * _SIZE:g}" height="{(_HEIGHT - 2) * _SIZE}" '
        f'fill="{colour}"/>'
    )


def _point(near: Sequence[int], far: Sequence[int], point: int, signs: tuple[str, str]) -> Iterator[str]:
    """The triangle, the number and the checkers of a point; point 0 is the near player's ace point, bottom right."""
    at_top = point >= 12
    place = point - 12 if at_top else 11 - point  # from the left
    column = place + (1 if place < 6 else 2)  # the bar is one column wide
    x, rim, tip = column * _SIZE, *((_SIZE, 6 * _SIZE) if at_top else (12 * _SIZE, 7 * _SIZE))
    colour = "#b5523b" if point % 2 else "#efe6d0"
    number = 0.65 * _SIZE if at_top else 12.6 * _SIZE
    half = _SIZE / 2
    yield f'<path d="M{x - half:g} {rim}L{x + half:g} {rim}L{x:g} {tip}Z" fill="{colour}"/>'
    yield f'<text x="{x:g}" y="{number:g}" fill="#f5efe0">{point + 1}</text>'
    count, sign = (near[point], signs[0]) if near[point] else (far[23 - point], signs[1])
    yield from _pile(str(point + 1), column, count, sign, at_top)


def _pile(name: str, column: float, count: int, sign: str, at_top: bool) -> Iterator[str]:
    """The checkers on a point, on the bar or in a tray, from the rim inwards."""
    yield f'<g data-point="{name}" data-count="{count}">'
    step = _SIZE * min(1.0, (_TALLEST - 1) / max(count - 1, 1))
    for i in range(count):
        y = 1.5 * _SIZE + i * step
        y = y if at_top else _HEIGHT * _SIZE - y
        yield (
            f'<circle class="{sign.lower()}" cx="{column * _SIZE:g}" cy="{y:g}" r="{_SIZE * 0.46:g}" '
            f'fill="{_FILL[sign]}" stroke="#201a14"/>'
        )
    if count > _TALLEST:
        y = 1.65 * _SIZE + (count - 1) * step
        y = y if at_top else (_HEIGHT + 0.3) * _SIZE - y
        yield f'<text x="{column * _SIZE:g}" y="{y:g}" fill="{_INK[sign]}">{count}</text>'
    yield "</g>"


def _dice(dice: tuple[int, int] | None, sign: str, column: float) -> Iterator[str]:
    for i, die in enumerate(dice or ()):
        x, y = (column - 0.7 + 1.4 * i) * _SIZE, _HEIGHT / 2 * _SIZE
        yield (
            f'<rect x="{x - 0.4 * _SIZE:g}" y="{y - 0.4 * _SIZE:g}" width="{0.8 * _SIZE:g}" height="{0.8 * _SIZE:g}" '
            f'rx="6" fill="{_FILL[sign]}" stroke="#201a14"/>'
            f'<text x="{x:g}" y="{y + 0.15 * _SIZE:g}" fill="{_INK[sign]}">{die}</text>'
        )
