"""English draughts written out on coordinates, without a bit: what the compiled rules and terms are held to."""

from __future__ import annotations

from typing import NamedTuple


class Board(NamedTuple):
    """Pieces by (row, column) from the top, square 1 being (0, 1): 'b', 'w', and 'B', 'W' for kings; who moves."""

    pieces: dict[tuple[int, int], str]
    turn: str


def place(square: int) -> tuple[int, int]:
    row, i = divmod(square - 1, 4)
    return row, 2 * i + (1 if row % 2 == 0 else 0)


def square(row: int, column: int) -> int:
    return 4 * row + column // 2 + 1


def read(fen: str) -> Board:
    turn, *sides = fen.split(":")
    pieces = {}
    for side in sides:
        for written in filter(None, side[1:].split(",")):
            sign = side[0] if written.startswith("K") else side[0].lower()
            pieces[place(int(written.lstrip("K")))] = sign
    return Board(pieces, turn.lower())


def ways(sign: str) -> list[tuple[int, int]]:
    down, up = [(1, -1), (1, 1)], [(-1, -1), (-1, 1)]
    return down + up if sign in "BW" else down if sign == "b" else up


def on_board(row: int, column: int) -> bool:
    return 0 <= row < 8 and 0 <= column < 8


def is_last(sign: str, row: int) -> bool:
    return row == (7 if sign in "bB" else 0)


def moves(board: Board) -> dict[tuple[int, ...], Board]:
    """Every legal move by its squares, with the board that it leaves."""
    jumps, steps = {}, {}
    for at, sign in board.pieces.items():
        if sign.lower() != board.turn:
            continue
        rest = {where: one for where, one in board.pieces.items() if where != at}
        for path, left in _jumps(rest, at, sign):
            jumps[tuple(square(*one) for one in path)] = _landed(left, path[-1], sign, board.turn)
        for down, across in ways(sign):
            target = (at[0] + down, at[1] + across)
            if on_board(*target) and target not in rest:
                steps[square(*at), square(*target)] = _landed(rest, target, sign, board.turn)
    return jumps or steps


def _landed(rest: dict[tuple[int, int], str], at: tuple[int, int], sign: str, turn: str) -> Board:
    crowned = sign.upper() if is_last(sign, at[0]) else sign
    return Board({**rest, at: crowned}, "w" if turn == "b" else "b")


def _jumps(
    rest: dict[tuple[int, int], str], at: tuple[int, int], sign: str
) -> list[tuple[list[tuple[int, int]], dict[tuple[int, int], str]]]:
    """Ways to capture on from here, each with what is left; the piece itself is in the air."""
    found = []
    for down, across in ways(sign):
        over, to = (at[0] + down, at[1] + across), (at[0] + 2 * down, at[1] + 2 * across)
        if rest.get(over, sign).lower() == sign.lower() or not on_board(*to) or to in rest:
            continue
        left = {where: one for where, one in rest.items() if where != over}
        on = [] if sign.islower() and is_last(sign, to[0]) else _jumps(left, to, sign)
        found += [([at, *path], after) for path, after in on] or [([at, to], left)]
    return found


def terms(board: Board) -> list[float]:
    """The fourteen terms for the side to move."""
    mine, theirs = (_counts(board, turn) for turn in (board.turn, "w" if board.turn == "b" else "b"))
    found = [a - b for a, b in zip(mine, theirs, strict=True)]
    return [*found, found[0] * (24 - len(board.pieces)) / 24]


def _counts(board: Board, turn: str) -> list[float]:
    def height(row: int) -> int:  # from 1, one's own first row
        return row + 1 if turn == "b" else 8 - row

    own = {at: sign for at, sign in board.pieces.items() if sign.lower() == turn}
    men = [at for at, sign in own.items() if sign.islower()]
    kings = [at for at, sign in own.items() if sign.isupper()]
    rows = [height(row) for row, _ in men]
    middle = {(row, column) for row in (2, 3, 4, 5) for column in (2, 3, 4, 5)}
    beside = [at for at in men if any((at[0] + i, at[1] + j) in own for i in (-1, 1) for j in (-1, 1))]
    free = sum(
        on_board(row + i, column + j) and (row + i, column + j) not in board.pieces
        for (row, column), sign in own.items()
        for i, j in ways(sign)
    )
    exposed = set()
    for (row, column), sign in board.pieces.items():
        for i, j in ways(sign) if sign.lower() != turn else []:
            behind = (row + 2 * i, column + 2 * j)
            if (row + i, column + j) in own and on_board(*behind) and behind not in board.pieces:
                exposed.add((row + i, column + j))
    bridge = {place(1), place(3)} if turn == "b" else {place(32), place(30)}
    return [
        len(men) + 1.5 * len(kings),
        sum(row in (5, 6) for row in rows) - sum(row in (3, 4) for row in rows),
        rows.count(1),
        rows.count(7),
        len(own.keys() & middle),
        sum(column in (0, 7) for _, column in own),
        sum(row - 1 for row in rows) / 5,
        len(set(kings) & middle),
        len(kings),
        len(men) - len(beside),
        free / 4,
        len(exposed),
        float(bridge <= set(men)),
    ]
