"""``neuralq lab fitted``: what fitted value iteration makes of benign problems, by the function that is fitted."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from neuralq.apps.cli import Failure, command_parser
from neuralq.apps.cli.fitted_choices import REGRESSORS, WORLDS, FittedChoice
from neuralq.apps.cli.lab import Parser, show
from neuralq.checks import check_discount, check_positive, check_whole
from neuralq.exact import solve
from neuralq.lab.fitted.diagnosis import FittedDiagnosis, diagnose_fitted
from neuralq.lab.fitted.grow_support import GrownSupport, greedy_costs, grow_support
from neuralq.lab.fitted.regressors import Regressor
from neuralq.types import Floats
from neuralq_envs.counterexamples.continuous import ContinuousModel, grid_support, random_support, reachable_mdp

__all__ = ["fitted"]

_COLOURS = {
    "converges": "green",
    "diverges": "red",
    "drifts": "yellow",
    "chatters": "yellow",
    "unstable": "magenta",
    "undecided": "cyan",
}
_SUPPORTS = {"grid": "grid points", "no-goal": "grid points without goal", "random": "random points"}
_STARTS = ("zero", "tilted", "exact")
_TILT = 1e-3  # of the first coordinate against the last, which breaks every symmetry between them
_MOST_REACHABLE = 20_000  # states of a finite model that is worth solving for a reference
_RUN = 1000  # sweeps by default
_SHORT_RUN = 100  # with a network, which is trained anew in each


@dataclass(frozen=True)
class _Setting:
    """A world with its support, its start and, where known, its exact costs there."""

    model: ContinuousModel
    support: Floats
    start: Floats | None
    exact: Floats | None


@dataclass(frozen=True)
class _Case:
    """What was found of one regressor on one world."""

    world: str
    regressor: str
    found: FittedDiagnosis


def fitted(argv: list[str]) -> int:
    """Judge fitted value iteration and run it: one world under one regressor, or a table of them."""
    parser = _parser()
    options = parser.parse_args(argv)
    chosen = [one for one in REGRESSORS if one.name in (options.regressor or [])]
    single = options.world is not None and len(chosen) <= 1
    if options.grow_support and not single:
        parser.error("--grow-support needs a WORLD and one regressor, as in: fitted gridworld --grow-support")
    chosen = chosen or ([REGRESSORS[0]] if single else [one for one in REGRESSORS if one.name != "network"])
    _check(options, chosen)
    worlds = [make() for make in WORLDS] if options.world is None else [_world(options.world)]
    with Console(file=sys.stderr).status("exact costs, where known") as status:
        settings = [_setting(one, options) for one in worlds]
        cases: list[_Case] = []
        for setting in settings:
            for one in chosen:
                place = f"{len(cases) + 1} of {len(worlds) * len(chosen)}"
                status.update(f"{one.name} on {setting.model.name} ({place})")
                cases.append(_case(setting, one, options))
        grown = _grown(settings[0], chosen[0], options, status.update) if options.grow_support else None
    if not single:
        show(options.json, {"cases": [_plain(case) for case in cases]}, *_tables(cases, options))
        return 0
    plain = {**_plain(cases[0]), "grown": None if grown is None else grown[0]}
    show(options.json, plain, *_single(cases[0], options), *([] if grown is None else grown[1]))
    return 0


def _parser() -> Parser:
    parser = command_parser(
        "lab fitted",
        "Fitted value iteration: back up a support of states, fit a function through the answers, and again. The\n"
        "verdict (is the fit an averager? how much can it exaggerate? how do errors grow?), then the run. Without a\n"
        "WORLD: every world under every regressor but the network.",
        "neuralq lab fitted",
        "neuralq lab fitted gridworld",
        "neuralq lab fitted gridworld --start tilted",
        "neuralq lab fitted gridworld --grow-support",
        "neuralq lab fitted puddle-world --regressor nearest --neighbours 4 --gamma 0.95",
    )
    add = parser.add_argument
    add("world", metavar="WORLD", nargs="?", help=f"one of {', '.join(make().name for make in WORLDS)}")
    add(
        "--regressor",
        action="append",
        choices=[one.name for one in REGRESSORS],
        metavar="NAME",
        help=f"one of {', '.join(one.name for one in REGRESSORS)}; may be repeated (default: quadratic)",
    )
    add("--points", type=int, default=16, metavar="N", help="points of the support per side (default: 16)")
    add("--support", default="grid", choices=tuple(_SUPPORTS), help="where they lie (default: grid, corners included)")
    add("--seed", type=int, default=0, help="of a random support (default: 0)")
    add("--gamma", type=float, default=1.0, help="discount (default: 1)")
    add("--max-iterations", type=int, metavar="N", help=f"most sweeps (default: {_RUN}; with a network {_SHORT_RUN})")
    _add_numbers(parser)
    return parser


def _add_numbers(parser: Parser) -> None:
    """The start, what regressors take, and Grow-Support."""
    add = parser.add_argument
    add(
        "--start",
        default="zero",
        choices=_STARTS,
        help="values before the first sweep: 0, tilted by a thousandth to break symmetries, or the exact costs",
    )
    add("--neighbours", type=int, metavar="K", help="of nearest (default: 1)")
    add("--boxes", type=int, metavar="N", help="of aggregation, per side (default: half the points)")
    add("--bandwidth", type=float, metavar="H", help="of kernel and lwr (default: the distance between points)")
    add("--hidden", type=int, metavar="N", help="units of the network (default: 12)")
    add("--grow-support", action="store_true", help="also grow the support from the goal by confirmed costs only")
    add(
        "--tolerance",
        type=float,
        default=0.5,
        metavar="T",
        help="what a confirming path may cost beyond the fit's promise (default: 0.5)",
    )


def _check(options: argparse.Namespace, chosen: Sequence[FittedChoice]) -> None:
    """Refuse numbers out of range, and options that nothing asked for would use."""
    check_whole("--points", options.points, 2)
    check_whole("--seed", options.seed, 0)
    check_discount("--gamma", options.gamma)
    check_positive("--tolerance", options.tolerance)
    if options.max_iterations is not None:
        check_whole("--max-iterations", options.max_iterations)
    for one in chosen:
        if options.points > one.most_points:
            raise Failure(f"--points must be at most {one.most_points} for {one.name}, got {options.points}")
    for option in ("neighbours", "boxes", "bandwidth", "hidden"):
        users = [one.name for one in REGRESSORS if one.option == option]
        if getattr(options, option) is not None and not any(one.name in users for one in chosen):
            raise Failure(f"--{option} is for --regressor {' or '.join(users)}, not for {chosen[0].name}")
    if options.grow_support and options.gamma != 1:
        raise Failure(f"--grow-support compares costs of whole paths, so --gamma must be 1, got {options.gamma:g}")
    if options.grow_support and chosen[0].name == "network":
        raise Failure("--grow-support would train the network in every step of every path; choose another regressor")


def _world(name: str) -> ContinuousModel:
    worlds = [make() for make in WORLDS]
    for one in worlds:
        if one.name == name:
            return one
    raise Failure(f"no world is called {name!r}; there are {', '.join(one.name for one in worlds)}")


def _setting(model: ContinuousModel, options: argparse.Namespace) -> _Setting:
    """Support, start and exact costs of a world."""
    if options.support == "random":
        support = random_support(model, options.points ** len(model.low), np.random.default_rng(options.seed))
    else:
        support = grid_support(model, options.points)
        if options.support == "no-goal":
            support = support[~model.is_goal(support)]
    exact = _exact(model, support, options.gamma)
    if options.start == "exact" and exact is None:
        raise Failure(
            f"the exact costs of {model.name} are not known on this support; start from zero, or choose gridworld with "
            "--gamma 1, or --points 16 or 21"
        )
    place = (support - model.low) / (model.high - model.low)
    tilted = _TILT * (place[:, 0] - place[:, -1])
    start = {"zero": None, "tilted": tilted, "exact": exact}[options.start]
    return _Setting(model, support, start, exact)


def _exact(model: ContinuousModel, support: Floats, gamma: float) -> Floats | None:
    """The exact costs at the support, in closed form or from the finite model of all that can be reached."""
    if gamma == 1 and model.cost_to_go is not None:
        return model.cost_to_go(support)
    try:
        mdp, index = reachable_mdp(model, support, max_states=_MOST_REACHABLE)
    except ValueError:  # too many: it does not close under its steps, or hardly
        return None
    costs: Floats = -solve(mdp, gamma).v[index]
    return costs


def _case(setting: _Setting, one: FittedChoice, options: argparse.Namespace) -> _Case:
    regressor = _regressor(setting, one, options)
    sweeps = options.max_iterations or (_SHORT_RUN if one.name == "network" else _RUN)
    found = diagnose_fitted(
        setting.model, setting.support, regressor, gamma=options.gamma, num_iterations=sweeps, start=setting.start,
        exact=setting.exact,
    )  # fmt: skip
    return _Case(setting.model.name, one.name, found)


def _regressor(setting: _Setting, one: FittedChoice, options: argparse.Namespace) -> Regressor:
    number = None if one.option is None else getattr(options, one.option)
    return one.regressor(setting.model, options.points, number)


def _grown(
    setting: _Setting, one: FittedChoice, options: argparse.Namespace, tell: Callable[[str], None]
) -> tuple[dict[str, Any], list[RenderableType]]:
    """Grow-Support from the same candidates: for programs and for people."""
    tell("growing the support from the goal")
    grown = grow_support(
        setting.model, setting.support, _regressor(setting, one, options), tolerance=options.tolerance
    )  # fmt: skip
    _, reached = greedy_costs(setting.model, grown.fitted, grown.costs, setting.support)
    excess = None if setting.exact is None else float((grown.costs - setting.exact[grown.index]).max())
    plain = {
        **grown.plain(), "num_candidates": len(setting.support), "max_excess": excess,
        "num_reached": int(reached.sum()), "tolerance": options.tolerance,
    }  # fmt: skip
    return plain, list(_grown_lines(grown, excess, int(reached.sum()), len(setting.support)))


def _grown_lines(grown: GrownSupport, excess: float | None, num_reached: int, n: int) -> Iterator[RenderableType]:
    size = len(grown.costs)
    words, colour = ("complete", "green") if grown.complete else ("stops short", "yellow")
    rounds = f"{len(grown.history)} round{'s' * (len(grown.history) != 1)}"
    yield ""
    yield Text.assemble((words, f"bold {colour}"), f"   Grow-Support: {size} of {n} points confirmed in {rounds}")
    table = _pairs()
    table.add_row(Text("points by round", "dim"), " ".join(map(str, grown.history)))
    table.add_row(Text("largest cost", "dim"), f"{grown.costs.max():.6g}, paid by a real path")
    if excess is not None:
        table.add_row(Text("above the exact cost", "dim"), f"{max(excess, 0.0):.3g} at most")
    table.add_row(Text("its greedy policy", "dim"), f"reaches the goal from {num_reached} of {n} points")
    yield table
    if not grown.complete:
        yield Text("A greater --tolerance, more --points or another --regressor (lwr bends) may confirm more.", "dim")


def _single(case: _Case, options: argparse.Namespace) -> Iterator[RenderableType]:
    """The verdict with what it rests on, the run, and the words."""
    found = case.found
    n = found.run.values.shape[1]
    where = f", {n} {_SUPPORTS[options.support]}, γ = {found.gamma:g}"
    where += f", {options.start} start" * (options.start != "zero")
    headline = Text.assemble((found.verdict, f"bold {_COLOURS[found.verdict]}"), f"   {case.regressor} on {case.world}")
    yield headline.append(where, "dim")
    yield _reasons(found)
    yield _curve(case)
    yield found.explain()
    if found.run.stopped_on_cap:
        yield Text("The run was stopped where it had grown ten-billion-fold.", "dim")
    elif not (found.guaranteed or found.run.converged):
        yield Text(f"Judged from {found.run.iterations} sweeps; more --max-iterations may show more.", "dim")


def _reasons(found: FittedDiagnosis) -> Table:
    averager = {True: "yes", False: "no: some weights are negative or sum to more than 1", None: "a network is none"}
    rows = {
        "averager": averager[found.averager],
        "certain": "yes, from any start" if found.guaranteed else "no: it holds for the start that was run",
        "exaggerates": None if found.hat_norm is None else f"{found.hat_norm:.5g} times at most (‖H‖∞)",
        "local growth": None if found.growth is None else f"×{found.growth:.7g} per sweep at the greedy policy reached",
        "on its way": None if found.ray_growth is None else f"×{found.ray_growth:.7g} per sweep in the mode of the run",
    }
    table = _pairs()
    for name, text in rows.items():
        if text is not None:
            table.add_row(Text(name, "dim"), text)
    return table


def _curve(case: _Case) -> Table:
    """Max |V| and the error after a few sweeps, evenly spread."""
    run = case.found.run
    table = Table("sweep", "max |V|", "changes of policy", *([] if run.error is None else ["max error"]),
                  box=SIMPLE_HEAD)  # fmt: skip
    for column in table.columns:
        column.justify = "right"
    largest, changes = run.max_abs, np.concatenate([[0], np.cumsum(run.policy_changes)])
    for k in run.shown:
        error = [] if run.error is None else [f"{run.error[k]:.5g}"]
        table.add_row(f"{k:,}", f"{largest[k]:.7g}", f"{changes[k]:,}", *error)
    return table


def _tables(cases: Sequence[_Case], options: argparse.Namespace) -> Iterator[RenderableType]:
    """One table for each world, a line for each regressor."""
    for world in dict.fromkeys(case.world for case in cases):
        of_world = [case for case in cases if case.world == world]
        n = of_world[0].found.run.values.shape[1]
        title = f"{world}, {n} {_SUPPORTS[options.support]}, γ = {options.gamma:g}"
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=title, title_justify="left")
        for name in ("regressor", "verdict", "", "‖H‖∞", "growth", "outcome", "max |V|", "error"):
            table.add_column(name, no_wrap=True, justify="right" if name in ("max |V|", "error") else "left")
        for case in of_world:
            table.add_row(*_line(case))
        yield table
    yield Text("✓ certain: the fit is an averager, which converges from any start; other verdicts hold for this one.")
    yield Text("growth: of errors per sweep, at the greedy policy reached; settled, capped (grown ten-billion-fold) "
               "or moving: after so many sweeps; error: largest against the exact cost, if known", "dim")  # fmt: skip


def _line(case: _Case) -> list[str | Text]:
    found, run = case.found, case.found.run
    outcome = "settled" if run.converged else "capped" if run.stopped_on_cap else "moving"
    return [
        case.regressor,
        Text(found.verdict, _COLOURS[found.verdict]),
        "✓" if found.guaranteed else "",
        "" if found.hat_norm is None else f"{found.hat_norm:.4f}",
        "" if found.growth is None else f"{found.growth:.4f}",
        f"{outcome} {run.iterations}",
        f"{run.max_abs[-1]:.4g}",
        "" if run.error is None else f"{run.error[-1]:.3g}",
    ]


def _pairs() -> Table:
    return Table(show_header=False, box=None, padding=(0, 2, 0, 0))


def _plain(case: _Case) -> dict[str, Any]:
    return {"world": case.world, "regressor": case.regressor, **case.found.plain()}
