"""Environment steps per CPU-second on CartPole-v1, one thread: our two deep learners beside their peers.

    pip install "neuralq[bench]"
    python scripts/bench_throughput.py [--rounds 3] [--json]

The rollout learner runs at the settings of CleanRL's PQN (T = 128, 4 epochs × 4 minibatches, layer-normalised MLP
120-84, RAdam 2.5e-4 annealed, λ = .65, gradient norm 10). CleanRL is no package, so its rate is a constant, measured on
a quiet machine where SB3's DQN below made 935 steps per CPU-second. The replay learner (1 environment, batch 64, one
update per step, MLP 64-64, 50,000 transitions, target copy every 500 updates, Adam, Huber, gradient norm 10) takes
turns with Stable-Baselines3's DQN at the same settings, so that a busy machine slows both; what SB3 made beside 935
says how busy or slow this machine is. Training only: building, compiling and evaluating are not counted. Medians over
rounds; for example:

    learner                    ours [steps/CPU-s]   peer [steps/CPU-s]   ratio   peer
    rollout, 4 x 128                       50,362                7,000    7.2x   CleanRL PQN, quiet machine
    rollout, 64 x 128                     196,811               26,000    7.6x   CleanRL PQN, quiet machine
    replay, 1 environment                  13,126                1,041   12.6x   SB3 DQN, alternating
    SB3 made 1,041 where a quiet machine makes 935; at equal speed the ratios would be:
    rollout, 4 x 128                                                      6.5x
    rollout, 64 x 128                                                     6.8x

``--json`` prints one JSON object as the last line: ``{"rollout, 4 x 128": {"ours": ..., "peer": ..., "ratio": ...}}``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import tempfile
import time
from pathlib import Path

import gymnasium
import torch

import neuralq
from neuralq.learners import ReplaySettings, RolloutSettings
from neuralq.q import MLP

HAS_PEER = importlib.util.find_spec("stable_baselines3") is not None

CLEANRL_PQN = {4: 7_000.0, 64: 26_000.0}
"""Steps per CPU-second of CleanRL's pqn.py by number of environments: quiet machine, one thread, otherwise as here."""

SB3_QUIET = 935.0
"""The same of SB3's DQN on that machine."""


def rollout_config(num_envs: int, num_steps: int) -> neuralq.RunConfig:
    settings = RolloutSettings(
        lambda_=0.65, num_envs=num_envs, num_steps=128, num_epochs=4, num_minibatches=4,
        learning_rate=2.5e-4, optimiser="radam", max_grad_norm=10.0, anneal=True,
    )  # fmt: skip
    return neuralq.RunConfig(
        env="CartPole-v1", total_steps=num_steps, epsilon_decay_steps=max(1, num_steps // 2),
        body=MLP(hidden=(120, 84), layer_norm=True), rollout=settings,
        evaluate_every=10 * num_steps, evaluation_episodes=1, checkpoint_every=10 * num_steps,
    )  # fmt: skip


def replay_config(num_steps: int) -> neuralq.RunConfig:
    settings = ReplaySettings(
        capacity=50_000, batch_size=64, learning_starts=100, train_period=1, updates_per_period=1,
        target_period_updates=500, learning_rate=5e-4, optimiser="adam", loss="huber", max_grad_norm=10.0,
    )  # fmt: skip
    return neuralq.RunConfig(
        env="CartPole-v1", learner="replay", total_steps=num_steps, epsilon_decay_steps=max(1, num_steps // 10),
        body=MLP(hidden=(64, 64)), replay=settings,
        evaluate_every=10 * num_steps, evaluation_episodes=1, checkpoint_every=10 * num_steps,
    )  # fmt: skip


def ours(config: neuralq.RunConfig) -> float:
    with tempfile.TemporaryDirectory() as folder:
        run = neuralq.train(config, Path(folder, "run"))
    return run.env_steps / run.cpu_seconds


def stable_baselines3(num_steps: int) -> float:
    from stable_baselines3 import DQN

    model = DQN(
        "MlpPolicy", gymnasium.make("CartPole-v1"), learning_rate=5e-4, buffer_size=50_000, learning_starts=100,
        batch_size=64, tau=1.0, gamma=0.99, train_freq=1, gradient_steps=1, target_update_interval=500,
        exploration_fraction=0.1, exploration_final_eps=0.05, max_grad_norm=10.0,
        policy_kwargs={"net_arch": [64, 64]}, device="cpu", seed=0,
    )  # fmt: skip
    start = time.process_time()
    model.learn(num_steps)
    return num_steps / (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3, help="how often each is measured (default 3)")
    parser.add_argument("--rollout-steps", type=int, default=50_000, help="steps per round (default 50,000)")
    parser.add_argument("--replay-steps", type=int, default=5_000, help="the same with replay (default 5,000)")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, dict[str, float]] = {}
    print(f"{'learner':<24} {'ours [steps/CPU-s]':>20} {'peer [steps/CPU-s]':>20} {'ratio':>7}   peer")

    def show(name: str, rates: list[float], peer: float | None, who: str) -> None:
        rate = statistics.median(rates)
        results[name] = {"ours": rate} if peer is None else {"ours": rate, "peer": peer, "ratio": rate / peer}
        beside = f"{'-':>20} {'-':>7}" if peer is None else f"{peer:>20,.0f} {rate / peer:>6.1f}x"
        print(f"{name:<24} {rate:>20,.0f} {beside}   {who}", flush=True)

    for num_envs, reference in CLEANRL_PQN.items():
        rates = [ours(rollout_config(num_envs, options.rollout_steps)) for _ in range(options.rounds)]
        show(f"rollout, {num_envs} x 128", rates, reference, "CleanRL PQN, quiet machine")
    num_steps = options.replay_steps
    if not HAS_PEER:
        rates = [ours(replay_config(num_steps)) for _ in range(options.rounds)]
        show("replay, 1 environment", rates, None, 'SB3 is missing; run: pip install "neuralq[bench]"')
    else:
        pairs = [(ours(replay_config(num_steps)), stable_baselines3(num_steps)) for _ in range(options.rounds)]
        peer = statistics.median(rate for _, rate in pairs)
        show("replay, 1 environment", [rate for rate, _ in pairs], peer, "SB3 DQN, alternating")
        speed = peer / SB3_QUIET
        print(f"SB3 made {peer:,.0f} where a quiet machine makes {SB3_QUIET:,.0f}; at equal speed the ratios would be:")
        for name, row in results.items():
            if name.startswith("rollout"):
                row["ratio_at_equal_speed"] = row["ours"] / speed / row["peer"]
                print(f"{name:<24} {row['ratio_at_equal_speed']:>49.1f}x")
    if options.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
