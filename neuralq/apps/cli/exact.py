"""``neuralq solve``: the exact answer of an environment that has a model."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.option_values import ENV_KWARGS, reader
from neuralq.apps.pages.grids import short
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import ARROWS, drawing_lines
from neuralq.exact import METHODS, Solution, count_optimal_policies
from neuralq.exact import solve as solve_mdp
from neuralq.mdp import FiniteMDP
from neuralq.mdp.grid import GridPlan, grid_plan
from neuralq.runs.recipe.games import make_single, refusals_name
from neuralq.runs.report.claims import Arrow, ChapterPage, GridDrawing, Square

__all__ = ["solve"]

_MOST_ROWS = 64


def solve(argv: list[str]) -> int:
    """Solve the model of an environment and print values, policy and the guaranteed bound."""
    options = _parser().parse_args(argv)
    mdp, layout, limit = _model(options.env, options.env_kwargs, check=not options.no_check)
    solution = solve_mdp(mdp, options.gamma, options.method, options.tol, max_iterations=options.max_iterations)
    grid, lines = None, _table(mdp, solution)
    if layout is not None:
        grid = _drawn(layout, mdp, solution)
        lines = [*drawing_lines(grid), _legend(layout)]
    if options.svg is not None:
        if grid is None:
            raise Failure(f"{options.env} names no rows and columns, so there is no grid to draw; leave out --svg")
        page = ChapterPage("solve", f"{options.env}, γ = {options.gamma:g}", "", (), (), (grid,))
        Path(options.svg).write_text(page_svg(page), encoding="utf-8")
    known = solution.separated
    actions = [np.flatnonzero(row).tolist() if known[s] else None for s, row in enumerate(solution.optimal_actions)]
    plain = {
        "env": options.env,
        "gamma": options.gamma,
        "method": solution.method,
        "num_states": mdp.num_states,
        "max_episode_steps": limit,
        "v": solution.v.tolist(),
        "policy": solution.policy.tolist(),
        "optimal_actions": actions,
        "iterations": solution.iterations,
        "backups": solution.backups,
        "residual": _finite(solution.residual),
        "bound": _finite(solution.bound),
        "converged": solution.converged,
        "seconds": solution.seconds,
    }
    cut = [] if limit is None else [f"episodes are cut after {limit:,} steps; these are the values without the cut"]
    print_result(plain, options.json, [*lines, *_summary(solution), *cut])
    if not solution.converged:
        raise Failure(f"did not converge: the error may be as large as {solution.bound:.3g}; allow a larger --tol")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "solve",
        "Compute V* and every optimal action of an environment with a transition table.",
        "neuralq solve FrozenLake-v1",
        "neuralq solve neuralq/MitchellGrid-v0 --gamma 0.9",
    )
    parser.usage = "neuralq solve [options] ENV"
    parser.add_argument(
        "env", metavar="ENV", help="Gymnasium id of an environment with a transition table P, or one of neuralq's"
    )
    parser.add_argument("--gamma", type=float, default=0.99, help="discount (default: 0.99)")
    parser.add_argument("--method", default="auto", choices=METHODS, help="how to solve it (default: auto)")
    parser.add_argument(
        "--tol",
        type=float,
        help="guaranteed largest error of V, times the largest |V| where rounding allows no less (default: 1e-8, or a "
        "millionth of the largest |reward| where that is less)",
    )
    parser.add_argument(
        "--max-iterations", type=int, metavar="N", help="stop after so many (default: when it is solved)"
    )
    parser.add_argument("--env-kwargs", type=reader(dict), default={}, metavar="MAPPING", help=ENV_KWARGS)
    parser.add_argument(
        "--no-check",
        action="store_true",
        help="take the table as it stands; else a few thousand steps of the environment are compared with it first",
    )
    parser.add_argument("--svg", metavar="FILE", help="also draw the grid to this SVG file")
    return parser


def _finite(value: float) -> float | None:
    """JSON knows no infinity: a bound that is not known is null."""
    return value if np.isfinite(value) else None


def _model(env_id: str, kwargs: dict[str, Any], *, check: bool) -> tuple[FiniteMDP, GridPlan | None, int | None]:
    with refusals_name(env_id):
        env = make_single(env_id, kwargs)
    try:
        mdp = FiniteMDP.from_gymnasium(env, check=check)
        return mdp, grid_plan(env.unwrapped, mdp), None if env.spec is None else env.spec.max_episode_steps
    finally:
        env.close()


def _drawn(plan: GridPlan, mdp: FiniteMDP, solution: Solution) -> GridDrawing:
    """V* with an arrow for every optimal move."""
    largest = float(np.abs(solution.v).max())
    cells = []
    for s in range(mdp.num_states):
        if plan.signs[s] != " ":
            cells.append(Square(plan.signs[s]))
        elif mdp.is_terminal[s]:
            cells.append(Square(wall=True) if plan.walls[s] else Square("end"))
        else:
            known = np.flatnonzero(solution.optimal_actions[s]) if solution.separated[s] else ()
            best = sorted(plan.directions[a] for a in known)
            v = float(solution.v[s])
            cells.append(Square(short(v) if largest >= 0.1 else f"{v:.3g}", tuple(map(Arrow, best))))
    return GridDrawing("V* and every optimal move", plan.num_columns, tuple(cells))


def _legend(layout: GridPlan) -> str:
    return ", ".join(f"{ARROWS[d]} is action {a}" for a, d in enumerate(layout.directions))


def _table(mdp: FiniteMDP, solution: Solution) -> list[str]:
    names, known = mdp.state_names or [""] * mdp.num_states, solution.separated
    largest = float(np.abs(solution.v).max())
    shown = "8.4f" if largest == 0 or 0.1 <= largest < 1e6 else "8.4g"  # V is as small or large as rewards are
    lines = ["state        V*  optimal actions"]
    for s in range(min(len(solution.v), _MOST_ROWS)):
        chosen = np.flatnonzero(solution.optimal_actions[s])
        actions = (
            " ".join(str(a) if mdp.action_names is None else mdp.action_names[int(a)] for a in chosen) or "terminal"
        )
        actions = actions if known[s] else "not known"
        lines.append(f"{s:5d}  {solution.v[s]:{shown}}  {actions}{f'  ({names[s]})' if names[s] else ''}")
    if len(solution.v) > _MOST_ROWS:
        lines.append(f"… and {len(solution.v) - _MOST_ROWS} more states (--json has them all)")
    return lines


def _summary(solution: Solution) -> list[str]:
    if solution.separated.all():
        count = count_optimal_policies(solution)
        policies = f"{count:,}" if count < 1e9 else f"about 10^{len(str(count)) - 1}"
    else:
        policies = f"not known: the bound separates no actions in {np.count_nonzero(~solution.separated):,} states"
    return [
        f"deterministic optimal policies: {policies}",
        f"{solution.method}: {solution.iterations} iterations, {solution.seconds:.3f} s, "
        f"guaranteed largest error {solution.bound:.2g}",
    ]
