"""The rules of backgammon once more, slow and readable, on a board that neither player owns.

Points are numbered 1 to 24 once and for all. White moves down, from 25 (its bar) to 0 (off), black up, from 0 (its
bar) to 25 (off). A board is the sorted list of where white's 15 checkers are, and the same for black's.
"""

from __future__ import annotations

from typing import NamedTuple

from neuralq_envs.backgammon import Position

Checkers = dict[int, int]  # point, counted from 1 by its side -> how many; 25 is the bar


def row(checkers: Checkers) -> bytes:
    """One side of a `Position`."""
    return bytes(checkers.get(point, 0) for point in range(1, 26))


class Table(NamedTuple):
    white: tuple[int, ...]
    black: tuple[int, ...]


def table_of(position: Position, mover_is_white: bool) -> Table:
    """The board, with the side to move as white or as black."""

    def places(row: bytes) -> list[int]:
        """Where the checkers are as their side counts: 25 the bar, 0 off."""
        return [0] * (15 - sum(row)) + [i + 1 for i, n in enumerate(row) for _ in range(n)]

    own, other = places(position.own), places(position.other)
    white, black = (own, other) if mover_is_white else (other, own)
    return Table(tuple(sorted(white)), tuple(sorted(25 - place for place in black)))


def position_of(table: Table, mover_is_white: bool) -> Position:
    rows = [bytearray(25), bytearray(25)]
    for row, places in zip(rows, (table.white, [25 - place for place in table.black]), strict=True):
        for place in places:
            if place > 0:
                row[place - 1] += 1
    own, other = rows if mover_is_white else rows[::-1]
    return Position(bytes(own), bytes(other))


def steps(table: Table, die: int, white_moves: bool) -> set[Table]:
    """The boards after one checker has moved by one die."""
    found = set()
    bar, off, way = (25, 0, -1) if white_moves else (0, 25, 1)
    mine, theirs = (table.white, table.black) if white_moves else (table.black, table.white)
    their_bar = 0 if white_moves else 25
    to_go = {place: abs(place - off) for place in mine}
    for source in set(mine) - {off}:
        if bar in mine and source != bar:
            continue
        target = source + way * die
        if to_go[source] <= die:
            if max(to_go.values()) > 6 or (to_go[source] < die and max(to_go.values()) > to_go[source]):
                continue
            target = off
        elif theirs.count(target) > 1:
            continue
        moved, hit = list(mine), list(theirs)
        moved[moved.index(source)] = target
        if target != off and target in hit:
            hit[hit.index(target)] = their_bar
        pair = tuple(sorted(moved)), tuple(sorted(hit))
        found.add(Table(*(pair if white_moves else pair[::-1])))
    return found


def turns(table: Table, dice: tuple[int, int], white_moves: bool) -> set[Table]:
    """The boards in which a turn can end."""
    large, small = max(dice), min(dice)
    orders = [[large] * 4] if large == small else [[large, small], [small, large]]
    lines = []
    for order in orders:
        boards, played = {table}, 0
        for die in order:
            further = {after for board in boards for after in steps(board, die, white_moves)}
            if not further:
                break
            boards, played = further, played + 1
        lines.append((played, boards))
    most = max(played for played, _ in lines)
    if most == 2 and large != small:
        return {board for played, boards in lines if played == 2 for board in boards}
    return next(boards for played, boards in lines if played == most)  # the larger die's come first


def slow_afterstates(position: Position, dice: tuple[int, int], mover_is_white: bool = True) -> set[Position]:
    """What `Position.afterstates` should give."""
    ends = turns(table_of(position, mover_is_white), dice, mover_is_white)
    return {position_of(table, not mover_is_white) for table in ends}
