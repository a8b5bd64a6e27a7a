"""Replay side by side with Stable-Baselines3: adds and samples per second at equal settings, one thread.

    pip install "neuralq[bench]"
    python scripts/bench_replay.py

prints one row for each observation size and operation: microseconds of CPU time of either buffer (the median over
rounds that alternate between the two, so that a change of the machine's speed meets both) and how many times as many
operations per CPU-second ours makes. Measured:

    observation     operation          ours [us]   SB3 [us]   ratio
    4 x float32     add, one step           1.64       5.15    3.1x
    4 x float32     add, rollout            0.45       5.27   11.6x
    4 x float32     sample 256             28.39     125.05    4.4x
    84x84x4 uint8   add, one step           3.03       7.94    2.6x
    84x84x4 uint8   add, rollout            2.70       9.04    3.4x
    84x84x4 uint8   sample 32             124.69     336.54    2.7x

(on a machine of two cores that was busy otherwise; a quiet one is about twice as fast in both columns).
"add, one step" is the step of one environment, from arrays and Python numbers; "add, rollout" is 64 steps handed over
at once, as after a rollout (SB3's `extend` is a loop over `add`), counted per step. Samples are tensors on the CPU:
256 of 4 floats, 32 of 84x84x4 bytes. Both buffers are full, and as large as ``--capacity`` says. When it is so large
that the stored images do not fit into the processor's cache, drawing them is bound by the memory's bandwidth, which no
program can raise: the ratio is then lower than in cache.

``--json`` prints one JSON object as the last line: ``{"4 x float32": {"add, one step": {"ours_us": ..., ...}}}``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch

from neuralq import ReplayBuffer, Transition

PeerBuffer: Any = None  # without it only --help works
if importlib.util.find_spec("stable_baselines3") is not None:
    PeerBuffer = importlib.import_module("stable_baselines3.common.buffers").ReplayBuffer

NUM_STEPS = 64


@dataclass(frozen=True)
class Setting:
    """One observation size and the batch it is drawn in."""

    name: str
    space: gymnasium.spaces.Box
    batch_size: int


SETTINGS = (
    Setting("4 x float32", gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32), 256),
    Setting("84x84x4 uint8", gymnasium.spaces.Box(0, 255, (84, 84, 4), np.uint8), 32),
)


def operations(setting: Setting, capacity: int) -> dict[str, tuple[int, Callable[[], Any], Callable[[], Any]]]:
    """For each operation: how many steps one call makes, our call, theirs. Both buffers are full."""
    space, rng = setting.space, np.random.default_rng(0)
    assert space.dtype is not None
    ours = ReplayBuffer(capacity, space.shape, space.dtype)
    theirs = PeerBuffer(capacity, space, gymnasium.spaces.Discrete(4), device="cpu")
    space.seed(0)
    chain = np.stack([space.sample() for _ in range(NUM_STEPS + 1)])
    zeros = np.zeros(NUM_STEPS, np.float32)
    actions = np.ones(NUM_STEPS, np.int64)
    fields = (chain[:-1], actions, zeros + 1, zeros, zeros + np.float32(0.99), chain[1:], zeros > 0)
    # A rollout from one environment: [T, 1], time first.
    rollout = Transition(*(torch.from_numpy(x.copy())[:, None] for x in fields))
    s_tm1, s_t = chain[0], chain[0].copy()  # the chain s, s, s, ... is one stream
    action, reward, last = np.array([1]), np.array([0.5]), np.array([False])
    infos: list[dict[str, Any]] = [{}]
    near, far = s_tm1[None], s_t[None]

    def add_theirs() -> None:
        theirs.add(near, far, action, reward, last, infos)

    def add_ours() -> None:
        ours.add_step(0, s_tm1, 1, 1.0, 0.5, 0.99, s_t, False)

    def extend_theirs() -> None:
        for i in range(NUM_STEPS):
            theirs.add(chain[i : i + 1], chain[i + 1 : i + 2], action, reward, last, infos)

    for _ in range(2 * capacity):
        add_ours()
        add_theirs()
    return {
        "add, one step": (1, add_ours, add_theirs),
        "add, rollout": (NUM_STEPS, lambda: ours.add(rollout), extend_theirs),
        f"sample {setting.batch_size}": (
            1,
            lambda: ours.sample(setting.batch_size, rng),
            lambda: theirs.sample(setting.batch_size),
        ),
    }


def cpu_us(call: Callable[[], Any], seconds: float) -> float:
    """Microseconds of CPU time per call, over about that many seconds."""
    calls, start = 0, time.process_time()
    while (spent := time.process_time() - start) < seconds:
        for _ in range(50):
            call()
        calls += 50
    return spent / calls * 1e6


def measure(setting: Setting, capacity: int, rounds: int, seconds: float) -> dict[str, dict[str, float]]:
    """Medians of either buffer and their ratio, operation by operation."""
    results = {}
    for name, (num_steps, ours, theirs) in operations(setting, capacity).items():
        ours(), theirs()  # compile and allocate
        pairs = [(cpu_us(ours, seconds), cpu_us(theirs, seconds)) for _ in range(rounds)]
        mine, other = (statistics.median(x) / num_steps for x in zip(*pairs, strict=True))
        results[name] = {"ours_us": mine, "sb3_us": other, "ratio": other / mine}
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capacity", type=int, default=10_000, help="steps in either buffer (default 10,000)")
    parser.add_argument("--rounds", type=int, default=7, help="alternating rounds (default 7)")
    parser.add_argument("--seconds", type=float, default=0.2, help="CPU time per round and buffer (default 0.2)")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    if PeerBuffer is None:
        raise SystemExit('Stable-Baselines3 is needed beside ours; run: pip install "neuralq[bench]"')
    torch.set_num_threads(1)
    print(f"{'observation':<15} {'operation':<16} {'ours [us]':>11} {'SB3 [us]':>10} {'ratio':>7}")
    results = {}
    for setting in SETTINGS:
        results[setting.name] = measure(setting, options.capacity, options.rounds, options.seconds)
        for name, x in results[setting.name].items():
            print(f"{setting.name:<15} {name:<16} {x['ours_us']:>11.2f} {x['sb3_us']:>10.2f} {x['ratio']:>6.1f}x")
    if options.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
