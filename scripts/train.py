"""Train on any Gymnasium environment by TD(λ), load what was learned, and play one greedy episode.

    python scripts/train.py --env CartPole-v1 --seed 3 --stop-at-return 475

prints, with the settings that are known to work for that environment:

    runs/CartPole-v1-action-output-s3-20260105-101112
    29,364 steps in 1.6 CPU-seconds; greedy return 500.0
    one greedy episode: return 500 in 500 steps, first predicted 89.2

What is predicted at the start is the discounted return (at most 100 with γ = .99). ``--layout table`` or ``linear``
work where the observations allow them, any Gymnasium id goes, and "your_module:YourEnv-v0" finds one of yours.
"""

from __future__ import annotations

import argparse

import gymnasium

import neuralq
from neuralq.runs import with_preset


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="CartPole-v1", help="Gymnasium id (default CartPole-v1)")
    parser.add_argument("--layout", default="action-output", help="or table, linear, action-input, separate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=100_000, help="environment steps (default 100,000)")
    parser.add_argument("--stop-at-return", type=float, help="end once a greedy evaluation averages this")
    parser.add_argument("--run-dir", help="folder of the run (default: a new one under runs/)")
    options = parser.parse_args()

    config = with_preset(
        {
            "env": options.env,
            "layout": options.layout,
            "seed": options.seed,
            "total_steps": options.total_steps,
            "stop_at_return": options.stop_at_return,
        }
    )
    run = neuralq.train(config, options.run_dir)
    print(run.run_dir)
    print(f"{run.env_steps:,} steps in {run.cpu_seconds:.1f} CPU-seconds; greedy return {run.agent_return:.1f}")

    agent = neuralq.load(run.run_dir)
    env = gymnasium.make(options.env)
    observation, info = env.reset(seed=options.seed)
    predicted = agent.values(observation, info.get("action_mask")).max()
    total, num_steps, terminated, truncated = 0.0, 0, False, False
    while not (terminated or truncated):
        action = agent.predict(observation, info.get("action_mask"))
        observation, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        num_steps += 1
    env.close()
    print(f"one greedy episode: return {total:g} in {num_steps} steps, first predicted {predicted:.1f}")


if __name__ == "__main__":
    main()
