"""What to try next: near the preset first, then where the tree-structured Parzen estimator expects most.

Nothing is known of a space at first, but something of a preset: so the first trials keep about two thirds of its
options. From then on Optuna is asked, anew for every trial, with all results that the trial may know and a seed of its
own: the same results give the same choice.

Source: Bergstra, Bardenet, Bengio & Kégl 2011, "Algorithms for hyper-parameter optimization"; Watanabe 2023,
"Tree-structured Parzen estimator: understanding its algorithm components" (the multivariate one).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.checks import MissingExtra
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.tune.space import Drawn, Space
from neuralq.runs.tune.study import Study

if TYPE_CHECKING:
    from optuna.study import Study as OptunaStudy

__all__ = ["choose", "importances", "load_optuna"]

_NEAR = 8
"""Trials that keep most of the preset."""
_KEPT = 2 / 3
_MOST_WORK = 4.0
"""Gradient steps of a trial, in those of the preset."""
_TRIES = 50
_FEWEST_FOR_IMPORTANCE = 10
_AT_THE_TOP = 5
"""Trials that importance is judged by, as its authors advise."""


@dataclass(frozen=True)
class _Kept:
    """Values of the preset, now and then another."""

    told: Mapping[str, Any]
    drawn: Drawn

    def _keeps(self, name: str) -> bool:
        return bool(self.drawn.rng.random() < _KEPT) and name in self.told

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = False) -> float:
        other = self.drawn.suggest_float(name, low, high, log=log)
        return float(self.told[name]) if self._keeps(name) else other

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> int:
        other = self.drawn.suggest_int(name, low, high, log=log)
        return int(self.told[name]) if self._keeps(name) else other

    def suggest_categorical(self, name: str, choices: Sequence[str]) -> Any:
        other = self.drawn.suggest_categorical(name, choices)
        return self.told[name] if self._keeps(name) else other


def load_optuna() -> Any:
    """The package Optuna, quiet.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        import optuna
    except ImportError as error:
        raise MissingExtra(f'tuning needs Optuna ({error}); install it with: pip install "neuralq[tune]"') from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def choose(study: Study) -> dict[str, Any] | None:
    """The options of the next trial; None where nothing was found that was not tried before.

    The next trial must be one that `Study.may_begin_another` allows. What no run can be made with, and what takes over
    four times the preset's gradient steps, is not tried.

    Raises:
        ValueError: no configuration of the space is possible.
        MissingExtra: Optuna is needed and not installed.
    """
    number = len(study.trials)
    tried = [trial.config for trial in study.trials]
    most, reason, is_possible = _MOST_WORK * _work(study.start.config({})), "", False
    for attempt in range(_TRIES):
        chosen = _suggested(study, number, attempt)
        try:
            config = study.start.config(chosen)
        except ValueError as error:
            reason = str(error)
            continue
        if _work(config) > most:
            reason = reason or f"it takes over {_MOST_WORK:g} times the preset's gradient steps"
            continue
        is_possible = True
        if study.start.plain_config(chosen) not in tried:
            return chosen
    if not is_possible:
        raise ValueError(f"of {_TRIES} configurations of the space none is possible: {reason}; mend space.yaml")
    return None


def _work(config: RunConfig) -> float:
    return config.total_steps * config.kind.updates_per_step(config.settings)


def _suggested(study: Study, number: int, attempt: int) -> dict[str, Any]:
    seed = [study.seed, number, attempt]
    if len(study.known(number)) < _NEAR:
        preset = study.start.values([option.name for option in study.space.options])
        return study.space.asked_of(_Kept(study.space.told(preset), Drawn(np.random.default_rng(seed))))
    optuna = load_optuna()
    sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence(seed).generate_state(1)[0]), n_startup_trials=1
    )
    return study.space.asked_of(_rebuilt(study, number, sampler).ask())


def _rebuilt(study: Study, number: int, sampler: Any = None) -> OptunaStudy:
    """Optuna's study of what a trial may know."""
    optuna = load_optuna()
    found: OptunaStudy = optuna.create_study(direction="maximize", sampler=sampler)
    every = _distributions(optuna, study.space)
    start = study.start.values([option.name for option in study.space.options])
    for trial in study.known(number):
        standing = study.standing(trial.number)
        params = study.space.told(trial.chosen or start)
        if standing.estimate is not None and standing.is_settled:
            mine = {name: every[name] for name in params}
            value = standing.estimate.iqm
            found.add_trial(optuna.trial.create_trial(params=params, distributions=mine, value=value))
    return found


def _distributions(optuna: Any, space: Space) -> dict[str, Any]:
    """What each name of the space means to Optuna."""
    found: dict[str, Any] = {}
    kinds = optuna.distributions
    for option in space.options:
        if option.values or option.beside:
            found[option.shown if option.values else option.which] = kinds.CategoricalDistribution(option.texts)
        if option.whole:
            found[option.shown] = kinds.IntDistribution(int(option.low), int(option.high), log=option.log)
        elif not option.values:
            found[option.shown] = kinds.FloatDistribution(option.low, option.high, log=option.log)
    return found


def importances(study: Study) -> dict[str, float]:
    """Which share of what sets the best trials apart each option has; empty where there are too few trials.

    Source: Watanabe, Bansal & Hutter 2023, "PED-ANOVA: efficiently quantifying hyperparameter importance in arbitrary
    subspaces".
    """
    optuna = load_optuna()
    found = _rebuilt(study, len(study.trials) + study.at_once)
    if len(found.trials) < _FEWEST_FOR_IMPORTANCE:
        return {}
    share = min(max(0.1, _AT_THE_TOP / len(found.trials)), 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it warns of, few trials with a condition, the page says itself
        evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=share)
        shares = optuna.importance.get_param_importances(found, evaluator=evaluator)
    of_options = {o.shown: shares.get(o.shown, 0.0) + shares.get(o.which, 0.0) for o in study.space.options}
    return dict(sorted(of_options.items(), key=lambda item: -item[1]))
