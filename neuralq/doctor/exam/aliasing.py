"""E6: does the past tell more about what comes next than the present observation does? See `neuralq.doctor.hidden`."""

from __future__ import annotations

from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.findings import Finding
from neuralq.doctor.hidden import THRESHOLD, gain_of_the_past, lambda_discrepancy

__all__ = ["aliasing"]


def aliasing(case: Case) -> Finding:
    """E6: the gain of the step before, over all that was played, and how far TD(0) and Monte Carlo are apart."""
    try:
        found = gain_of_the_past(case.world, (*case.explored, *case.chance, *case.greedy[:20]), case.rng)
    except ValueError as error:
        raise CannotMeasure(str(error)) from error
    what = "the reward" if found.entry is None else f"entry {found.entry} of the next observation"
    said = (
        f"the step before tells {100 * max(found.gain, 0):.0f} % more of the variance of {what} than the observation "
        f"alone: {'something' if found.hides else 'nothing'} that matters is hidden"
    )
    apart = lambda_discrepancy(case.world, case.chance, case.gamma, case.rng)
    if apart is not None:
        said += f"; TD(0) and Monte Carlo differ by {100 * apart:.2g} % of the spread of returns of random play"
    return Finding(
        "E6", "observations hide part of the state", "environment", "B", found.gain, (found.low, found.high), THRESHOLD,
        "our own, of CartPole, Acrobot and MountainCar with and without velocities", found.hides, said,
        "give the agent what is hidden: velocities, or the last observations stacked (FrameStackObservation); or a "
        "network that remembers (body='gru')",
        "env = gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FrameStackObservation(env, 2))  # and train "
        "again",
    )  # fmt: skip
