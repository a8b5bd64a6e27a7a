"""The matrix of problems and methods: runs judged without the diagnosis, disagreements found, nothing hidden.

Oracles: growths by plain loops over the model written here, eigenvalues in closed form, the published divergence of
each problem, and predictions falsified on purpose.

Mutants that die here: an outcome read off the diagnosis; a run that is too short to leave; a cycle taken for rest; a
neutral band that swallows everything, or nothing; a disagreement that is not listed; a method skipped without a
reason; the cap of a sampled run ignored; rows and columns exchanged; a table whose lines are no CSV.
"""

from __future__ import annotations

import csv
import importlib
import math
import pkgutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import neuralq.lab
from neuralq.lab import METHODS, PROBLEMS, Cell, Matrix, Trial, matrix, problem, run
from neuralq.lab.comparison import ABSENT, NEUTRAL_BAND, Sampled, applies, outcome_of
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star

CURVES = np.arange(0, 1001, 5)


def two_states(gamma: float, step_size: float = 0.1) -> Problem:
    """Features 1 and 2, the second state for ever, equally often: A = (5 − 6γ)/2 (Tsitsiklis & Van Roy 1996)."""
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1.0]]], [[0.0], [0.0]])
    return Problem.from_mdp(
        mdp, [[1.0], [2.0]], gamma=gamma, state_distribution=[0.5, 0.5], step_size=step_size, name=f"two-{gamma:g}"
    )


def record(curve: np.ndarray, left: int = -1) -> Trial:
    """A run whose errors are given."""
    errors = np.asarray(curve, dtype=np.float64)[:, None]
    made = run(two_states(0.5), "td", num_steps=1)
    return replace(made, steps=CURVES, rmsve=errors, rmspbe=errors, stopped_at=np.array([left]))


@pytest.mark.parametrize(
    ("curve", "left", "outcome"),
    [
        (np.full(201, 3.0), -1, "settles"),
        (3.0 + 0.9 ** np.arange(201), -1, "settles"),
        (3.0 + 1e-12 * np.sin(np.arange(201.0)), -1, "settles"),  # rounding
        (1.0 + np.arange(201.0), -1, "keeps moving"),  # a drift
        (5.0 + np.sin(np.arange(201.0)), -1, "keeps moving"),  # a cycle
        (1.01 ** np.arange(201), -1, "keeps moving"),  # it may still turn
        (1.01 ** np.arange(201), 900, "grows"),
        (np.full(201, 3.0), 900, "grows"),
    ],
)
def test_outcomes_are_read_off_the_record_alone(curve: np.ndarray, left: int, outcome: str) -> None:
    assert outcome_of(record(curve, left)) == outcome


def test_a_slow_decay_settles_only_where_no_longer_run_can_follow() -> None:
    slow = record(3.0 + 0.99 ** np.arange(201))  # by e^-0.5 in a quarter
    assert outcome_of(slow) == "keeps moving"
    assert outcome_of(slow, patient=False) == "settles"


@pytest.mark.parametrize(("gamma", "outcome"), [(0.8, "settles"), (0.83, "settles"), (0.84, "grows"), (0.9, "grows")])
def test_two_states_turn_at_five_sixths(gamma: float, outcome: str) -> None:
    one = two_states(gamma)
    (cell,) = matrix([one], ["td"]).cells
    assert (cell.measured, cell.agree) == (outcome, True)
    assert cell.spectral_radius == pytest.approx(1 - 0.1 * (5 - 6 * gamma) / 2, rel=1e-12)
    if outcome == "grows":
        assert cell.growth == pytest.approx(1 + 0.1 * (6 * gamma - 5) / 2, rel=1e-9)


def test_the_band_is_stated_and_narrow() -> None:
    inside = two_states(5 / 6 + 1e-6)  # ρ − 1 = 3e-7
    outside = two_states(5 / 6 + 1e-5)  # ρ − 1 = 3e-6
    found = matrix([inside, outside], ["td"])
    assert [cell.neutral for cell in found.cells] == [True, False]
    assert [cell.agree for cell in found.cells] == [None, True]
    assert found.cells[1].measured == "grows"  # the run is long enough to show it
    assert found.neutral == found.cells[:1] and NEUTRAL_BAND == 1e-6


def test_published_verdicts_of_the_star() -> None:
    """Sutton & Barto 2018, sections 11.2, 11.7 and 11.8: TD diverges, gradient and emphatic methods do not."""
    found = matrix(["baird", "baird-low-gamma", "baird-tabular"], ["td", "tdrc", "etd"])
    assert [cell.measured for cell in found.cells] == ["grows", *["settles"] * 8]
    assert not found.disagreements
    sweep = run(star(), "td", num_steps=5000)
    assert found.cell("baird", "td").growth == pytest.approx(sweep.growth, rel=1e-4)


@pytest.mark.slow
def test_chattering_is_seen_without_the_diagnosis() -> None:
    """Gordon 1996: Sarsa keeps switching between two greedy policies, Q-learning on the same problem settles."""
    found = matrix(["chattering"], ["sarsa", "q-learning"])
    assert [(cell.predicted, cell.measured) for cell in found.cells] == [
        ("chatters", "keeps moving"),
        ("converges", "settles"),
    ]


def test_the_spiral_is_run_on_its_own_values_and_not_on_tangents() -> None:
    """Tsitsiklis & Van Roy 1997: V grows by e^{ε w}; a plain loop over θ must leave at the same update."""
    one = problem("spiral")
    (cell,) = matrix([one], ["td"]).cells
    assert one.value is not None
    theta, step = one.initial_weights.copy(), 0
    transition = np.einsum("sa,ast->st", one.target_policy, one.mdp.transition.toarray().reshape(1, 3, 3))
    while np.abs(one.value.values(theta)).max() <= 1e10 * max(1.0, float(np.abs(one.initial_weights).max())):
        v = one.value.values(theta)
        delta = one.gamma * transition @ v - v
        theta = theta + one.step_size * one.value.jacobian(theta).T @ (one.state_distribution * delta)
        step += 1
    assert (cell.measured, cell.num_steps) == ("grows", step)


def test_cells_without_meaning_say_why() -> None:
    assert applies(problem("spiral"), "td") is None
    assert applies(problem("spiral"), "etd") == "nonlinear"
    assert applies(problem("baird-control"), "q-learning") is None
    found = matrix(["baird"], ["q-learning", "fitted"], sampling="iid", num_seeds=2, num_steps=10)
    assert found.cells[0].absent == "actions" and found.cells[0].agree is None
    assert found.cells[1].absent is None and found.cells[1].sampled_absent == "solves"
    assert {"actions", "nonlinear", "solves"} <= set(ABSENT)


def test_a_false_prediction_is_a_disagreement() -> None:
    found = matrix(["w2w"], ["td"])
    (true,) = found.cells
    for wrong in ("converges", "chatters", "stable but poor fixed point"):
        false = replace(true, predicted=wrong)  # type: ignore[arg-type]
        assert Matrix(found.problems, found.methods, (false,)).disagreements == (false,)
    assert replace(true, predicted="neutral").agree is None
    assert not found.disagreements


def test_sampled_runs_are_held_against_the_mean_square_only() -> None:
    settled = Sampled("markov", 20, 100, 0, 1.0, 0.99)
    assert settled.agree is True
    assert replace(settled, num_diverged=1).agree is False
    assert replace(settled, num_diverged=20, second_moment_radius=1.01).agree is None
    assert replace(settled, second_moment_radius=None).agree is None
    cell = Cell("x", "td", None, "converges", 0.9, 1, "settles", 1.0, 10, replace(settled, num_diverged=1))
    assert cell.agree is True and cell.disagrees


def test_sampled_runs_of_two_states() -> None:
    """Independent draws of w ← (1 + α (2γ − 1)) w and w ← (1 + 4α (γ − 1)) w: E w² by hand."""
    one = two_states(0.9)
    (cell,) = matrix([one], ["td"], sampling="iid", num_seeds=50, num_steps=400).cells
    assert cell.sampled is not None
    factors = np.array([1 + 0.1 * 0.8, 1 + 0.4 * -0.1])
    assert cell.sampled.second_moment_radius == pytest.approx(float((factors**2).mean()), rel=1e-9)
    typical = math.exp(float(np.log(factors).mean()))
    spread = float(np.log(factors).std()) / math.sqrt(50)  # of the median path's slope, generously
    assert math.log(cell.sampled.growth) == pytest.approx(math.log(typical), abs=4 * spread / math.sqrt(200))


def test_cells_are_found_by_name_and_written_down(tmp_path: Path) -> None:
    seen: list[tuple[str, str, int, int]] = []
    found = matrix(["w2w", "baird"], ["td", "fitted", "sarsa"], lambda *where: seen.append(where))
    assert seen[4] == ("baird", "fitted", 4, 6) and len(seen) == 6
    assert found.cell("baird", "fitted").problem == "baird" and found.cell("baird", "fitted").method == "fitted"
    with pytest.raises(ValueError, match="no cell"):
        found.cell("fitted", "baird")
    with found.write_csv(tmp_path / "m.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["problem"], row["method"], row["predicted"]) for row in rows] == [
        ("w2w", "td", "diverges"), ("w2w", "fitted", "diverges"), ("w2w", "sarsa", ""),
        ("baird", "td", "diverges"), ("baird", "fitted", "converges"), ("baird", "sarsa", ""),
    ]  # fmt: skip
    plain = found.plain()
    assert (plain["num_judged"], plain["num_absent"], plain["num_disagreements"]) == (4, 2, 0)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="no problem is called 'nope'"):
        matrix(["nope"], ["td"])
    with pytest.raises(ValueError, match="no method 'nope'"):
        matrix(["baird"], ["nope"])
    with pytest.raises(ValueError, match="num_seeds"):
        matrix(["baird"], ["td"], sampling="iid", num_seeds=0)


def test_the_labs_names_stay_functions_whatever_is_imported() -> None:
    """The import of a module binds its name in the package, and must not take a function of that name away."""
    for module in pkgutil.walk_packages(neuralq.lab.__path__, "neuralq.lab."):
        importlib.import_module(module.name)
    for name in ("run", "critical", "diagnose", "prescribe", "matrix"):
        assert callable(getattr(neuralq.lab, name)), name
    assert set(dir(neuralq.lab)) == set(neuralq.lab.__all__)
    assert all(getattr(neuralq.lab, name) is not None for name in neuralq.lab.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nope'"):
        neuralq.lab.nope  # noqa: B018


@pytest.mark.slow
def test_every_problem_under_every_method() -> None:
    found = matrix()
    assert len(found.cells) == len(PROBLEMS) * len(METHODS)
    assert not found.disagreements, [(cell.problem, cell.method) for cell in found.disagreements]
    assert sum(cell.agree is True for cell in found.cells) > 0.9 * sum(cell.absent is None for cell in found.cells)
