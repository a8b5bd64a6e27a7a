"""Numbers of Baird's star and others that no other test holds, to rtol 1e-6.

Every one was computed by plain NumPy from the star's matrices (A = XᵀD(I − γP)X and its kin, powers of them, and the
49·7 × 49·7 Kronecker operator of the chain), without a line of the package.

Two differ from figures in circulation: the chain's step-size limit at η = .5 is .144196, not .144191, and GTD2's RMSPBE
after 1,000 sweeps .00737827, not .00737828.

Mutants that die here: RMSPBE without its square root; β of TDRC squared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import method
from neuralq.lab.methods.emphatic import follow_on
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import critical, scan, stability_margin
from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.hall import hall
from neuralq_envs.counterexamples.w2w import w2w_single


@pytest.mark.parametrize(
    ("name", "step_size", "num_steps", "options", "rmsve", "rmspbe"),
    [
        ("residual", 0.01, 1000, {}, 1.93501377294419, 0.00737680779651927),
        ("residual", 0.01, 100_000, {}, 1.89005949656867, 0.00720542966035873),
        ("gtd2", 0.005, 1000, {}, 1.93528139137362, 0.00737826903556833),
        ("gtd2", 0.005, 20_000, {}, 1.93089539500301, 0.00736110742728644),
        ("tdc", 0.005, 1000, {}, 1.93546453666216, 0.00737855976473592),
        ("tdc", 0.005, 20_000, {}, 1.93111227648406, 0.00736193421872804),
        ("gtd", 0.005, 1000, {}, 1.94776685648621, 0.00827898425502738),
        ("tdrc", 0.015625, 1000, {}, 5.67356559752994, 0.0219111813350934),
        ("tdrc", 0.015625, 20_000, {}, 4.40776547082221, 0.0170226883594142),
    ],
)
def test_errors_of_the_slow_cures(
    name: str, step_size: float, num_steps: int, options: dict[str, float], rmsve: float, rmspbe: float
) -> None:
    found = run(star(), name, num_steps, step_size, options=options)
    assert found.rmsve[-1, 0] == pytest.approx(rmsve, rel=1e-6)
    assert found.rmspbe[-1, 0] == pytest.approx(rmspbe, rel=1e-6)


def test_slowest_modes_of_the_cures() -> None:
    assert diagnose(star(), "residual").rates.real.min() == pytest.approx(2.37435687492e-5, rel=1e-6)
    assert diagnose(star(), "tdrc", 0.015625).spectral_radius == pytest.approx(0.999986713251, rel=1e-9)
    assert diagnose(star(), "htd", 0.00390625).verdict == "diverges"
    assert diagnose(star(), "htd", 0.00390625).spectral_radius == pytest.approx(1.000467294482219, rel=1e-9)
    # solid keeps the chain below: each upper state is followed once, the lower one by 1/(1 − γ) times all the rest
    np.testing.assert_allclose(follow_on(linear_process(star())), [1 / 7] * 6 + [694 / 7], rtol=1e-9)
    second = diagnose(star(), "etd", sampling="markov").second_moment_radius
    assert second == pytest.approx(6.8607, rel=1e-12)  # γ² ρ² μ = .9801 · 49/7


def test_step_size_limits_with_a_penalty() -> None:
    for eta, bound in ((0.25, 56 / 23), (0.5, 28 / 15), (1.0, 14 / 11), (2.0, 7 / 9)):  # 2 / (η + 4/7)
        assert diagnose(star(), eta=eta).step_size_bound == pytest.approx(bound, rel=1e-9)
    # radius of the whole Kronecker operator: .99999973 at .144196, 1.00000470 at .1442
    found = diagnose(star(), sampling="markov", eta=0.5).step_size_bound_second_moment
    assert found == pytest.approx(0.144196218085, rel=1e-6)
    found = diagnose(star(), sampling="iid", eta=0.5).step_size_bound_second_moment
    assert found == pytest.approx(0.129883166422, rel=1e-6)


def test_thresholds_of_the_star() -> None:
    assert critical(star(), "lambda_") == pytest.approx(61 / 66, rel=1e-9)
    assert critical(star(), "phi") == pytest.approx(0.10473001974418, rel=1e-6)
    assert critical(star(), "tau", step_size=0.01) == pytest.approx(0.020194070630632, rel=1e-6)
    assert critical(star(), "period", step_size=0.01) == 77
    assert diagnose(star(), "fitted").spectral_radius == pytest.approx(0.99, rel=1e-9)  # X has full row rank
    (edge,) = scan(star(), "beta_over_alpha").boundaries
    assert 0.1 < edge < 0.316  # −.0388 and +2.38e-5 at those two


def test_any_step_size_diverges_on_the_star() -> None:
    for alpha in (1e-4, 1e-3, 1e-2, 0.1, 1.0):
        assert diagnose(star(), step_size=alpha).spectral_radius == pytest.approx(1 + 0.239250464202 * alpha, rel=1e-9)


def test_tdrc_is_not_stable_for_every_beta() -> None:
    """Least real part of [[A, B], [A, C + βI]] on what moves: stable, unstable, stable and unstable again."""
    expected = {
        0.0: 2.37731521779e-5, 0.05: -2.03917516489e-5, 0.1: -3.69918414834e-5, 0.5: 2.21832575728e-4,
        1.0: 8.50351930252e-4, 10.0: 5.15746804151e-2, 20.0: -3.31063358412e-2, 50.0: -0.144064504435,
    }  # fmt: skip
    for beta, least in expected.items():
        assert stability_margin(star(), method("tdrc"), beta=beta) == pytest.approx(least, rel=1e-6)


def test_the_single_transition_of_w_to_2w() -> None:
    """W grows by 1 + α (2γ − 1) in every update: 1.098 at α = .1, γ = .99."""
    assert diagnose(replace(w2w_single(0.99), step_size=0.1)).spectral_radius == pytest.approx(1.098, rel=1e-12)
    assert diagnose(w2w_single(0.499)).converges and diagnose(w2w_single(0.501)).verdict == "diverges"


def test_residual_gradients_on_the_hall_slow_down_with_the_square_of_its_length() -> None:
    conditions = []
    for n in (12, 24):
        found = diagnose(hall(n, 1.0), "residual", step_size=0.1)
        rates = np.sort(found.rates.real)
        conditions.append(rates[-1] / rates[0])
    assert conditions == pytest.approx([249.7, 969.4], abs=0.05)
    assert 2 * 1.7 < conditions[1] / conditions[0] < 2 * 2.3
