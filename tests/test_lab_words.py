"""What a diagnosis says, sentence by sentence, from records made by hand: no branch and no number is left to chance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from neuralq.lab.verdicts.words import Diagnosis, Region

LOOSE, HELD = Region(0.9, None, False), Region(0.9, np.ones(1), True)


def given(**changes: Any) -> Diagnosis:
    """TD(0) with α = .1 whose mean error shrinks by .9 in every sweep, with some fields changed."""
    base = Diagnosis(
        "toy", "TD(λ)", {"lambda_": 0.0}, 0.1, "expected", True, "converges", 0.9, None, 20.0, None, False, None,
        np.array([0.9 + 0j]), 1, np.ones(1), 0.5, 0.25, 1.0,
    )  # fmt: skip
    return replace(base, **changes)


SHRINKS = "Its slowest error is multiplied by 0.9 in every sweep: it halves every 6.58 sweeps."
AT_EVERY = " The mean converges for every step size below 20."


def test_the_whole_paragraph_of_a_plain_case() -> None:
    assert given().explain() == (
        f"TD(0) on toy with α = 0.1 converges. {SHRINKS}{AT_EVERY} "
        "The fixed point is 0.5 (RMS) from the true values; the best weights are 0.25 from them."
    )
    assert given().rates.tolist() == pytest.approx([1.0])
    assert given(step_size=0.2, eigenvalues=np.array([1.5, 0.5 - 1j])).rates.tolist() == pytest.approx([-2.5, 2.5 + 5j])


@pytest.mark.parametrize(
    ("changes", "begins"),
    [
        ({"options": {"lambda_": 0.5}}, "TD(0.5) on toy with α = 0.1 converges."),
        ({"method": "LSTD(λ)", "options": {}}, "LSTD(λ) on toy with α = 0.1 converges."),
        ({"options": {"lambda_": 0.0, "eta": 0.0, "beta": 0.25}}, "TD(0) on toy with α = 0.1 (β = 0.25) converges."),
        (
            {"options": {"lambda_": 1.0, "beta": -1.0, "eta": -1.0, "period": 7.0}, "sampling": "iid"},
            "TD(1) on toy with α = 0.1 (β = γ, η = -1, period = 7), on independent transitions, converges.",
        ),
        ({"sampling": "markov"}, "TD(0) on toy with α = 0.1, along a chain, converges."),
        ({"verdict": "chatters"}, "TD(0) on toy with α = 0.1 chatters: it neither settles nor grows."),
    ],
)
def test_the_headline_names_method_options_and_sampling(changes: dict[str, Any], begins: str) -> None:
    assert given(**changes).explain().startswith(begins)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, SHRINKS),
        ({"sampling": "iid"}, "Its slowest error is multiplied by 0.9 in every update: it halves every 6.58 updates."),
        (
            {"updates": 2, "oscillates": True},
            "Its slowest error is multiplied by 0.9 in every period of 2 updates while it swings from side to side: "
            "it halves every 13.2 updates.",
        ),
        ({"spectral_radius": 0.5}, "Its slowest error is multiplied by 0.5 in every sweep."),
        (
            {"spectral_radius": 0.501},
            "Its slowest error is multiplied by 0.501 in every sweep: it halves every 1 sweeps.",
        ),
        ({"spectral_radius": 0.0}, "The mean error is gone after the first sweep."),
        ({"eigenvalues": np.zeros(0)}, "The expected update moves nothing at all."),
        (
            {"spectral_radius": 1.25, "doubling_time": 3.106, "sampling": "markov"},
            "Its leading error is multiplied by 1.25 in every update: it doubles every 3.11 updates.",
        ),
        (
            {"verdict": "neutral", "spectral_radius": 1.0},
            "Its leading factor per sweep is 1: an error of that kind stays as large as it is.",
        ),
    ],
)  # fmt: skip
def test_growth(changes: dict[str, Any], sentence: str) -> None:
    text = given(fixed_point_error=None, **changes).explain()
    assert text.split(". ", 1)[1] == sentence + AT_EVERY


def test_a_drift_is_told_alone() -> None:
    text = given(drift=0.5, verdict="neutral", second_moment_radius=1.5, fixed_point_error=None).explain()
    assert text == (
        "TD(0) on toy with α = 0.1 is neutral: it neither dies out nor grows exponentially. No weights are a fixed "
        "point: every step adds a part of length 0.5 that nothing takes back, so the weights drift linearly and for "
        "ever."
    )


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"second_moment_radius": 0.999},
            "The mean square of the weights' error is multiplied by 0.999 per update, so the scatter between runs "
            "settles too.",
        ),
        (
            {"second_moment_radius": 1.0, "follow_on": True},
            "The mean square of its follow-on is multiplied by 1 per update: single runs scatter ever more widely, "
            "although their average behaves.",
        ),
        (
            {"second_moment_radius": 2.0, "spectral_radius": 1.0, "verdict": "neutral"},
            "The mean square of the weights' error is multiplied by 2 per update: single runs scatter ever more "
            "widely.",
        ),
    ],
)
def test_variance(changes: dict[str, Any], sentence: str) -> None:
    assert given(fixed_point_error=None, **changes).explain().endswith(f" {sentence}{AT_EVERY}")


NEUTRAL = {"spectral_radius": 1.0, "verdict": "neutral", "step_size_bound": 0.0}
NO_RANGE = "Small step sizes do not converge, so no range from 0 up is safe."


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"step_size_bound": 0.0}, NO_RANGE),
        ({"step_size_bound": 0.0, "flow": False}, NO_RANGE),  # it converges at this one
        ({**NEUTRAL, "eigenvalues": np.array([-1.0])}, NO_RANGE),  # a flow whose rates are all above 0
        (
            {**NEUTRAL, "eigenvalues": np.array([1.0])},  # the rate is 0
            "No step size helps: the matrix of the expected update has an eigenvalue with the real part 0, so smaller "
            "steps only diverge more slowly.",
        ),
        (
            {**NEUTRAL, "eigenvalues": np.array([0.5, 1.05])},
            "No step size helps: the matrix of the expected update has an eigenvalue with the real part -0.5, so "
            "smaller steps only diverge more slowly.",
        ),
        (
            {**NEUTRAL, "eigenvalues": np.array([-1.0]), "flow": False},
            "The smallest step sizes do not converge either, so no range from 0 up is safe.",
        ),
        ({**NEUTRAL, "eigenvalues": np.array([1.05]), "sampling": "markov"}, "Smaller steps only diverge more slowly."),
        ({"step_size_bound": math.inf}, "The step size does not matter."),
        (
            {"step_size_bound_second_moment": 1.234567},
            f"{AT_EVERY[1:]} The variance settles for every step size below 1.23457.",
        ),
    ],
)
def test_bounds(changes: dict[str, Any], sentence: str) -> None:
    assert given(fixed_point_error=None, **changes).explain().endswith(f". {sentence}")


NEAR = "The equations for the fixed point are nearly singular (σ_min/σ_max = 1.0e-04): a small change of the data may"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "The fixed point is 0.5 (RMS) from the true values; the best weights are 0.25 from them."),
        ({"converges": False}, "The fixed point, which it does not reach, is 0.5 (RMS) from"),
        ({"regions": (HELD,)}, "The fixed point is 0.5"),
        ({"distance_to_singularity": 1e-4}, NEAR),
        ({"fixed_point_error": 9e-10, "best_error": 1.1e-9}, "is 0 (RMS) from the true values; the best weights are 1"),
        ({"fixed_point_error": 1.9e-9, "best_error": 2.1e-9, "scale": 2.0}, "is 0 (RMS) from the true"),
        ({"fixed_point_error": 1.9e-9, "best_error": 2.1e-9, "scale": 2.0}, "the best weights are 2.1e-09 from"),
    ],
)  # fmt: skip
def test_the_fixed_point(changes: dict[str, Any], said: str) -> None:
    assert said in given(**changes).explain()


@pytest.mark.parametrize(
    "changes",
    [
        {"fixed_point_error": None},
        {"best_error": None},
        {"regions": (LOOSE,), "verdict": "diverges"},  # where it rests, and only there
    ],
)
def test_no_fixed_point_is_named_where_none_is_known(changes: dict[str, Any]) -> None:
    assert "(RMS)" not in given(**changes).explain()


def test_equations_are_called_nearly_singular_only_where_they_are() -> None:
    for distance, sampling, said in (
        (0.0, "expected", 0),
        (9e-4, "expected", 1),
        (1e-3, "expected", 0),
        (1e-4, "iid", 0),
    ):
        text = given(distance_to_singularity=distance, sampling=sampling).explain()
        assert ("nearly singular" in text) == said
    assert given().rounded(None) is None and given().rounded(1e-9) == 1e-9


@pytest.mark.parametrize(
    ("regions", "changes", "sentence"),
    [
        ([HELD], {}, "The run stays in the first piece and settles there."),
        ([LOOSE, HELD], {}, "The run went through 2 pieces and settles in the last one."),
        ([LOOSE] * 63, {}, "The run went through 63 pieces and settles in the last one."),
        ([LOOSE] * 64, {}, "The run went through 64 or more pieces and settles in the last one."),
        ([LOOSE], {"verdict": "diverges"}, "The run grows without ever leaving its first piece."),
        ([LOOSE] * 2, {"verdict": "diverges"}, "The run went through 2 pieces and grows all the same."),
        (
            [LOOSE],
            {"verdict": "diverges", "fixed_point": np.ones(1)},
            "The run rests where it starts, but only there: from weights a little beside it, it grows.",
        ),
        (
            [LOOSE],
            {"verdict": "neutral"},
            "After 1 piece the run still creeps in one direction, too slowly to tell where it leads.",
        ),
        (
            [LOOSE] * 3,
            {"verdict": "neutral"},
            "After 3 pieces the run still creeps in one direction, too slowly to tell where it leads.",
        ),
    ],
)
def test_pieces_of_a_run(regions: list[Region], changes: dict[str, Any], sentence: str) -> None:
    changes = {"step_size_bound": None, "fixed_point_error": None, "fixed_point": None, **changes}
    text = given(regions=tuple(regions), **changes).explain()
    assert text.endswith(f". {sentence}")
    assert (SHRINKS in text) == (changes.get("verdict") != "neutral")  # of a run that creeps there is no rate to tell


def test_a_run_that_chatters_counts_the_pieces_that_hold_their_point_and_shrink() -> None:
    grown = Region(1.0, np.ones(1), True)
    for regions, holds in (
        ((LOOSE, grown), "none of them contains"),
        ((LOOSE, HELD, HELD, grown), "only 2 of them contain"),
    ):
        text = given(regions=regions, verdict="chatters", step_size_bound=None, fixed_point_error=None).explain()
        assert text == (
            "TD(0) on toy with α = 0.1 chatters: it neither settles nor grows. "
            f"The run went through {len(regions)} pieces (greedy policies), and {holds} the point that it would settle "
            "at: each pulls the weights over the border into another, and they slide along it."
        )


def test_a_local_diagnosis_says_so_last() -> None:
    assert given(local=True).explain() == given().explain() + (
        " The values are not linear in the weights, so this holds only near the initial weights; recompute it along "
        "training."
    )


def test_what_is_not_finite_is_left_out_of_the_plain_record() -> None:
    found = given(eigenvalues=np.array([0.9 + 0j, complex(np.inf, 0.0)]), step_size_bound=math.inf).plain()
    assert found["eigenvalues"] == [[0.9, 0.0]] and found["step_size_bound"] is None
    assert found["explanation"].startswith("TD(0) on toy") and found["verdict"] == "converges"
    assert (found["drift"], found["updates"], found["local"]) == (0.0, 1, False)
