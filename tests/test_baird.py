"""Baird's star: one update over five representations, against published sweeps and finite differences.

The numbers of the linear run are Sutton & Barto 2018, equation 11.9 from the figure's initial weights, computed by an
independent double-precision matrix iteration.

Mutants that die here: targets taken after the first state has moved; the ratio applied twice; dashed pairs that count;
the weight of 10 missing; a gradient that flows through the target; a Jacobian without the Hessian term; a growth fitted
on the first half; a last sweep that is not recorded.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from neuralq.lab import (
    expected_backup,
    expected_td_step,
    local_growth,
    predict_representations,
    run_representations,
)
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.baird import DASHED, SOLID

SWEEPS = {  # upper weights, weight of the lower state, shared weight
    1: (1.025371, 9.999829, 1.075771),
    10: (1.256735, 9.998188, 1.766580),
    100: (3.894886, 9.971199, 9.627054),
    500: (26.620084, 9.484751, 76.829754),
    1000: (114.433716, 6.850030, 335.001209),
}
RMSVE = {0: 5.318432, 10: 6.469824, 100: 19.545527, 500: 135.290776, 1000: 581.355105}


def linear_star() -> LinearQ:
    q = LinearQ(8, 2)
    with torch.no_grad():
        q.weight[SOLID] = torch.tensor(star().initial_weights)
        q.weight[DASHED] = 3.0
    return q


def test_linear_sweeps_are_the_books() -> None:
    q = linear_star()
    backup = expected_backup(star(), torch.tensor(star().features))
    for k in range(1, 1001):
        expected_td_step(q, backup, 0.01)
        if k in SWEEPS:
            upper, lower, shared = SWEEPS[k]
            expected = [upper] * 6 + [lower, shared]
            assert q.weight[SOLID].detach().numpy() == pytest.approx(np.array(expected), rel=1e-6)
    assert q.weight[DASHED].tolist() == [3.0] * 8  # the ratio of a dashed pair is 0


@pytest.fixture(scope="module")
def results() -> dict[str, object]:
    return {result.representation: result for result in run_representations(star(), 1500)}


@pytest.mark.slow
def test_the_five_run_in_order_and_stay_finite(results: dict) -> None:  # type: ignore[type-arg]
    assert list(results) == ["table", "linear", "action-input", "separate", "action-output"]
    for result in results.values():
        assert result.exact_values.tolist() == [0.0] * 7
        assert len(result.rmsve) == result.steps + 1
        numbers = (result.rmsve, result.values, [result.predicted_growth, result.measured_growth, result.rise])
        assert all(np.isfinite(x).all() for x in numbers)
        assert result.stopped_on_cap == (result.steps < 1500)
        assert result.rmsve[-1] == pytest.approx(np.sqrt(np.mean(result.values**2)))


def test_the_table_converges_at_the_predicted_rate(results: dict) -> None:  # type: ignore[type-arg]
    table, rate = results["table"], 1 - 0.01 * 0.01 / 7  # 1 − α (1 − γ) / 7
    assert (table.verdict, table.prediction_scope) == ("converges", "global")
    assert table.predicted_growth == pytest.approx(rate, abs=1e-14)
    assert table.measured_growth == pytest.approx(rate, abs=1e-7)
    assert table.values == pytest.approx(np.full(7, rate**1500), rel=1e-4)


def test_the_linear_features_diverge_at_the_predicted_rate(results: dict) -> None:  # type: ignore[type-arg]
    linear = results["linear"]
    assert (linear.verdict, linear.prediction_scope) == ("diverges", "global")
    assert linear.predicted_growth == pytest.approx(1.0023925, rel=1e-6)
    assert linear.measured_growth == pytest.approx(1.0023925, rel=1e-3)
    for k, value in RMSVE.items():
        assert linear.rmsve[k] == pytest.approx(value, rel=1e-6)
    # Far out only the leading mode is left: the ratio of two sweeps is the radius.
    q, backup = linear_star(), expected_backup(star(), torch.tensor(star().features))
    for _ in range(1000):
        before = backup.state_values(expected_td_step(q, backup, 0.05))
    after = backup.state_values(expected_td_step(q, backup, 0.05))
    assert (after / before).tolist() == pytest.approx([predict_representations(star(), 0.05)[1].growth] * 7, rel=2e-6)


def test_the_networks_verdict_is_local_and_their_values_rise(results: dict) -> None:  # type: ignore[type-arg]
    for name in ("action-input", "separate", "action-output"):
        result = results[name]
        assert (result.verdict, result.prediction_scope) == ("grows", "local")
        assert result.predicted_growth > 1
        assert result.rise > 1.5


def test_predictions_are_those_of_the_run(results: dict) -> None:  # type: ignore[type-arg]
    for prediction in predict_representations(star()):
        result = results[prediction.representation]
        assert (prediction.growth, prediction.scope, prediction.verdict) == (
            result.predicted_growth, result.prediction_scope, result.verdict)  # fmt: skip


@pytest.mark.parametrize(("gamma", "num_upper", "verdict"), [
    (15 / 17 - 0.01, 6, "converges"), (15 / 17 + 0.01, 6, "diverges"), (0.99, 4, "converges"), (0.99, 5, "diverges"),
])  # fmt: skip
def test_prediction_and_measurement_agree_on_both_sides_of_the_threshold(
    gamma: float, num_upper: int, verdict: str
) -> None:
    problem = star(num_upper)
    (prediction,) = (p for p in predict_representations(star(num_upper, gamma), 0.1) if p.representation == "linear")
    assert prediction.verdict == verdict
    # The same sweep with the matrix written out, far enough for the slow mode to show.
    x, d = problem.features, problem.state_distribution
    to_lower = np.tile(np.eye(num_upper + 1)[num_upper], (num_upper + 1, 1))
    sweep = np.eye(num_upper + 2) - 0.1 * x.T @ np.diag(d) @ (x - gamma * to_lower @ x)
    errors = [np.linalg.norm(x @ np.linalg.matrix_power(sweep, k) @ problem.initial_weights) for k in (5000, 20000)]
    assert (errors[1] > errors[0]) == (verdict == "diverges")


def test_a_wild_step_stops_on_the_cap_without_an_overflow() -> None:
    for step_size in (30.0, 1e200):
        for result in run_representations(star(), 100, step_size):
            assert result.stopped_on_cap or result.representation not in ("table", "linear")
            assert np.isfinite(result.rmsve).all() and np.isfinite(result.values).all()
            assert np.isfinite(result.measured_growth)


def test_runs_repeat_themselves_and_differ_by_seed() -> None:
    first, again, other = (run_representations(star(), 20, seed=seed)[3].rmsve for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_broken_arguments_are_named() -> None:
    for gamma, arguments, message in [
        (1.0, {}, "baird never ends, so it has no values with γ = 1"),
        (0.99, {"step_size": 0.0}, "step_size must be a finite number above 0"),
        (0.99, {"num_steps": 3}, "num_steps must be a whole number of at least 4"),
        (0.99, {"seed": -1}, "seed must be a whole number of at least 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            run_representations(star(gamma=gamma), **arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="gamma must lie in"):
        star(gamma=-0.1)
    with pytest.raises(ValueError, match="num_upper"):
        star(0)
    with pytest.raises(ValueError, match="one row for each of 7 states, got 3"):
        expected_backup(star(), torch.arange(3))


LAYOUTS = [ActionInputQ, SeparateQ, ActionOutputQ]


def flat(q: torch.nn.Module) -> NDArray[np.float64]:
    return torch.cat([p.detach().reshape(-1) for p in q.parameters()]).numpy().copy()


def load(q: torch.nn.Module, theta: NDArray[np.float64]) -> None:
    with torch.no_grad():
        torch.nn.utils.vector_to_parameters(torch.from_numpy(theta.copy()), q.parameters())


def update_by_differences(q: torch.nn.Module, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """F(θ) with ∇Q from central differences: Σ_s (1/7) (γ Q(lower, solid) − Q(s, solid)) ∇Q(s, solid)."""
    x = torch.tensor(star().features)

    def solid(at: NDArray[np.float64]) -> NDArray[np.float64]:
        load(q, at)
        with torch.no_grad():
            values: NDArray[np.float64] = q.all(x)[:, SOLID].numpy().copy()  # type: ignore[operator]
        return values

    v = solid(theta)
    steps = 1e-5 * np.eye(len(theta))
    gradient = np.array([(solid(theta + h) - solid(theta - h)) / 2e-5 for h in steps])
    load(q, theta)
    update: NDArray[np.float64] = gradient @ ((0.99 * v[6] - v) / 7)
    return update


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_networks_step_is_the_semi_gradient(layout: type[torch.nn.Module]) -> None:
    q = layout((8,), 2, body=MLP(hidden=(5,), activation="tanh"), rng=0, dtype=torch.float64)
    backup = expected_backup(star(), torch.tensor(star().features))
    before = flat(q)
    expected = update_by_differences(q, before)
    values = expected_td_step(q, backup, 0.1)
    assert flat(q) - before == pytest.approx(0.1 * expected, abs=1e-9)
    assert backup.state_values(values).numpy() == pytest.approx(values[:, SOLID].numpy())


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.slow
def test_local_growth_is_the_derivative_of_the_whole_update(layout: type[torch.nn.Module]) -> None:
    q = layout((8,), 2, body=MLP(hidden=(2,), activation="tanh"), rng=1, dtype=torch.float64)
    backup = expected_backup(star(), torch.tensor(star().features))
    found = local_growth(q, backup, 0.5)
    theta = flat(q)
    steps = 1e-4 * np.eye(len(theta))
    columns = [(update_by_differences(q, theta + h) - update_by_differences(q, theta - h)) / 2e-4 for h in steps]
    eigenvalues = np.linalg.eigvals(np.array(columns).T)
    moving = eigenvalues[np.abs(eigenvalues) > 1e-5]
    assert found == pytest.approx(np.abs(1 + 0.5 * moving).max(), abs=1e-5)


def test_local_growth_of_linear_representations_is_the_global_one() -> None:
    linear = local_growth(linear_star(), expected_backup(star(), torch.tensor(star().features)), 0.01)
    assert linear == pytest.approx(1.0023925, abs=5e-8)
    table = local_growth(TableQ(7, 2), expected_backup(star(), torch.arange(7)), 0.01)
    assert table == pytest.approx(1 - 1e-4 / 7, abs=1e-12)


@pytest.mark.slow
def test_the_script_prints_what_its_docstring_says(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = Path(__file__).parent.parent / "scripts" / "baird.py"
    picture = tmp_path / "star.svg"
    monkeypatch.setattr(sys, "argv", [str(script), "--num-steps", "300", "--svg", str(picture)])
    monkeypatch.setenv("COLUMNS", "100")
    printed = runpy.run_path(str(script), run_name="__main__")["__doc__"]
    shown = capsys.readouterr().out
    for text in ("γ > 0.8824", "1.0023925", "0.9999857", "1.0037821", "at the initial weights"):
        assert text in shown and text in printed
    assert "<svg" in picture.read_text()
