"""The backgammon engine on one core: random games, afterstates and inputs per CPU-second.

    python scripts/bench_backgammon.py [--games 3000] [--rounds 3] [--json]

Both sides of a random game choose among all afterstates with equal chances. Inputs are the sparse form of Tesauro's
198, of the afterstates of the first 1-1. The last row is the readable interface, `Position.afterstates`, which
makes an object of every board. Medians over rounds; for example:

    random games                 4,047 games/CPU-s (96 turns each)
    afterstates              7,168,020 boards/CPU-s
    sparse inputs           23,421,264 boards/CPU-s
    Position.afterstates       309,990 boards/CPU-s

``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.inputs import MAX_ACTIVE, tesauro_sparse
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, ROLLS, START, Board, afterstates, random_game


@kernel
def encode_all(boards: Board, repeats: int, indices: NDArray[np.int64], values: NDArray[np.float32]) -> int:
    total = 0
    for _ in range(repeats):
        for i in range(len(boards)):
            total += tesauro_sparse(boards[i], 0, indices, values)
    return total


def play(num_games: int, rng: np.random.Generator, out: Board) -> tuple[float, float, float]:
    """Games and boards per CPU-second, and turns per game."""
    began, turns, seen = time.process_time(), 0, 0
    for _ in range(num_games):
        _, played, found = random_game(START, rng, out)
        turns += played
        seen += found
    seconds = time.process_time() - began
    return num_games / seconds, seen / seconds, turns / num_games


def encode(repeats: int, out: Board) -> float:
    count = afterstates(START, 1, 1, out)
    indices, values = np.empty(MAX_ACTIVE, np.int64), np.empty(MAX_ACTIVE, np.float32)
    encode_all(out[:1], 1, indices, values)
    began = time.process_time()
    encode_all(out[:count], repeats, indices, values)
    return repeats * count / (time.process_time() - began)


def make_objects(num_turns: int, rng: np.random.Generator) -> float:
    began, made, position = time.process_time(), 0, Position.initial()
    for _ in range(num_turns):
        found = position.afterstates(ROLLS[int(rng.integers(len(ROLLS)))])
        made += len(found)
        position = found[int(rng.integers(len(found)))]
        position = Position.initial() if position.winner is not None else position
    return made / (time.process_time() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--games", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rng, out = np.random.default_rng(0), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    random_game(START, rng, out)  # compiles
    played = [play(arguments.games, rng, out) for _ in range(arguments.rounds)]
    games, boards, turns = (statistics.median(values) for values in zip(*played, strict=True))
    inputs = statistics.median(encode(10 * arguments.games, out) for _ in range(arguments.rounds))
    objects = statistics.median(make_objects(arguments.games, rng) for _ in range(arguments.rounds))
    print(f"random games          {games:12,.0f} games/CPU-s ({turns:.0f} turns each)")
    print(f"afterstates           {boards:12,.0f} boards/CPU-s")
    print(f"sparse inputs         {inputs:12,.0f} boards/CPU-s")
    print(f"Position.afterstates  {objects:12,.0f} boards/CPU-s")
    if arguments.json:
        names = ("games_per_s", "afterstates_per_s", "sparse_inputs_per_s", "positions_per_s")
        print(json.dumps(dict(zip(names, (games, boards, inputs, objects), strict=True))))


if __name__ == "__main__":
    main()
