"""The examination: load, play, measure within the budget, decide."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from neuralq.checks import check_choice, check_discount, check_positive, check_whole
from neuralq.doctor.exam import aliasing, capacity, environment, exactly, hypotheses, network, seeds, stored, values
from neuralq.doctor.exam.case import CannotMeasure, Case, Measurement, begin
from neuralq.doctor.experiments import run_experiments
from neuralq.doctor.findings import Finding
from neuralq.doctor.loading import load_subject
from neuralq.doctor.play import Clock, EnvironmentRaised
from neuralq.doctor.report import Report
from neuralq.doctor.subject import Settings, Subject, with_settings
from neuralq.doctor.tree import decide
from neuralq.doctor.weights import CannotLoad, plain_bytes, read_arrays
from neuralq.doctor.worlds import World, open_world
from neuralq.runs.offline.files import read_recorded
from neuralq.runs.offline.recorded import recorded_from
from neuralq.types import Array

__all__ = ["LEVELS", "NUM_PARTS", "examine"]

LEVELS = ("exam", "experiments")

_GAMMA = 0.99
"""Where neither the caller nor the file says."""

_MEASUREMENTS: dict[str, Measurement] = {
    "V1": values.has_learned,
    "X5": seeds.luck,
    "V4": values.soft_divergence,
    "V5": values.reach,
    "V2": values.bias,
    "V7": exactly.regret,
    "V7a": exactly.against_optimum,
    "V3": hypotheses.hypotheses,
    "V3a": hypotheses.one_step,
    "E1": environment.contract,
    "E2": environment.determinism,
    "E3": environment.disguised_limit,
    "E4": environment.observation_scale,
    "E5": environment.reward_scale,
    "E6": aliasing.aliasing,
    "D1": stored.merged_ends,
    "D2": stored.reset_leak,
    "D3": stored.window,
    "D3a": stored.few_batches,
    "D4": stored.actions_taken,
    "D4a": stored.greedy_only,
    "D5": stored.rewards_seen,
    "R6": network.lag,
    "R6a": network.untouched,
    "R1": network.dormant,
    "R2": network.effective_rank,
    "R3": network.kernel,
    "R4": network.churn,
    "V6": values.rank,
    "V8": values.generalisation,
    "V6a": values.better_actions,
    "R7": capacity.capacity,
    "R5": network.plasticity,
}
NUM_PARTS = len(_MEASUREMENTS) + 2
"""Of an examination: the measurements, and twice episodes are played."""


def examine(
    subject: Any,
    env: Any = None,
    *,
    gamma: float | None = None,
    data: Any = None,
    settings: Mapping[str, Any] | None = None,
    net: str | None = None,
    level: Literal["exam", "experiments"] = "exam",
    seeds: int = 3,
    budget_s: float = 60.0,
    seed: int = 0,
    progress: Callable[[int, str], None] | None = None,
) -> Report:
    """Why a value function is bad: the environment, the algorithm, the representation, the data, or luck.

    Args:
        subject: as `load_subject` takes it: a neuralq run folder, a file of Stable-Baselines3, sb3-contrib, CleanRL or
            PyTorch, an `nn.Module`, or a function ``[N, *obs] -> [N, A]``.
        env: a Gymnasium id, "module:id", an environment, or a class or function that makes one; of a run folder its own
            by default.
        gamma: γ; by default what the file says, else 0.99.
        data: what was learned from: the path of an ``.npz``, "minari:ID" of a data set of Minari's (extra minari), or a
            mapping of the columns ``obs, action, reward, terminated, truncated, next_obs`` and perhaps ``age`` and
            ``action_mask``; or laid out as D4RL's. By default what a neuralq run keeps in its replay.
        settings: of the training, where the file does not say: fields of `Settings`, such as
            ``{"target_period_updates": 500, "updates": 50_000}``.
        net: "module:Class" of a network that a state dict belongs to.
        level: ``"exam"`` measures; ``"experiments"`` also trains, changing one thing at a time.
        seeds: runs of each kind that experiments compare.
        budget_s: seconds for all of it.
        seed: of every draw.
        progress: told how many of `NUM_PARTS` parts are through, and what comes next.

    Raises:
        CannotLoad: the subject cannot be rebuilt, or does not fit the environment.
        ValueError: the environment cannot be made, or an argument does not fit.

    Example:
        >>> import numpy as np
        >>> report = examine(lambda obs: np.zeros((len(obs), 2)), "CartPole-v1", budget_s=5)
        >>> report.healthy, next(one for one in report.findings if one.id == "V1").cause
        (False, 'algorithm')
    """
    check_choice("level", level, LEVELS)
    check_positive("budget_s", budget_s)
    check_whole("seed", seed, 0)
    check_whole("seeds", seeds, 2)
    clock = Clock(budget_s)
    loaded = load_subject(subject, net, None if isinstance(env, Mapping) else env)
    given = env if env is not None else loaded.env
    if given is None:
        raise ValueError("which environment the subject was trained in is not known; pass env (--env ID)")
    known = with_settings(loaded.settings, settings or {})
    discount = gamma if gamma is not None else known.gamma if known.gamma is not None else _GAMMA
    check_discount("gamma", discount)
    world = open_world(given)
    columns = _columns(data) or (loaded.replay() if loaded.replay is not None else None)
    _check_fits(loaded, world)
    say = _Teller(progress)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small batches: threads would only wait for each other
    try:
        return _examined(
            loaded, world, discount, known, columns, seed, clock, say, seeds if level == "experiments" else 0
        )
    finally:
        torch.set_num_threads(threads)


class _Teller:
    """Counts what is through."""

    def __init__(self, progress: Callable[[int, str], None] | None) -> None:
        self.progress, self.so_far = progress, 0

    def __call__(self, text: str) -> None:
        if self.progress is not None:
            self.progress(min(self.so_far, NUM_PARTS), text)
        self.so_far += 1


def _examined(
    subject: Subject, world: World, gamma: float, settings: Settings, columns: Mapping[str, Array] | None, seed: int,
    clock: Clock, say: _Teller, seeds: int,
) -> Report:  # fmt: skip
    try:
        case = begin(subject, world, gamma, settings, columns, seed, clock, say)
    except EnvironmentRaised as error:
        return _broken(subject, world, gamma, clock, str(error))
    measured, missing = _measured(case, say)
    findings, headline = decide(measured)
    drawn, why = _drawn(case), ""
    if seeds:
        tried = run_experiments(case, [one for one in findings if one.grade in "AB"], seeds, say)
        measured = [*measured, *tried.findings]
        missing = {name: why for name, why in missing.items() if name != "X5"} | tried.missing
        findings, headline = decide(measured)
        why = tried.why
        if tried.factorial is not None:
            drawn["factorial"] = tried.factorial
    return Report(
        subject.origin, world.name, gamma, headline, findings, tuple(measured), missing, clock.spent, drawn, why
    )


def _measured(case: Case, say: _Teller) -> tuple[list[Finding], dict[str, str]]:
    measured: list[Finding] = []
    missing: dict[str, str] = {}
    for name, measure in _MEASUREMENTS.items():
        say(f"measuring {name}")
        if case.clock.left <= 0:
            missing[name] = f"the budget of {case.clock.budget_s:g} s was spent; give more with --budget"
            continue
        try:
            found = measure(case)
            measured += [found] if isinstance(found, Finding) else found
        except CannotMeasure as reason:
            missing[name] = str(reason)
        except (RuntimeError, ValueError, np.linalg.LinAlgError, NotImplementedError) as error:
            missing[name] = (
                f"it failed: {type(error).__name__}: {str(error).splitlines()[0][:200] if str(error) else ''}"
            )
    return measured, missing


def _broken(subject: Subject, world: World, gamma: float, clock: Clock, what: str) -> Report:
    found = Finding(
        "E1", "the environment raises errors", "environment", "B", 1.0, None, 0.5, "any", True, what,
        "mend the environment first", f"python -c \"import gymnasium as gym; gym.make('{world.name}').reset(seed=0)\"",
    )  # fmt: skip
    missing = {name: "the environment raised an error" for name in _MEASUREMENTS if name != "E1"}
    findings, headline = decide([found])
    return Report(subject.origin, world.name, gamma, headline, findings, (found,), missing, clock.spent)


def _columns(data: Any) -> dict[str, Array] | None:
    if data is None:
        return None
    if isinstance(data, str) and data.startswith("minari:"):
        return stored.of_recorded(read_recorded(data))
    if isinstance(data, str | Path):
        data = read_arrays(plain_bytes(Path(data)), str(data))
    if isinstance(data, Mapping):
        if "observations" in data:
            return stored.of_recorded(recorded_from(data), data.get("action_mask"))
        return stored.check_columns(data)
    raise ValueError(f"data must be the path of an .npz or a mapping of columns, got {type(data).__name__}")


def _check_fits(subject: Subject, world: World) -> None:
    """One observation through the values before anything takes time.

    Raises:
        CannotLoad: they do not go together.
    """
    env = world.make()
    try:
        first = np.asarray(env.reset(seed=0)[0])
    except Exception:
        return  # said when it is played
    finally:
        env.close()
    try:
        shape = subject.values(np.stack([first, first])).shape
    except CannotLoad:
        raise
    except Exception as error:
        raise CannotLoad(
            f"the values cannot be computed for observations of {world.name}, of shape {list(first.shape)} and dtype "
            f"{first.dtype} ({str(error).splitlines()[0][:160] if str(error) else type(error).__name__}); name the "
            "environment it was trained in with --env, or export it with what prepares observations"
        ) from error
    if shape != (2, world.num_actions):
        raise CannotLoad(
            f"there are {shape[-1]} action values for an observation, and {world.name} has {world.num_actions} "
            f"actions; "
            "name the environment it was trained in with --env"
        )
    if subject.first_action not in (None, world.first_action):
        raise CannotLoad(
            f"the actions begin with {subject.first_action}, and those of {world.name} with {world.first_action}; name "
            "the environment it was trained in with --env"
        )


def _drawn(case: Case) -> dict[str, Array]:
    """Points for the page: Q and G of greedy steps, and Q at the start beside the return."""
    rng, pairs, starts = case.rng(99), [], []
    for one in case.greedy:
        returns = case.returns(one)
        if len(returns):
            q = one.values[np.arange(len(returns)), one.actions[: len(returns)]]
            pairs.append(np.column_stack([returns, q]))
            starts.append([one.score, one.legal_values[0].max(), returns[0]])
    if not pairs:
        return {}
    points = np.concatenate(pairs)
    drawn = {"pairs": points[rng.permutation(len(points))[:800]], "starts": np.array(starts)}
    with contextlib.suppress(CannotMeasure):
        drawn |= {f"with {name}": line for name, line in hypotheses.lines(case).items()}
    return drawn
