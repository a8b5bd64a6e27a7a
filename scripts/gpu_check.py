"""Everything that a machine with an accelerator has to show, in one go of under eight minutes; results as JSON.

    python scripts/gpu_check.py --out gpu.json             on an accelerator
    python scripts/gpu_check.py --device cpu --small       the same, tiny, where there is none

Five parts, each of which says what it found, or why it could not look (``--parts`` chooses):

    tests       the tests marked ``gpu``
    learners    a short run of every learner in every layout on the device, beside the same on the CPU: the largest
                difference of a parameter, relative to the largest parameter (at most 1e-3 counts as equal)
    resume      a run that goes on from the device to the CPU and back, beside one that stayed on the CPU
    rates       environment steps per second of rollouts at 128, 1,024 and 8,192 environments, beside the same work in
                plain PyTorch on the same device and environments
    graphs      an update of a captured graph (`torch.cuda.CUDAGraph`), and compiled with ``reduce-overhead``, beside
                the eager one, for the rollout's minibatches

The exit status is 1 if a test failed or a difference was too large. A part that would begin after ``--seconds`` is
left out and says so. On a CPU the device's engine is torch and the other one whatever neuralq takes by itself.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

import neuralq
from neuralq.runs.recipe.build import build_session
from neuralq.runs.stop_request import StopRequest

ROOT = Path(__file__).parents[1]
TOLERANCE = 1e-3
LEARNERS = ("rollout", "replay", "online", "streaming", "gradient")
LAYOUTS = ("action-output", "action-input", "separate")
NUM_STEPS, NUM_EPOCHS, NUM_MINIBATCHES, LAMBDA, GAMMA, RATE = 32, 2, 16, 0.65, 0.99, 2.5e-4


def synchronise(device: str) -> None:
    """Waits until the device has done what it was asked to: it works behind Python's back."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def seconds_of(work: Callable[[], object], device: str, repeats: int) -> float:
    """Seconds of one call, the median of some, after one that is not counted."""
    taken = []
    for _ in range(repeats + 1):
        synchronise(device)
        start = time.perf_counter()
        work()
        synchronise(device)
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:]))


def run_tests(options: argparse.Namespace) -> dict[str, Any]:
    """The tests marked ``gpu``, by pytest."""
    if not options.device.startswith("cuda"):
        return {"left_out": "they need an accelerator"}
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider", str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    last = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr.strip()[-300:]
    counts = {what: int(number) for number, what in re.findall(r"(\d+) (passed|failed|skipped|error)", last)}
    return {**counts, "said": last, "ok": done.returncode == 0}


def settings_of(learner: str, layout: str, num_steps: int) -> dict[str, Any]:
    """A short run on CartPole, whose updates are few enough that rounding has not grown."""
    own: dict[str, Any] = {
        "rollout": {"num_envs": 4, "num_steps": 16, "num_epochs": 2, "num_minibatches": 2},
        "replay": {
            "learning_starts": 32,
            "batch_size": 16,
            "train_period": 4,
            "capacity": 1000,
            "target_period_updates": 8,
        },
    }.get(learner, {})
    return {
        "env": "CartPole-v1", "learner": learner, "layout": layout, "total_steps": num_steps, "hidden": (16, 16),
        "evaluation_episodes": 1, "evaluate_every": 10**6, "checkpoint_every": 10**6, "resume_probe": False,
        "epsilon_decay_steps": 64, **own,
    }  # fmt: skip


def parameters_of(run: neuralq.Run) -> Tensor:
    """All parameters of a run's last agent in one vector, on the CPU."""
    module = neuralq.load(run, best=False).q
    return torch.cat([parameter.detach().cpu().flatten() for parameter in module.parameters()])


def difference(here: Tensor, there: Tensor) -> float:
    """The largest difference of a parameter, relative to the largest parameter."""
    return float((here - there).abs().max() / there.abs().max())


def trained(folder: Path, name: str, **settings: Any) -> neuralq.Run:
    return neuralq.train(run_dir=folder / name, preset=False, **settings)


def run_learners(options: argparse.Namespace) -> dict[str, Any]:
    """Every learner and layout on the device, beside the CPU."""
    found: dict[str, Any] = {}
    layouts = LAYOUTS[:1] if options.small else LAYOUTS
    on_cpu = options.device == "cpu"
    with tempfile.TemporaryDirectory() as name:
        for learner in LEARNERS:
            for layout in layouts:
                settings = settings_of(learner, layout, 128 if options.small else 512)
                here = trained(Path(name), f"{learner}-{layout}-d", **settings, device=options.device, engine="torch")
                engine = "auto" if on_cpu else "torch"
                there = trained(Path(name), f"{learner}-{layout}-c", **settings, engine=engine)
                found[f"{learner}, {layout}"] = difference(parameters_of(here), parameters_of(there))
    return {"difference": found, "ok": max(found.values()) <= TOLERANCE}


def run_resume(options: argparse.Namespace) -> dict[str, Any]:
    """A run that goes on from the device to the CPU and back."""
    found = {}
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # each move says that what computes is not the same
        for learner in ("rollout", "replay"):
            settings = settings_of(learner, "action-output", 128) | {"engine": "torch"}
            moved = trained(Path(name), f"{learner}-moved", **settings, device=options.device)
            neuralq.resume(moved, 256, device="cpu")
            moved = neuralq.resume(moved, 384, device=options.device)
            stayed = trained(Path(name), f"{learner}-stayed", **{**settings, "total_steps": 128})
            neuralq.resume(stayed, 256)
            stayed = neuralq.resume(stayed, 384)
            found[learner] = difference(parameters_of(moved), parameters_of(stayed))
    return {"difference": found, "ok": max(found.values()) <= TOLERANCE}


class Plain:
    """The same work in plain PyTorch: ε-greedy rollouts, λ-returns, minibatches, RAdam; nothing of neuralq's.

    Source: Gallici et al. (2024), "Simplifying deep temporal difference learning", Algorithm 1.
    """

    def __init__(self, env: str, num_envs: int, device: str) -> None:
        makers = [lambda: gymnasium.make(env) for _ in range(num_envs)]
        self.envs = gymnasium.vector.SyncVectorEnv(makers)
        self.device, self.num_envs = torch.device(device), num_envs
        shape = self.envs.single_observation_space.shape or ()
        self.num_actions = int(self.envs.single_action_space.n)  # type: ignore[attr-defined]
        self.net = network(shape, self.num_actions).to(self.device)
        self.optimiser = torch.optim.RAdam(self.net.parameters(), RATE)
        self.rng = np.random.default_rng(0)
        self.observation = self.envs.reset(seed=0)[0]

    def on_device(self, values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def rollout(self) -> None:
        """A rollout and what is learned from it."""
        seen, taken, rewards, lasts = [], [], [], []
        for _ in range(NUM_STEPS):
            with torch.no_grad():
                greedy = self.net(self.on_device(self.observation)).argmax(-1).cpu().numpy()
            random = self.rng.random(self.num_envs) < 0.1
            action = np.where(random, self.rng.integers(self.num_actions, size=self.num_envs), greedy)
            seen.append(self.observation.copy())
            self.observation, reward, terminated, truncated, _ = self.envs.step(action)
            taken.append(action)
            rewards.append(reward)
            lasts.append(terminated | truncated)
        s, a = self.on_device(np.stack(seen)), torch.as_tensor(np.stack(taken), device=self.device)
        r, last = self.on_device(np.stack(rewards)), self.on_device(np.stack(lasts))
        with torch.no_grad():
            v = self.net(torch.cat([s[1:], self.on_device(self.observation)[None]]).flatten(0, 1)).amax(-1)
            v = v.view(NUM_STEPS, self.num_envs)
            target, targets = v[-1], []
            for t in reversed(range(NUM_STEPS)):
                target = r[t] + GAMMA * (1 - last[t]) * ((1 - LAMBDA) * v[t] + LAMBDA * target)
                targets.append(target)
        y, s, a = torch.stack(targets[::-1]).flatten(), s.flatten(0, 1), a.flatten()
        for _ in range(NUM_EPOCHS):
            for rows in torch.randperm(len(y), device=self.device).chunk(NUM_MINIBATCHES):
                self.optimiser.zero_grad()
                step_of(self.net, s[rows], a[rows], y[rows])
                torch.nn.utils.clip_grad_norm_(self.net.parameters(), 10.0)
                self.optimiser.step()


def network(shape: tuple[int, ...], num_actions: int) -> nn.Module:
    """A layer-normalised perceptron, behind a small convolution where there are channels."""
    if len(shape) == 3:  # MinAtar's: height, width, channels
        features = 16 * (shape[0] - 2) * (shape[1] - 2)
        front = ChannelsFirst(), nn.Conv2d(shape[2], 16, 3), nn.ReLU(), nn.Flatten()
        return nn.Sequential(
            *front, nn.Linear(features, 128), nn.LayerNorm(128), nn.ReLU(), nn.Linear(128, num_actions)
        )
    first = nn.Linear(int(np.prod(shape)), 120), nn.LayerNorm(120), nn.ReLU()
    return nn.Sequential(*first, nn.Linear(120, 84), nn.LayerNorm(84), nn.ReLU(), nn.Linear(84, num_actions))


class ChannelsFirst(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        """``[N, H, W, C]`` to ``[N, C, H, W]``."""
        return x.movedim(-1, 1)


def step_of(net: nn.Module, s: Tensor, a: Tensor, y: Tensor) -> None:
    """The gradient of the mean squared error, into the parameters."""
    (net(s).gather(1, a[:, None])[:, 0] - y).square().mean().backward()


def rollout_seconds(config: neuralq.RunConfig, size: int) -> float:
    """Seconds of one of our rollouts, with what is learned from it."""
    session, request = build_session(config), StopRequest()
    try:
        return seconds_of(lambda: session.advance(session.env_steps + size, request), config.device, 3)
    finally:
        session.close()


def plain_seconds(env: str, num_envs: int, device: str) -> float:
    """The same of plain PyTorch's."""
    plain = Plain(env, num_envs, device)
    try:
        return seconds_of(plain.rollout, device, 3)
    finally:
        plain.envs.close()


def run_rates(options: argparse.Namespace) -> dict[str, Any]:
    """Environment steps per second of rollouts, ours and plain PyTorch's, in turns."""
    found: dict[str, Any] = {}
    envs: dict[str, dict[str, Any]] = {"CartPole-v1": {"hidden": (120, 84), "layer_norm": True}}
    if importlib.util.find_spec("minatar") is not None:
        envs["MinAtar/Breakout-v1"] = {"body": "minatar"}
    for env, body in envs.items():
        for num_envs in (8,) if options.small else (128, 1024, 8192):
            if time.monotonic() > options.until:
                found[f"{env}, {num_envs}"] = {"left_out": "no time was left"}
                continue
            size = num_envs * NUM_STEPS
            config = neuralq.with_preset(
                {"env": env}, num_envs=num_envs, num_steps=NUM_STEPS, num_epochs=NUM_EPOCHS, lambda_=LAMBDA,
                num_minibatches=NUM_MINIBATCHES, total_steps=100 * size, evaluate_every=10**9, log_every=10**9,
                checkpoint_every=10**9, device=options.device, resume_probe=False, exact=False, **body,
            )  # fmt: skip
            ours, theirs = rollout_seconds(config, size), plain_seconds(env, num_envs, options.device)
            found[f"{env}, {num_envs}"] = {"ours": size / ours, "plain": size / theirs, "ratio": theirs / ours}
    return {"steps_per_second": found, "ok": True}


def run_graphs(options: argparse.Namespace) -> dict[str, Any]:
    """An update by a captured graph and compiled, beside the eager one."""
    if not options.device.startswith("cuda"):
        return {"left_out": "graphs are captured on an accelerator"}
    found: dict[str, Any] = {}
    for rows in (128, 4096):
        net = network((4,), 2).to(options.device)
        optimiser = torch.optim.RAdam(net.parameters(), RATE, capturable=True)
        s, y = torch.randn(rows, 4, device=options.device), torch.randn(rows, device=options.device)
        a = torch.randint(2, (rows,), device=options.device)

        def eager(net: nn.Module = net, optimiser: Any = optimiser, batch: Any = (s, a, y)) -> None:
            optimiser.zero_grad(set_to_none=False)
            step_of(net, *batch)
            optimiser.step()

        plain = seconds_of(eager, options.device, 50)
        side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        with torch.cuda.stream(side):
            for _ in range(3):
                eager()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            eager()
        captured = seconds_of(graph.replay, options.device, 50)
        compiled: float | None = None
        try:
            compiled = seconds_of(torch.compile(eager, mode="reduce-overhead"), options.device, 50)
        except Exception as error:  # a compiler of the system's may be missing
            found[f"{rows} rows, not compiled"] = str(error).splitlines()[0]
        found[f"{rows} rows"] = {
            "eager_us": 1e6 * plain, "graph_ratio": plain / captured,
            "compiled_ratio": None if compiled is None else plain / compiled,
        }  # fmt: skip
    return {"update": found, "ok": True}


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "tests": run_tests,
    "learners": run_learners,
    "resume": run_resume,
    "rates": run_rates,
    "graphs": run_graphs,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="where to compute (default: cuda)")
    parser.add_argument("--small", action="store_true", help="as little as shows that every part runs")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"some of {','.join(PARTS)}")
    parser.add_argument("--seconds", type=float, default=420.0, help="after which no part begins (default: 420)")
    parser.add_argument("--out", metavar="FILE", help="also write the results there")
    options = parser.parse_args()
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        raise SystemExit("torch finds no accelerator here; the small form runs anywhere: --device cpu --small")
    if unknown := set(options.parts.split(",")) - PARTS.keys():
        raise SystemExit(f"there are the parts {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("highest")
    os.environ.setdefault("PYTHONWARNINGS", "ignore")
    began = time.monotonic()
    options.until = began + options.seconds
    name = torch.cuda.get_device_name(options.device) if options.device != "cpu" else "cpu"
    results: dict[str, Any] = {"device": name, "torch": torch.__version__, "neuralq": neuralq.__version__}
    for part in options.parts.split(","):
        start = time.monotonic()
        late = {"left_out": "no time was left"}
        results[part] = late if start > options.until else PARTS[part](options)
        results[part]["seconds"] = round(time.monotonic() - start, 1)
        print(f"{part}: {json.dumps(results[part])}", flush=True)
    results["ok"] = all(results[part].get("ok", True) for part in options.parts.split(","))
    text = json.dumps(results)
    if options.out is not None:
        Path(options.out).write_text(text + "\n")
    print(text)
    raise SystemExit(0 if results["ok"] else 1)


if __name__ == "__main__":
    main()
