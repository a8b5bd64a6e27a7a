"""``neuralq solve``: the exact answer of an environment that has a model."""

from __future__ import annotations

import argparse
import json
from typing import Any

import gymnasium as gym
import numpy as np

from neuralq.cli import Failure, print_result
from neuralq.exact import Solution
from neuralq.exact import solve as solve_mdp
from neuralq.mdp import FiniteMDP

__all__ = ["solve"]

_MOST_ROWS = 64


def solve(argv: list[str]) -> int:
    """Solve the model of an environment and print values, policy and the guaranteed bound."""
    parser = argparse.ArgumentParser(
        prog="neuralq solve",
        description="Compute V* and every optimal action of an environment with a transition table.",
        epilog="examples:\n  neuralq solve FrozenLake-v1\n  neuralq solve neuralq/MitchellGrid-v0 --gamma 0.9",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("env", help="Gymnasium id of an environment with a transition table P, or one of neuralq's")
    parser.add_argument("--gamma", type=float, default=0.99, help="discount (default: 0.99)")
    parser.add_argument("--method", default="value-iteration", choices=("value-iteration", "policy-iteration"))
    parser.add_argument("--tol", type=float, default=1e-8, help="guaranteed largest error of V (default: 1e-8)")
    parser.add_argument("--env-kwargs", type=_json_object, default={}, help="JSON object passed to gymnasium.make")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    options = parser.parse_args(argv)
    mdp = _model(options.env, options.env_kwargs)
    solution = solve_mdp(mdp, options.gamma, method=options.method, tol=options.tol)
    plain = {
        "env": options.env,
        "gamma": options.gamma,
        "method": options.method,
        "v": solution.v.tolist(),
        "policy": solution.policy.tolist(),
        "iterations": solution.iterations,
        "bound": solution.bound,
        "converged": solution.converged,
        "seconds": solution.seconds,
    }
    print_result(plain, options.json, _lines(solution))
    if not solution.converged:
        raise Failure(f"did not converge: the error may be as large as {solution.bound:.3g}; allow a larger --tol")
    return 0


def _json_object(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"must be a JSON object such as '{{\"is_slippery\": false}}', got {text!r}")
    return value


def _model(env_id: str, kwargs: dict[str, Any]) -> FiniteMDP:
    try:
        env = gym.make(env_id, **kwargs)
    except Exception as error:  # the environment's own code ran
        raise ValueError(f"cannot make the environment {env_id!r}: {type(error).__name__}: {error}") from error
    try:
        own = getattr(env.unwrapped, "mdp", None)
        return own() if callable(own) else FiniteMDP.from_gymnasium(env)
    finally:
        env.close()


def _lines(solution: Solution) -> list[str]:
    lines = ["state        V*  optimal actions"]
    for s in range(min(len(solution.v), _MOST_ROWS)):
        actions = " ".join(map(str, np.flatnonzero(solution.optimal_actions[s]))) or "terminal"
        lines.append(f"{s:5d}  {solution.v[s]:8.4f}  {actions}")
    if len(solution.v) > _MOST_ROWS:
        lines.append(f"… and {len(solution.v) - _MOST_ROWS} more states (--json has them all)")
    lines.append(
        f"{solution.iterations} iterations, {solution.seconds:.3f} s, guaranteed largest error {solution.bound:.2g}"
    )
    return lines
