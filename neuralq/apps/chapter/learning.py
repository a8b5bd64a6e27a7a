"""Table 13.1: Q-learning in a deterministic world, with what the text proves about it measured; and how to explore."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.apps.chapter.figures import SIGNS
from neuralq.apps.chapter.ordering import part_of
from neuralq.apps.pages.grids import q_grid
from neuralq.exact import solve
from neuralq.rules import k_to_the_q
from neuralq.runs.report.claims import ChapterPage, Chart, Row, Series, claim, misprint, number, own, spread
from neuralq.tabular import Band, Learned, RunOptions, apply, compile_model, over_seeds, q_learning, sweep_errors
from neuralq.tabular.results import Experience
from neuralq_envs import mitchell

__all__ = ["table_13_1"]

_NUM_STEPS = 500


def table_13_1(num_seeds: int = 20) -> ChapterPage:
    """Table 13.1: the deterministic rule never overestimates, never takes back, and finds Q exactly.

    Args:
        num_seeds: independent runs.

    Source: Mitchell 1997, Table 13.1, sections 13.3.3 to 13.3.5, theorem 13.1.

    Example:
        >>> table_13_1(num_seeds=2).reproduced
        True
    """
    mdp, gamma = mitchell.mdp(), mitchell.GAMMA
    exact_q = solve(mdp, gamma).q
    options = RunOptions(record_every=1, exact_q=exact_q, record_experience=True)
    model = compile_model(mdp)

    def learn(seed: np.random.SeedSequence) -> Learned:
        return q_learning(
            model, _NUM_STEPS, gamma, policy="random", step_size="deterministic", seed=seed, options=options
        )

    band = over_seeds(learn, num_seeds)
    nothing = np.where(mdp.legal, 0.0, np.nan)
    low, middle, high = band.interval()
    curve = Series(f"{num_seeds} seeds", band.steps, middle, low, high)
    chart = Chart("largest error of the table", "updates", "max |Q̂ − Q|", (curve,))
    early = apply(nothing, _first_episodes(band.runs[0], 3), step_size="deterministic").q
    drawings = (
        q_grid("Q̂ of one run after three episodes", SIGNS, 3, early),
        q_grid("Q̂ at the end", SIGNS, 3, band.q[0]),
        chart,
    )
    text = (
        "The agent knows nothing and walks at random; when it enters G it starts again somewhere else. After each move "
        "one entry of the table becomes the reward plus 0.9 times the best entry of the cell it came to. The next move "
        "is chosen after that update.",
        "At first only moves into G learn anything. From then on the value of 100 spreads backwards, one cell each "
        "time that a cell beside a known one is left. Because no reward is negative and the table starts at 0, entries "
        "can only grow, and never beyond the truth. Whenever every entry has been updated once more, the largest error "
        "has shrunk by the factor 0.9 or better.",
        "To explore, choose an action with probability in proportion to k raised to the power Q̂. Some printings lose "
        "the exponent and show k times Q̂: then k cancels out of the fraction and has no effect at all.",
    )
    rows = (*_facts(band, nothing, exact_q), *_exploration())
    return ChapterPage("table-13.1", "Q-learning in a deterministic world", "13.3", text, rows, drawings)


def _facts(band: Band, nothing: NDArray[np.float64], exact_q: NDArray[np.float64]) -> tuple[Row, ...]:
    """The two invariants, the theorem's contraction, and the answer itself."""
    curves = [run.curve for run in band.runs if run.curve is not None]
    fall = max(float(curve.decrease.max()) for curve in curves)
    excess = max(float(curve.excess.max()) for curve in curves)
    lowest = min(float(curve.lowest.min()) for curve in curves)
    ratios = [sweep_errors(nothing, run.experience, exact_q).ratios for run in band.runs if run.experience is not None]
    worst = max(float(ratio.max()) for ratio in ratios)
    final = max(float(curve.distance[-1]) for curve in curves)
    until = [int(curve.steps[np.argmax(curve.distance < 1e-9)]) for curve in curves]
    return (
        claim("largest fall of an entry", "0", fall, fall == 0, "entries never decrease"),
        claim("largest Q̂ − Q", "at most 0", excess, excess <= 1e-12, "never above the truth"),
        claim("smallest Q̂", "at least 0", lowest, lowest >= 0),
        claim("error after each full round, divided by the error before", "at most 0.9", worst, worst <= 0.9 + 1e-12),
        number(f"largest error after {_NUM_STEPS} updates, all seeds", 0.0, final),
        own("updates until the table is exact: median [95% of seeds]", spread(until)),
    )


def _exploration() -> tuple[Row, ...]:
    """The probability of the best of three actions worth 1, 2 and 3."""
    q = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    ours = {k: float(k_to_the_q(q, k)[2]) for k in (0.5, 1.0, 2.0)}
    flat = {k: 3 * k / (1 * k + 2 * k + 3 * k) for k in ours}
    constant = max(flat.values()) - min(flat.values()) < 1e-12
    note = "2³ / (2¹ + 2² + 2³) = 4/7; without the exponent it is 1/2 for every k"
    return (
        claim(
            "spread of P(best) over k, if P were k·Q / Σ k·Q", "0", max(flat.values()) - min(flat.values()), constant
        ),
        misprint("P(best of 1, 2, 3), k = 2", 0.5, 4 / 7, ours[2.0], note),
        number("P(best of 1, 2, 3), k = 1", 1 / 3, ours[1.0], note="uniform"),
        number("P(best of 1, 2, 3), k = 1/2", 1 / 7, ours[0.5], note="prefers low values"),
    )


def _first_episodes(run: Learned, count: int) -> Experience:
    e = run.experience
    assert e is not None
    return part_of(e, slice(int(np.flatnonzero(e.last_t)[count - 1]) + 1))
