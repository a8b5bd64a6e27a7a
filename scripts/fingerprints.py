"""Fingerprints of what neuralq computes: a change of the code that should change no number changes none of these.

    python scripts/fingerprints.py --write before.json      # on the code as it was
    python scripts/fingerprints.py --compare before.json    # on the code as it is

Short runs of every learner on every engine and layout, of every target rule and distribution of replay, and of
TD-Gammon, by the SHA-256 of their parameters; exact answers, tables and results of the lab by the SHA-256 of their
arrays. The bits belong to one machine and one set of package versions, so the file is made where it is compared.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import neuralq
from neuralq.runs.recipe.config import config_from_dict

Case = tuple[str, Callable[[], str]]
LAYOUTS = ("table", "linear", "action-input", "separate", "action-output")
ENGINES = ("auto", "torch")
LEARNERS: dict[str, dict[str, Any]] = {
    "rollout": {"num_envs": 4, "num_steps": 16},
    "replay": {"learning_starts": 64, "batch_size": 16, "target_period_updates": 20},
    "online": {"step_size": 1e-3},
    "streaming": {},
    "gradient": {},
}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "rollout watkins": ("rollout", {"returns": "watkins"}),
    "replay double": ("replay", {"target_rule": "double"}),
    "replay munchausen": ("replay", {"target_rule": "munchausen"}),
    "replay dqrc": ("replay", {"target_rule": "dqrc", "target_period_updates": None}),
    "replay prioritised": ("replay", {"prioritised": True, "num_steps": 3}),
    "replay quantile": ("replay", {"distribution": "quantile", "num_atoms": 8}),
    "replay quantile double": ("replay", {"distribution": "quantile", "num_atoms": 8, "target_rule": "double"}),
    "replay quantile munchausen": ("replay", {"distribution": "quantile", "num_atoms": 8, "target_rule": "munchausen"}),
    "replay categorical": ("replay", {"distribution": "categorical", "value_min": 0.0, "value_max": 100.0}),
    **{
        f"replay {rule}": ("replay", {"target_rule": rule, "block_length": 8, "batch_size": 32})
        for rule in ("peng", "watkins", "retrace", "tree_backup", "harutyunyan")
    },
    "online replacing": ("online", {"trace": "replacing"}),
    "online naive": ("online", {"cut": "naive"}),
    "streaming adaptive": ("streaming", {"bound": "adaptive-obgd"}),
    "streaming intentional": ("streaming", {"bound": "intentional"}),
    "streaming published": ("streaming", {"cut": "published"}),
    "gradient gq": ("gradient", {"method": "gq", "step_size": 1e-5, "target_epsilon": 0.1}),
}


def configured(config: dict[str, Any]) -> neuralq.RunConfig:
    """Over the preset, but for replay, whose preset is younger than the first table of fingerprints."""
    return config_from_dict(config) if config.get("learner") == "replay" else neuralq.with_preset(config)


def trained(config: dict[str, Any], folder: Path) -> str:
    run = neuralq.train(configured(config), folder)
    return run.parameters_sha256


def run_cases() -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and configuration of every short run."""
    for learner, settings in LEARNERS.items():
        for layout in LAYOUTS:
            for engine in ENGINES:
                yield f"{learner} {layout} {engine}", short(learner, layout, engine, settings)
    for name, (learner, settings) in VARIANTS.items():
        for layout in ("table", "action-output"):
            yield f"{name} {layout}", short(learner, layout, "auto", {**LEARNERS[learner], **settings})
    yield "replay dueling", {**short("replay", "action-output", "auto", LEARNERS["replay"]), "dueling": True}
    yield "online dutch linear", short("online", "linear", "auto", {"trace": "dutch", "step_size": 1e-3})
    yield "preset CartPole-v1", {"env": "CartPole-v1", "total_steps": 6000, "evaluation_episodes": 2}


def short(learner: str, layout: str, engine: str, settings: dict[str, Any]) -> dict[str, Any]:
    config: dict[str, Any] = {
        "env": "FrozenLake-v1" if layout == "table" else "CartPole-v1", "learner": learner, "layout": layout,
        "engine": engine, "seed": 11, "total_steps": 600, "evaluate_every": 300, "evaluation_episodes": 2,
        "epsilon_end": 0.2, "epsilon_decay_steps": 400, learner: settings,
    }  # fmt: skip
    if layout not in ("table", "linear"):
        config["body"] = {"class": "MLP", "hidden": [16, 16]}
    return config


def resumed(config: dict[str, Any], folder: Path) -> str:
    """Half of the run, then the rest of it."""
    neuralq.train(configured({**config, "total_steps": 300}), folder)
    return str(neuralq.resume(folder, total_steps=600).parameters_sha256)


def backgammon(mode: str) -> str:
    from neuralq.backgammon import SelfPlaySettings, TdGammonConfig, train_games

    settings = SelfPlaySettings(num_games=60, num_hidden=20, mode=mode)
    config = TdGammonConfig(settings, evaluate_against=(), seed=3)
    with tempfile.TemporaryDirectory() as folder:
        return train_games(config, Path(folder) / "run").weights_sha256


def digest(*values: Any) -> str:
    """SHA-256 of arrays, numbers and texts, nested or not."""
    sha = hashlib.sha256()

    def take(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value):
                sha.update(str(key).encode())
                take(value[key])
        elif isinstance(value, list | tuple):
            for one in value:
                take(one)
        elif isinstance(value, str) or value is None:
            sha.update(repr(value).encode())
        else:
            sha.update(np.ascontiguousarray(value).tobytes())

    take(list(values))
    return sha.hexdigest()


def exact_cases() -> Iterator[Case]:
    """Exact answers, each method on a Garnet of its own."""
    from neuralq.exact import METHODS, evaluate, evaluate_average, resolvent, solve, solve_average, solve_finite_horizon

    model = neuralq.FiniteMDP.garnet(40, 3, 4, seed=5)
    policy = np.full((40, 3), 1 / 3)

    def solved(method: str) -> Any:
        return solve(model, 0.9, method=method).v

    for method in METHODS:
        yield f"exact {method}", partial(said_of, partial(solved, method))
    yield "exact horizon", lambda: digest(solve_finite_horizon(model, 12, 0.9).v)
    yield "exact average", lambda: digest(solve_average(model).gain, evaluate_average(model, policy).gain)
    yield "exact evaluation", lambda: digest(evaluate(model, policy, 0.9))
    yield "exact resolvent", lambda: digest(resolvent(np.full((3, 3), 1 / 3), np.eye(3), 0.9))


def lab_cases() -> Iterator[Case]:
    """Verdicts, critical values, remedies and measured runs of the lab."""
    from neuralq import lab

    def explained(problem: str, method: str) -> str:
        return lab.diagnose(lab.problem(problem), method).explain()

    def measured(method: str, sampling: Any) -> Any:
        run = lab.run(lab.problem("baird"), method, 200, 0.005, sampling=sampling, num_seeds=3, seed=2)
        return run.rmsve, run.weights

    for name in ("baird", "w2w", "boyan", "garnet"):
        yield f"lab explain {name}", partial(said_of, partial(explained, name, "td"))
    for method in [one.name for one in lab.METHODS]:
        yield f"lab diagnose baird {method}", partial(said_of, partial(explained, "baird", method))
        for sampling in ("expected", "markov"):
            yield f"lab run baird {method} {sampling}", partial(said_of, partial(measured, method, sampling))
    star = lab.problem("baird")
    yield "lab critical", lambda: digest(lab.critical(star, "gamma"), lab.critical(star, "lambda_"))
    yield "lab remedies", lambda: digest([one.explain() for one in lab.prescribe(star)])


def tabular_cases() -> Iterator[Case]:
    """Every kind of tabular learner on one model."""
    from neuralq import tabular

    model = neuralq.FiniteMDP.garnet(30, 3, 3, seed=7)

    def learned(name: str) -> Any:
        discount = {} if name == "r_learning" else {"gamma": 0.9}
        return getattr(tabular, name)(model, 2000, **discount, seed=1).q

    for name in (
        "q_learning", "sarsa", "expected_sarsa", "double_q", "q_lambda", "sarsa_lambda", "n_step", "dyna_q",
        "prioritized_sweeping", "queue_dyna", "episodic_q_learning", "r_learning",
    ):  # fmt: skip
        yield f"tabular {name}", partial(said_of, partial(learned, name))


def outcome(compute: Callable[[], str]) -> str:
    """What is computed, or that it is refused."""
    try:
        return compute()
    except ValueError:
        return "refused"


def said_of(compute: Callable[[], Any]) -> str:
    """The digest of a result, or that there is none."""
    return outcome(lambda: digest(compute()))


def cases(folder: Path) -> Iterator[Case]:
    for name, config in run_cases():
        yield f"run {name}", partial(outcome, partial(trained, config, folder / name))
        if name.endswith("action-output auto"):
            yield f"resumed {name}", partial(resumed, config, folder / f"resumed {name}")
    for mode in ("online", "batched"):
        yield f"td-gammon {mode}", partial(backgammon, mode)
    yield from exact_cases()
    yield from tabular_cases()
    yield from lab_cases()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", metavar="FILE", help="where to write the fingerprints")
    parser.add_argument("--compare", metavar="FILE", help="fingerprints to compare with")
    parser.add_argument("--only", metavar="TEXT", default="", help="cases whose name holds this")
    options = parser.parse_args()
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, compute in cases(Path(folder)):
            if options.only in name:
                found[name] = compute()
                print(f"{found[name][:16]}  {name}", flush=True)
    if options.write:
        Path(options.write).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if not options.compare:
        return 0
    before = json.loads(Path(options.compare).read_text(encoding="utf-8"))
    changed = sorted(name for name in found if name in before and before[name] != found[name])
    unknown = sorted(set(found) ^ set(before)) if not options.only else []
    print(f"{len(found) - len(changed) - len(set(found) - set(before))} equal, {len(changed)} changed")
    print(*(f"changed: {name}" for name in changed), *(f"on one side only: {name}" for name in unknown), sep="\n")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
