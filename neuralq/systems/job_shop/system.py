"""Job-shop scheduling by repair as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.job_shop.oracle import oracle
from neuralq.systems.job_shop.pictures import film, gantt_picture, learning_picture, quality_picture
from neuralq.systems.job_shop.trials import Repaired, Settings, Training, list_schedule, repair, train
from neuralq_envs.job_shop.problem import JobShop, random_job_shop

__all__ = ["JOB_SHOP", "Outcome", "problems_of"]

LEARNED, SHORT, SHUFFLED = "TD(λ)", "TD, λ = 0.7", "TD, shuffled final reward"
GREEDY, IRV, AGAIN = "least TRUI", "IR-V", "IR-V, the best of 200"
RANDOM, LIST = "random", "list scheduler"
_RESTARTS, _AGAIN_PROBLEMS = 200, 30
_FULL_EPISODES = 10_000
_NUM_TRAINING, _NUM_VALIDATION, _NUM_SMALL, _NUM_BIG = 100, 50, 200, 60
_HELD_OUT = 13_5


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one contender made of the held-out problems.

    Args:
        small: those of 51 tasks.
        big: those of 164 tasks; empty where it was not tried on them.
        training: if it learned.
        num_repairs: in all, restarts counted, for those of 51 tasks.
    """

    small: Sequence[Repaired]
    big: Sequence[Repaired]
    training: Training | None = None
    num_repairs: int = 0


@cache
def problems_of(num: int, seed: int, num_missions: int = 3, num_tasks: int = 17) -> tuple[JobShop, ...]:
    """So many problems, the same for everybody who asks.

    Example:
        >>> problems_of(1, 0)[0] is problems_of(1, 0)[0]
        True
    """
    rng = np.random.default_rng(seed)
    return tuple(random_job_shop(rng, num_missions, num_tasks) for _ in range(num))


def _small() -> tuple[JobShop, ...]:
    return problems_of(_NUM_SMALL, _HELD_OUT)


def _big() -> tuple[JobShop, ...]:
    return problems_of(_NUM_BIG, _HELD_OUT, 4, 41)


def _learner(lambda_: float, shuffled: bool = False) -> Callable[[np.random.SeedSequence, bool], Outcome]:
    def contend(seed: np.random.SeedSequence, full: bool) -> Outcome:
        drawn, learned = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key).spawn(2)
        rng = np.random.default_rng(drawn)
        shops = [random_job_shop(rng) for _ in range(_NUM_TRAINING + (0 if shuffled else _NUM_VALIDATION))]
        settings = Settings(lambda_=lambda_, shuffled=shuffled, **({"num_episodes": _FULL_EPISODES} if full else {}))
        training = train(learned, shops[:_NUM_TRAINING], shops[_NUM_TRAINING:], settings)
        small, big = (repair(problems, "learned", training.network) for problems in (_small(), _big()))
        return Outcome(small, big, training, sum(len(one.repairs) for one in small))

    return contend


@cache
def _looked_ahead() -> Outcome:
    """The look-ahead draws nothing, so that it is the same with every seed."""
    small, big = (repair(problems, "least TRUI") for problems in (_small(), _big()))
    return Outcome(small, big, None, sum(len(one.repairs) for one in small))


@cache
def _listed() -> Outcome:
    """And so is the list scheduler."""
    return Outcome([list_schedule(one) for one in _small()], [list_schedule(one) for one in _big()])


def _repairer(chooser: str) -> Callable[[np.random.SeedSequence, bool], Outcome]:
    def contend(seed: np.random.SeedSequence, full: bool) -> Outcome:
        small, big = (repair(problems, chooser, seed=seed) for problems in (_small(), _big()))
        return Outcome(small, big, None, sum(len(one.repairs) for one in small))

    return contend


def _restarted(seed: np.random.SeedSequence, full: bool) -> Outcome:
    problems, best, total = _small()[:_AGAIN_PROBLEMS], [], 0
    for problem in problems:
        tried = repair([problem] * _RESTARTS, "IR-V", seed=seed)
        best.append(min(tried, key=lambda one: one.rdf if one.solved else np.inf))
        total += sum(len(one.repairs) for one in tried)
    return Outcome(best, (), None, total)


def _rdf(repaired: Sequence[Repaired]) -> float:
    return float(np.mean([one.rdf for one in repaired]))


def _num_repairs(repaired: Sequence[Repaired]) -> float:
    return float(np.mean([len(one.repairs) for one in repaired]))


def _means(outcomes: Sequence[Sequence[Repaired]]) -> tuple[float, float]:
    """Mean repairs and mean RDF over seeds and problems."""
    every = [one for outcome in outcomes for one in outcome]
    return _num_repairs(every), _rdf(every)


def _page(found: Mapping[str, tuple[Outcome, ...]], full: bool) -> ChapterPage:
    measured = _measured(found)
    shown, network = _small()[0], found[LEARNED][0].training
    assert network is not None
    repaired = found[LEARNED][0].small[0]
    trainings = {name: [one.training for one in found[name] if one.training is not None] for name in (LEARNED, SHORT)}
    tried = {name: outcomes for name, outcomes in found.items() if name != AGAIN}
    sets = {
        f"{size} tasks": {
            name: _means([one.big if size == "164" else one.small for one in all_]) for name, all_ in tried.items()
        }
        for size in ("51", "164")
    }
    return ChapterPage(
        "job-shop",
        "A schedule that is repaired",
        "13.8",
        _text(measured, found),
        (_against_irv(found), *_ours(measured, found)),
        (film(shown, repaired), gantt_picture(shown, repaired), quality_picture(sets), learning_picture(trainings)),
        source="Zhang & Dietterich 1995",
        measured=tuple(measured.values()),
        facts={
            "problems": f"{_NUM_TRAINING} to learn from and {_NUM_VALIDATION} to choose a network by, of 51 tasks, "
            "drawn "
            f"for each seed; held out: {_NUM_SMALL} of 51 tasks, {_NUM_BIG} of 164, the same for all",
            "actions": "every repair of the first conflict, about six; another set in every state",
            "what is seen": "fourteen numbers of the schedule that a repair leads to",
            "constants": _constants(full),
        },
    )


def _constants(full: bool) -> str:
    settings = Settings()
    episodes = _FULL_EPISODES if full else settings.num_episodes
    return (
        f"{episodes:,} episodes, 20 sigmoid units, λ = {settings.lambda_:g}, α {settings.first_step_size:g} to "
        f"{settings.last_step_size:g}, ε from {settings.first_epsilon:g}, a best episode again after every "
        f"{settings.replay_period}; a repair costs .001, and {settings.step_cost:g} while learning"
    )


def _measured(found: Mapping[str, tuple[Outcome, ...]]) -> dict[str, Measured]:
    measured = {}
    for name, outcomes in found.items():
        what = name if name != AGAIN else f"{name} ({_AGAIN_PROBLEMS} problems)"
        measured[f"{name} rdf"] = Measured(f"{what}: RDF, 51 tasks", tuple(_rdf(one.small) for one in outcomes))
        repairs = tuple(_num_repairs(one.small) for one in outcomes)
        measured[f"{name} repairs"] = Measured(f"{what}: repairs, 51 tasks", repairs)
        if outcomes[0].big:
            measured[f"{name} big rdf"] = Measured(f"{name}: RDF, 164 tasks", tuple(_rdf(one.big) for one in outcomes))
            repairs = tuple(_num_repairs(one.big) for one in outcomes)
            measured[f"{name} big repairs"] = Measured(f"{name}: repairs, 164 tasks", repairs)
    for kind in ("rdf", "repairs", "big rdf", "big repairs"):
        for name in (GREEDY, IRV):
            ratios = np.divide(measured[f"{LEARNED} {kind}"].values, measured[f"{name} {kind}"].values)
            size = "164 tasks" if kind.startswith("big") else "51 tasks"
            what = f"{LEARNED} by {name}: {'RDF' if kind.endswith('rdf') else 'repairs'}, {size}"
            measured[f"{kind} by {name}"] = Measured(what, tuple(ratios.tolist()))
    return measured


def _text(measured: Mapping[str, Measured], found: Mapping[str, tuple[Outcome, ...]]) -> tuple[str, ...]:
    quality, work = measured[f"rdf by {GREEDY}"], measured[f"repairs by {GREEDY}"]
    bound = [one.bound for one in _small()]
    shares = {
        name: float(np.mean([np.divide([each.length for each in one.small], bound).mean() for one in found[name]]))
        for name in (LEARNED, LIST)
    }
    return (
        f"Schedules that are repaired by what was learned come to an RDF of {measured[f'{LEARNED} rdf'].median:.3f}, "
        f"{100 * (1 - quality.median):.1f} % below that of looking one repair ahead for the least TRUI, with "
        f"{100 * (1 - work.median):.0f} % fewer repairs; by random repairs (IR-V) they come to "
        f"{measured[f'{IRV} rdf'].median:.2f}. Learned on 51 tasks, it repairs 164 with "
        f"{measured[f'big rdf by {GREEDY}'].median:.3f} times the RDF of the look-ahead.",
        "Zhang and Dietterich schedule the payload of space shuttles: start with a schedule that ignores what it "
        "lacks, "
        "and repair it. Every state has another set of repairs, so there is no value for each action of a fixed list. "
        "But what a repair makes of the schedule is known, and only what later repairs will cost is not: V of the "
        "schedule that each one leads to is enough to compare however many there are.",
        "RDF is the length of the schedule in units of what the first one, with all that it lacks, asks of the "
        "resources; "
        "TRUI is what a schedule asks. A schedule is rewarded once, at its end, by −RDF. When every training is told "
        "the "
        f"final reward of another episode, nothing is learned: {measured[f'{SHUFFLED} rdf'].median:.2f}.",
        "Repair is not the best way to such schedules. A list scheduler, which starts whatever fits and has the "
        "longest "
        f"way to the end, is {shares[LIST]:.2f} times as long as the bound below every schedule, what was learned "
        f"{shares[LEARNED]:.2f} times. It plans from nothing; repair changes a plan that people have begun to follow.",
    )


def _against_irv(found: Mapping[str, tuple[Outcome, ...]]) -> Row:
    as_good, factor = [], []
    for learned, again in zip(found[LEARNED], found[AGAIN], strict=True):
        first = learned.small[: len(again.small)]
        as_good.append(sum(one.rdf <= _rdf(first) for one in again.small))
        factor.append(again.num_repairs / sum(len(one.repairs) for one in first))
    few = float(np.median(as_good))
    return published(
        "repairs for a schedule as good as the learned ones",
        "far fewer than iterative repair (IR-V)",
        f"with {np.median(factor):.0f} times the repairs, IR-V is as good on {few:g} of {_AGAIN_PROBLEMS}",
        few < _AGAIN_PROBLEMS / 2,
        f"the best of {_RESTARTS} restarts; median over seeds. A single IR-V needs fewer repairs, and stops at a bad "
        f"schedule",
    )


def _ours(measured: Mapping[str, Measured], found: Mapping[str, tuple[Outcome, ...]]) -> tuple[Row, ...]:
    rows = [own(f"{measured[key].what}, ratio", str(measured[key])) for key in measured if " by " in key]
    for name, outcomes in found.items():
        parts = [f"{measured[f'{name} repairs']} repairs"]
        if outcomes[0].big:
            parts.append(f"164 tasks: {measured[f'{name} big rdf']} with {measured[f'{name} big repairs']}")
        rows.append(own(measured[f"{name} rdf"].what, str(measured[f"{name} rdf"]), "; ".join(parts)))
    unsolved = sum(
        not each.solved for outcomes in found.values() for one in outcomes for each in (*one.small, *one.big)
    )
    return (*rows, own("held-out problems left with a conflict, of all contenders", unsolved))


JOB_SHOP = System(
    name="job-shop",
    environment="neuralq/JobShop-v0",
    learner="neuralq.learners:learn_afterstates",
    contenders={
        LEARNED: _learner(Settings().lambda_),
        SHORT: _learner(0.7),
        SHUFFLED: _learner(Settings().lambda_, shuffled=True),
        GREEDY: lambda seed, full: _looked_ahead(),
        IRV: _repairer("IR-V"),
        AGAIN: _restarted,
        RANDOM: _repairer("random"),
        LIST: lambda seed, full: _listed(),
    },
    baselines=(GREEDY, IRV, AGAIN, RANDOM, LIST),
    oracle=oracle,
    page=_page,
    num_seeds=6,
    full_num_seeds=20,
)
