"""Learn backgammon by self-play (TD-Gammon), then ask what was learned for a move and a value.

    python scripts/td_gammon.py --games 20000 --hidden 40 --seed 3

learns in ten seconds of one core, and prints, with a board below on which the opening 3-1 makes the five point:

    runs/td-gammon-198-40-4-online-s3-20260105-101112
    20,000 games, 1,298,397 turns in 10.0 CPU-seconds
    points per game against random: +2.656 ± 0.019
    equity of the side that begins: +0.088; it would play 3-1 so:

A run that was stopped goes on with ``neuralq resume``, and ``neuralq train td-gammon`` has every setting as an option.
"""

from __future__ import annotations

import argparse

import neuralq
from neuralq.backgammon import SelfPlaySettings
from neuralq.systems.backgammon.config import TdGammonConfig
from neuralq.systems.backgammon.run import train_games
from neuralq_envs.backgammon import Position

EXAMPLES = """examples:
  python scripts/td_gammon.py --games 20000 --hidden 40 --seed 3
  python scripts/td_gammon.py --games 1500000 --against random pubeval --run-dir runs/td-gammon"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--games", type=int, default=20_000, help="games of self-play (default 20,000)")
    parser.add_argument("--hidden", type=int, default=40, help="hidden units (default 40)")
    parser.add_argument("--lambda", dest="lambda_", type=float, default=0.3, help="λ (default 0.3)")
    parser.add_argument("--step-size", type=float, default=0.3, help="α at the beginning (default 0.3)")
    parser.add_argument("--step-size-end", type=float, default=0.01, help="α at the end (default 0.01)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--against", nargs="+", default=["random"], help="random, pubeval, gnubg (default random)")
    parser.add_argument("--run-dir", help="folder of the run (default: a new one under runs/)")
    options = parser.parse_args()

    settings = SelfPlaySettings(
        num_games=options.games,
        num_hidden=options.hidden,
        lambda_=options.lambda_,
        step_size=options.step_size,
        step_size_end=options.step_size_end,
    )
    config = TdGammonConfig(settings, options.seed, evaluate_every=50_000, evaluate_against=tuple(options.against))
    run = train_games(config, options.run_dir)
    print(run.run_dir)
    print(f"{run.games:,} games, {run.env_steps:,} turns in {run.cpu_seconds:.1f} CPU-seconds")
    for opponent, (points, error) in run.points_per_game.items():
        print(f"points per game against {opponent}: {points:+.3f} ± {error:.3f}")

    agent = neuralq.load(run.run_dir)
    start = Position.initial()
    print(f"equity of the side that begins: {agent.equity(start):+.3f}; it would play 3-1 so:")
    print(agent.best_move(start, (3, 1)).text(seat=0))


if __name__ == "__main__":
    main()
