"""``neuralq lab fitted``: verdict, run and words of one case, the table of all, Grow-Support, and what is refused.

The figures of the 16 × 16 grid are those of an independent float64 iteration of the normal equations (also in
tests/test_fitted.py); those of the tilted start are iterated here by hand-written monomials. The cost of the corner is
19 steps each way of half a cost: 19.

Mutants that die: an option of a regressor that is not passed on; a γ, a support or a start that is not used; the error
without the exact costs of a discount below 1; a verdict from a run too short to tell; a table in which a cell is cut.
"""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import neuralq.lab
from neuralq.apps.cli import main
from neuralq.apps.cli.fitted_choices import REGRESSORS, WORLDS
from neuralq.lab.fitted.diagnosis import diagnose_fitted
from neuralq.lab.fitted.regressors import LeastSquares, NearestNeighbours, linear_features
from neuralq_envs.counterexamples.boyan_moore import gridworld, puddle_world
from neuralq_envs.counterexamples.continuous import grid_support, random_support

Capture = pytest.CaptureFixture[str]


def status(*argv: str) -> int:
    """The exit status, also where argparse ends the process."""
    try:
        return main(["lab", "fitted", *argv])
    except SystemExit as ended:
        return int(ended.code or 0)


def answer(capsys: Capture, *argv: str) -> dict[str, Any]:
    assert status(*argv, "--json") == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def printed(capsys: Capture, *argv: str) -> str:
    assert status(*argv) == 0
    return capsys.readouterr().out


def _tilted_oracle(num_sweeps: int) -> float:
    """max |V| on the 16 × 16 grid from a start tilted by a thousandth, written out with six monomials."""
    g = np.linspace(0, 1, 16)
    y, x = (part.reshape(-1) for part in np.meshgrid(g, g))

    def phi(x: Any, y: Any) -> Any:
        return np.stack([x**0, x, y, x * x, x * y, y * y], axis=1)

    def at_goal(x: Any, y: Any) -> Any:
        return (x > 0.9499999) & (y > 0.9499999)

    fit = np.linalg.lstsq(phi(x, y), np.eye(len(x)), rcond=None)[0]
    moves = [
        (np.clip(x + dx, 0, 1), np.clip(y + dy, 0, 1)) for dx, dy in ((0.05, 0), (-0.05, 0), (0, 0.05), (0, -0.05))
    ]
    w = fit @ (1e-3 * (x - y))
    for _ in range(num_sweeps):
        q = [0.5 + np.where(at_goal(*to), 0.0, phi(*to) @ w) for to in moves]
        w = fit @ np.where(at_goal(x, y), 0.0, np.min(q, axis=0))
    return float(np.abs(phi(x, y) @ w).max())


def test_the_16_grid_diverges_as_published_and_a_tilt_saves_it(capsys: Capture) -> None:
    found = answer(capsys, "gridworld")
    assert (found["verdict"], found["certain"], found["averager"]) == ("diverges", False, False)
    assert found["stopped_on_cap"] and found["num_points"] == 256
    assert found["hat_norm"] == pytest.approx(3.0336, rel=1e-4)  # independent float64 computation
    assert found["ray_growth"] == pytest.approx(1.0850436, rel=1e-6)
    after_500 = answer(capsys, "gridworld", "--max-iterations", "500")["max_abs"]
    assert after_500[-1] == [500, pytest.approx(1.9097e8, rel=1e-4)]
    assert after_500[6] == [300, pytest.approx(15.0143, rel=1e-4)]
    tilted = answer(capsys, "gridworld", "--start", "tilted")
    assert tilted["verdict"] == "converges" and tilted["converged"]
    assert tilted["max_abs"][-1][1] == pytest.approx(_tilted_oracle(900), rel=1e-6)


def test_a_run_too_short_to_tell_is_called_undecided(capsys: Capture) -> None:
    """The same tilted run that settles after 769 sweeps, on its way up from a trough."""
    found = answer(capsys, "gridworld", "--start", "tilted", "--max-iterations", "500")
    assert found["verdict"] == "undecided" and "Undecided" in found["explanation"]
    assert "more --max-iterations" in printed(capsys, "gridworld", "--start", "tilted", "--max-iterations", "500")


def test_the_parts_stand_in_the_order_verdict_run_words(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    for width in ("80", "120"):
        monkeypatch.setenv("COLUMNS", width)
        text = printed(capsys, "gridworld")
        order = [text.index(part) for part in ("diverges   quadratic", "‖H‖∞", "max error", "Diverges: max |V|")]
        assert order == sorted(order) and "…" not in text
        assert max(map(len, text.splitlines())) <= int(width)
        sure = printed(capsys, "gridworld", "--regressor", "nearest")
        assert "yes, from any start" in sure and "Converges for certain" in sure and "more --max-iterations" not in sure
    assert "tilted start" in printed(capsys, "car-on-the-hill", "--start", "tilted", "--regressor", "nearest")


@pytest.mark.slow
def test_everything_is_passed_on(capsys: Capture) -> None:
    near = answer(capsys, "puddle-world", "--regressor", "nearest", "--neighbours", "3", "--gamma", "0.9")
    expected = diagnose_fitted(puddle_world(), grid_support(puddle_world(), 16), NearestNeighbours(3), gamma=0.9)
    assert near["max_abs"][-1] == [expected.run.iterations, pytest.approx(expected.run.max_abs[-1])]
    assert near["gamma"] == 0.9 and near["contraction"] == pytest.approx(0.9)
    points = random_support(gridworld(), 64, np.random.default_rng(3))
    drawn = answer(capsys, "gridworld", "--regressor", "linear", "--points", "8", "--support", "random", "--seed", "3")
    expected = diagnose_fitted(gridworld(), points, LeastSquares(linear_features))
    assert drawn["max_abs"][-1] == [expected.run.iterations, pytest.approx(expected.run.max_abs[-1])]
    assert answer(capsys, "gridworld", "--points", "11", "--support", "no-goal")["num_points"] == 120
    wide, narrow = (
        answer(capsys, "gridworld", "--regressor", "kernel", "--bandwidth", h, "--points", "8") for h in ("0.3", "0.01")
    )
    assert wide["max_abs"] != narrow["max_abs"]
    car = ["car-on-the-hill", "--points", "8", "--regressor", "aggregation"]
    assert answer(capsys, *car, "--boxes", "4")["max_abs"] == answer(capsys, *car)["max_abs"]  # half the points
    assert answer(capsys, *car, "--boxes", "2")["max_abs"] != answer(capsys, *car)["max_abs"]


def test_errors_are_against_exact_costs_where_those_are_known(capsys: Capture) -> None:
    """21 points a side hold every state that they can reach, so interpolation there is exact value iteration."""
    plain = answer(capsys, "gridworld", "--points", "11", "--regressor", "interpolation")
    assert plain["error"][0] == [0, 19.0]  # by hand
    discounted = answer(capsys, "gridworld", "--points", "11", "--regressor", "linear", "--gamma", "0.9")
    # 38 steps of half a cost under γ = .9: ½ (1 − .9³⁸)/(1 − .9), from a start at 0
    assert discounted["error"][0] == [0, pytest.approx(5 * (1 - 0.9**38), rel=1e-9)]
    assert answer(capsys, "car-on-the-hill", "--regressor", "nearest")["error"] is None
    exact = answer(capsys, "gridworld", "--start", "exact", "--regressor", "nearest", "--points", "8")
    assert exact["error"][0] == [0, 0.0]  # the nearest point of a point is itself


@pytest.mark.slow
def test_growing_the_support_finds_the_shortest_paths(capsys: Capture) -> None:
    grown = answer(capsys, "gridworld", "--grow-support")["grown"]
    assert grown["complete"] and grown["num_points"] == grown["num_reached"] == 256
    assert grown["max_cost"] == 19.0 and grown["max_excess"] == pytest.approx(0.0, abs=1e-9)  # by hand
    text = printed(capsys, "puddle-world", "--grow-support", "--points", "8", "--tolerance", "1")
    assert "stops short   Grow-Support:" in text and "--tolerance" in text
    strict, lax = (answer(capsys, "puddle-world", "--grow-support", "--tolerance", t)["grown"] for t in ("0.5", "10"))
    assert strict["history"] != lax["history"]


@pytest.mark.slow
def test_the_table_has_every_world_under_every_regressor(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = printed(capsys, "--points", "8", "--max-iterations", "200")
    assert "…" not in text and max(map(len, text.splitlines())) <= 80
    assert all(text.count(f" {one.name} ") == 3 * (one.name != "network") for one in REGRESSORS)
    cases = answer(capsys, "--points", "6", "--max-iterations", "100")["cases"]
    assert [case["world"] for case in cases[::7]] == [make().name for make in WORLDS]
    assert {case["regressor"] for case in cases if case["certain"]} >= {"interpolation"}
    some = answer(capsys, "gridworld", "--regressor", "nearest", "--regressor", "linear", "--points", "6")["cases"]
    assert [case["regressor"] for case in some] == ["linear", "nearest"]


@pytest.mark.slow  # it loads PyTorch
def test_a_network_is_run_if_asked(capsys: Capture) -> None:
    found = answer(
        capsys, "gridworld", "--regressor", "network", "--points", "4", "--hidden", "3", "--max-iterations", "3"
    )
    assert (found["averager"], found["hat_norm"], found["sweeps"]) == (None, None, 3)


def test_list_names_worlds_and_regressors(capsys: Capture) -> None:
    assert main(["lab", "list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in found["worlds"]] == ["gridworld", "puddle-world", "car-on-the-hill"]
    assert [one["name"] for one in found["regressors"]] == [one.name for one in REGRESSORS]
    assert main(["lab", "list"]) == 0
    assert "fitted value iteration" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "code", "message"),
    [
        (["nope"], 1, "no world is called 'nope'; there are gridworld"),
        (["gridworld", "--regressor", "nope"], 2, "invalid choice: 'nope'"),
        (["gridworld", "--boxes", "3"], 1, "--boxes is for --regressor aggregation, not for quadratic"),
        (["gridworld", "--points", "1"], 1, "--points must be a whole number of at least 2"),
        (["gridworld", "--points", "50", "--regressor", "lwr"], 1, "at most 40 for lwr"),
        (["gridworld", "--gamma", "2"], 1, "--gamma must lie in [0, 1]"),
        (["gridworld", "--gamma", "nan"], 1, "--gamma must lie in [0, 1]"),
        (["gridworld", "--max-iterations", "0"], 1, "--max-iterations must be a whole number"),
        (["gridworld", "--seed", "-1", "--support", "random"], 1, "--seed must be a whole number"),
        (["gridworld", "--regressor", "interpolation", "--support", "random"], 1, "needs a full grid"),
        (["gridworld", "--regressor", "nearest", "--neighbours", "0"], 1, "num_neighbours"),
        (["gridworld", "--regressor", "kernel", "--bandwidth", "0"], 1, "bandwidth"),
        (["car-on-the-hill", "--start", "exact"], 1, "exact costs of car-on-the-hill are not known"),
        (["--grow-support"], 2, "--grow-support needs a WORLD"),
        (["gridworld", "--grow-support", "--gamma", "0.9"], 1, "--gamma must be 1"),
        (["gridworld", "--grow-support", "--tolerance", "0"], 1, "--tolerance"),
        (["gridworld", "--grow-support", "--regressor", "network"], 1, "choose another regressor"),
    ],
)
def test_refusals_say_what_to_do(capsys: Capture, argv: list[str], code: int, message: str) -> None:
    assert status(*argv) == code
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err and not captured.out


def test_the_lab_exports_it_all() -> None:
    for name in ("fitted_iteration", "diagnose_fitted", "grow_support", "gridworld", "puddle_world", "car_on_the_hill",
                 "LeastSquares", "NearestNeighbours", "GridInterpolation", "StateAggregation", "KernelSmoothing",
                 "LocallyWeighted", "grid_support", "random_support"):  # fmt: skip
        assert name in neuralq.lab.__all__ and callable(getattr(neuralq.lab, name))


@pytest.mark.whole
def test_without_a_network_torch_is_not_loaded() -> None:
    code = (
        "import sys; from neuralq.apps.cli import main\n"
        "main(['lab', 'fitted', 'gridworld', '--points', '4', '--json'])\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)
