"""The contract of every method in METHODS: the mean of the sampled update is the expected update, to rounding.

The mean is exact. Every transition is enumerated from the arrays that made the problem, not from the library's chains:

    one sweep   options with which a method does not remember: all transitions with their chances, or all sequences of
                as many independent transitions as one expected update stands for, after a sweep of other transitions
                that must have left nothing behind.
    episodes    options with which it remembers (traces, follow-on, waiting returns): problems whose episodes end after
                four steps at most. There are finitely many histories, and the long-run mean change of a held θ is the
                mean sum over an episode divided by the mean length. Every history is run twice and counted the second
                time, so that what is left of an episode in the next one shows. Rows that wait see earlier updates of
                the same call, so it is the slope at α = 0 that is compared; the change is a polynomial in α, whose
                slope four step sizes give exactly.

Four methods are held another way (see HELD_ANOTHER_WAY), and three have no sampled update (WITHOUT_LEARNER): theirs is
held against least squares on the enumerated transitions. What both updates share cannot show here: the cut c(s, a) of
the traces of pairs, φ of the adaptive residual, the factor that projects onto a ball.

Mutants that must die here, in the expected update of

    TD         λ lost; η of the other sign; in its operator γ or D lost, the behaviour's chain, the behaviour's rewards
    residuals  φ lost, γ squared, D lost from b, one sample for two and two for one; ρ lost; an end that bootstraps;
               adaptive φ of the other sign, missing from c, without its margin, or with γ lost
    gradient   C for I and I for C; Aᵀ or the correction not transposed, or of the other sign; η lost from b or G; λ
               lost; β lost or outside η; HTD with A_μ not transposed, of the target, without λ, or swapped with A
    GTD2-MP    no halfway point, its second order twice, or missing from c
    GQ         γ lost, the least action, actions greedy in h
    ETD        d for m, f along P for Pᵀ, λ for 1 − λ, γ without λ in the trace, β ignored
    multistep  one step too many, γ lost from the return, D lost; error or trace not clipped, the bars swapped, K left
               out; γ lost from a trace; the target's chain in it; the cut of the pair left; each cut scaled
    targets    γ or α lost, the behaviour's chain or rewards, one update short, η of the other sign, τ for 1 − τ, H of
               the other sign, either ball ignored
    solvers    λ, γ or D lost, η doubled or of the other sign, A transposed, x for the residual, the target for the
               greedy policy
    control    γ lost, b of the other sign, its own visits for the behaviour's and the reverse, ε lost or shared among
               illegal actions, visits that do not start again

and: visits of pairs without the policy, the ratio of the pair left; a generator that is not that of the pieces; TD and
ETD that say they do not remember; traces or a follow-on that outlive an episode; an end where only the oldest row
learns; x' for x'' or no ratio in a sampled update; GTD2-MP sampled without the halfway point or from it; a new method
without samples, with an option that has no value to try, or with another's matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab import Method, Problem, method
from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods import METHODS, Expected, SampledUpdate
from neuralq.mdp import FiniteMDP

Floats = NDArray[np.float64]
Index = NDArray[np.int64]
Options = dict[str, float]

TRIED: dict[str, tuple[float, ...]] = {
    "lambda_": (0.0, 0.6, 1.0),
    "eta": (0.0, 0.2),
    "phi": (1.0, 0.3),
    "beta_over_alpha": (2.5,),
    "num_steps": (1, 2, 3),
    "rho_bar": (0.8, 9.0),
    "c_bar": (0.7, 9.0),
    "period": (1, 2, 3),
    "tau": (0.3,),
    "ball_w": (1.0, 100.0),
    "ball_u": (0.8, 200.0),
    "epsilon": (0.0, 0.3),
    "tracking": (1e-30,),  # so slow that one transition moves no average
    "margin": (0.0, 0.1),
    "etd.beta": (-1.0, 0.0, 0.5),
    "tdrc.beta": (0.7,),
}
"""Values of every option, all combinations of which are held; of one method only where a name means two things."""

HELD_ANOTHER_WAY = {
    "gtd2-mp": "the sampled update uses one transition for both halves, so that its mean differs at second order in α",
    "residual-adaptive": "the expected update knows the exact directions, the sampled one averages them",
    "lstd": "solves the averages of all transitions so far; has no step size",
    "brm": "solves the averages of all transitions so far; has no step size",
}
WITHOUT_LEARNER = {
    "fitted": "solves instead of sampling: one sweep is one regression",
    "fitted-q": "solves instead of sampling: one sweep is one regression",
    "lspi": "solves instead of sampling: one sweep is one evaluation and one improvement",
}
WITHOUT_EXPECTED: dict[str, str] = {}

ALPHA = 0.07
MOST_SEQUENCES = 10_000


class Ways(NamedTuple):
    """Every way to go on from every row under one policy, ``[K]`` each; the next row is -1 at an end."""

    row: Index
    next_row: Index
    chance: Floats
    rho: Floats
    reward: Floats


@dataclass(frozen=True, eq=False)
class World:
    """A small problem as plain arrays.

    Args:
        p: ``[S, A, S]``; what a row lacks of 1 ends the episode.
        legal: ``[S, A]``; a state without actions is terminal.
        r: ``[S, A]``.
        pi: the target policy, ``[S, A]``.
        mu: the behaviour policy, ``[S, A]``.
        start: ``[S]``.
        X: ``[S, d]`` or ``[S, A, d]``.
        gamma: γ.
        visits: how often each state is updated, ``[S]``; None for as often as the behaviour visits it.
        ends: whether every episode is so short that all can be listed.
    """

    p: Floats
    legal: NDArray[np.bool_]
    r: Floats
    pi: Floats
    mu: Floats
    start: Floats
    X: Floats
    gamma: float
    visits: Floats | None
    ends: bool

    @property
    def pairs(self) -> bool:
        return self.X.ndim == 3

    @cached_property
    def process(self) -> Process:
        """What the library makes of it."""
        mdp = FiniteMDP.from_arrays(
            self.p.swapaxes(0, 1), self.r, legal=self.legal, substochastic=True, start=self.start
        )
        return linear_process(
            Problem.from_mdp(
                mdp, self.X, gamma=self.gamma, target_policy=self.pi, behaviour_policy=self.mu,
                state_distribution=self.visits,
            )
        )  # fmt: skip

    @cached_property
    def rows(self) -> list[tuple[int, ...]]:
        """The states that have actions, or the legal pairs."""
        return [tuple(map(int, row)) for row in np.argwhere(self.legal if self.pairs else self.legal.any(axis=1))]

    @cached_property
    def features(self) -> Floats:
        """``[n + 1, d]``; the last row is that of an end, which index -1 finds."""
        return np.array([*(self.X[row] for row in self.rows), np.zeros(self.X.shape[-1])])

    def after(self, s: int, a: int) -> list[tuple[int, float]]:
        """The states that a pair leads to with their chances; -1 for the end."""
        inside = [(int(t), float(self.p[s, a, t])) for t in np.flatnonzero(self.p[s, a]) if self.legal[t].any()]
        return [*inside, (-1, 1.0 - sum(chance for _, chance in inside))]

    def choices(self, s: int, policy: Floats) -> list[tuple[int, float, float]]:
        """The actions that a policy takes in a state: action, chance, ratio."""
        return [(int(a), policy[s, a], self.pi[s, a] / self.mu[s, a]) for a in np.flatnonzero(policy[s])]

    def ways(self, policy: Floats) -> Ways:
        found = []
        for i, row in enumerate(self.rows):
            if not self.pairs:
                for a, chance, rho in self.choices(row[0], policy):
                    for t, p in self.after(row[0], a):
                        found.append((i, self.rows.index((t,)) if t >= 0 else -1, chance * p, rho, self.r[row[0], a]))
                continue
            for t, p in self.after(*row):
                if t < 0:
                    found.append((i, -1, p, 1.0, self.r[row]))
                    continue
                for a, chance, rho in self.choices(t, policy):
                    found.append((i, self.rows.index((t, a)), p * chance, rho, self.r[row]))
        return Ways(*(np.array(column) for column in zip(*found, strict=True)))

    @cached_property
    def behaviour(self) -> Ways:
        return self.ways(self.mu)

    @cached_property
    def target(self) -> Ways:
        return self.ways(self.pi)

    def weight_of_rows(self, weight_of_states: Floats) -> Floats:
        """``[S] -> [n]``, actions by the behaviour."""
        return np.array([weight_of_states[row[0]] * (self.mu[row] if self.pairs else 1.0) for row in self.rows])

    @cached_property
    def D(self) -> Floats:
        """How often each row is updated, ``[n]``: given, or the long run of the behaviour, from its ways alone."""
        if self.visits is not None:
            return self.weight_of_rows(self.visits)
        way, begin = self.behaviour, self.weight_of_rows(self.start)
        chain = np.zeros((len(begin), len(begin)))
        np.add.at(chain, (way.row, way.next_row), np.where(way.next_row < 0, 0.0, way.chance))
        chain += (1.0 - chain.sum(axis=1))[:, None] * begin
        system = np.vstack([chain.T - np.eye(len(begin)), np.ones(len(begin))])
        return np.linalg.lstsq(system, np.eye(len(begin) + 1)[-1], rcond=None)[0]

    @cached_property
    def draws(self) -> tuple[Index, Index, Floats]:
        """Every way of the behaviour with every second way of the target from the same row, and their chances."""
        way, second = np.nonzero(self.behaviour.row[:, None] == self.target.row)
        return way, second, (self.D[self.behaviour.row] * self.behaviour.chance)[way] * self.target.chance[second]

    @cached_property
    def episodes(self) -> tuple[list[list[int]], Floats]:
        """Every episode as ways of the behaviour, and its chance."""
        assert self.ends
        way, found = self.behaviour, []

        def go_on(row: int, chance: float, so_far: list[int]) -> None:
            for k in np.flatnonzero(way.row == row):
                if way.next_row[k] < 0:
                    found.append(([*so_far, int(k)], chance * way.chance[k]))
                else:
                    go_on(way.next_row[k], chance * way.chance[k], [*so_far, int(k)])

        for row, chance in enumerate(self.weight_of_rows(self.start)):
            if chance > 0:
                go_on(row, chance, [])
        return [ways for ways, _ in found], np.array([chance for _, chance in found])

    def sample(
        self, way: Index, second: Index | None, begins: object, scale: Floats | float = 1.0
    ) -> SampledTransition:
        """Transitions along ways of the behaviour; where there is no second one, whoever reads it gets NaN.

        A ``scale`` √k of features and rewards makes a transition count k times in whatever is quadratic in them.
        """
        one, scale = self.behaviour, np.broadcast_to(scale, len(way))
        ahead = np.full((len(way), self.X.shape[-1]), np.nan)
        further = np.full(len(way), np.nan)
        if second is not None:
            ahead = self.features[self.target.next_row[second]]
            further = np.where(self.target.next_row[second] < 0, 0.0, self.gamma)
        return SampledTransition(
            row=one.row[way],
            next_row=one.next_row[way],
            x=scale[:, None] * self.features[one.row[way]],
            x_next=scale[:, None] * self.features[one.next_row[way]],
            x_second=scale[:, None] * ahead,
            discount_second=further,
            reward=scale * one.reward[way],
            rho=one.rho[way],
            discount=np.where(one.next_row[way] < 0, 0.0, self.gamma),
            begins=np.broadcast_to(np.asarray(begins, dtype=bool), len(way)),
        )


def make_world(
    seed: int, pairs: bool, successors: dict[int, tuple[int, ...]], num_actions: int, num_weights: int, gamma: float,
    *, on_policy: bool = False, any_visits: bool = False, certain: bool = False, ends: bool = False,
) -> World:  # fmt: skip
    """A random world. A state without successors is terminal; every pair may end the episode besides.

    Of three actions the last is illegal in the first state.
    """
    rng, num_states = np.random.default_rng(seed), len(successors)
    legal = np.array([[True] * num_actions if successors[s] else [False] * num_actions for s in range(num_states)])
    legal[0, 2:] = False
    p = np.zeros((num_states, num_actions, num_states))
    for s, a in np.argwhere(legal):
        goal = list(successors[s])
        p[s, a, goal] = rng.dirichlet(np.ones(len(goal))) * rng.uniform(0.6, 0.95)
    lively = legal.any(axis=1)

    def policy() -> Floats:
        chance = legal * rng.uniform(0.3, 1.0, size=legal.shape)
        return chance / np.where(lively, chance.sum(axis=1), 1.0)[:, None]

    mu, pi = policy(), policy()
    if certain:
        pi = np.where(legal & (np.arange(num_actions) == 1), 1.0, 0.0)
    start = lively * rng.uniform(0.3, 1.0, num_states)
    visits = lively * rng.uniform(0.3, 1.0, num_states)
    X = rng.normal(size=(num_states, num_actions, num_weights) if pairs else (num_states, num_weights))
    X[~(legal if pairs else lively)] = 0.0
    return World(
        p, legal, legal * rng.normal(size=legal.shape), mu if on_policy else pi, mu, start / start.sum(), X, gamma,
        visits / visits.sum() if any_visits else None, ends,
    )  # fmt: skip


CYCLES: dict[int, tuple[int, ...]] = {0: (0, 2, 1), 1: (), 2: (0, 2, 3), 3: (0, 2)}
LAYERS: dict[int, tuple[int, ...]] = {0: (1, 3), 1: (4, 5), 2: (), 3: (4, 5, 2), 4: (6,), 5: (6, 2), 6: (2,)}
LOOP: dict[int, tuple[int, ...]] = {0: (0, 1), 1: (0, 1, 2), 2: ()}
KINDS = ["on-policy", "off-policy", "redundant", "diverging", "episodes"]


@cache
def world_of(kind: str, pairs: bool) -> World:
    if kind == "on-policy":
        return make_world(1, pairs, CYCLES, 3, 4 if pairs else 2, 0.9, on_policy=True)
    if kind == "off-policy":
        return make_world(2, pairs, CYCLES, 3, 4 if pairs else 2, 0.9, any_visits=True)
    if kind == "redundant":  # more weights than rows, no discount, a target that takes one action only
        return make_world(3, pairs, CYCLES, 2, 8 if pairs else 4, 1.0, any_visits=True, certain=True)
    if kind == "diverging":  # updates in state 0, whose values lag behind those of state 1
        world = make_world(2, pairs, LOOP, 2, 2, 0.95)
        X = np.where(world.X != 0, 1 + 0.3 * world.X, 0.0)
        X[1] *= 2.5
        return replace(world, X=X, visits=np.array([0.9, 0.1, 0.0]))
    return make_world(5, pairs, LAYERS, 2, 4 if pairs else 3, 0.9, ends=True)


def combinations(one: Method) -> Iterator[Options]:
    """Every combination of the values tried; the default of an option that TRIED does not know."""
    values = [TRIED.get(f"{one.name}.{name}", TRIED.get(name, (one.options[name].default,))) for name in one.options]
    for chosen in itertools.product(*values):
        yield dict(zip(one.options, chosen, strict=True))


def expected_of(world: World, one: Method, options: Options) -> Expected:
    assert one.expected is not None
    return one.expected(world.process, one.checked(options))


def learner_of(world: World, one: Method, options: Options, thetas: Floats) -> SampledUpdate:
    """A learner whose seeds stand at the given θ, ``[N, size]``."""
    assert one.learner is not None
    learner = one.learner(world.process, thetas[:, : world.X.shape[-1]].copy(), one.checked(options))
    learner.theta[:] = thetas
    return learner


def thetas_for(expected: Expected) -> Floats:
    """More random θ than an affine map has columns, ``[size + 2, size]``: those of h and u are as random as w's."""
    return np.random.default_rng(7).normal(size=(expected.size + 2, expected.size))


def predicted(expected: Expected, thetas: Floats, step_size: float) -> Floats:
    """M θ + c at every θ."""
    pieces = [expected.at(theta, step_size) for theta in thetas]
    return np.array([M @ theta + c for (M, c), theta in zip(pieces, thetas, strict=True)])


def assert_same(got: Floats, wanted: Floats) -> None:
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-10)


# One sweep: independent transitions.


def sequences(world: World, length: int) -> tuple[list[Index], list[Index | None], Floats]:
    """All sequences of so many independent draws and their chances; a single one comes with second successors."""
    if length == 1:
        way, second, chance = world.draws
        return [way], [second], chance
    num_ways = len(world.behaviour.row)
    ways = np.array(np.meshgrid(*[np.arange(num_ways)] * length)).reshape(length, -1)
    single = world.D[world.behaviour.row] * world.behaviour.chance
    return list(ways), [None] * length, np.prod(single[ways], axis=0)


def after_each(
    world: World, one: Method, options: Options, thetas: Floats, step_size: float, length: int = 1
) -> Floats:
    """θ after each sequence of draws from each θ, ``[T, size] or [T, K, size] -> [T, K, size]``."""
    ways, seconds, chance = sequences(world, length)
    T, K, size = len(thetas), len(chance), thetas.shape[-1]
    from_here = np.broadcast_to(thetas if thetas.ndim == 3 else thetas[:, None], (T, K, size)).reshape(T * K, size)
    learner = learner_of(world, one, options, from_here)
    samples = [
        world.sample(np.tile(way, T), None if second is None else np.tile(second, T), begins=False)
        for way, second in zip(ways, seconds, strict=True)
    ]
    for way, second in zip(ways, seconds, strict=True):  # other transitions first: they must not matter
        before = [None if k is None else np.tile(np.roll(k, 1), T) for k in (way, second)]
        learner.update(world.sample(before[0], before[1], begins=True), step_size)
    learner.theta[:] = from_here
    for sample in samples:
        learner.update(sample, step_size)
    return learner.theta.reshape(T, K, size)


def mean_of_a_sweep(world: World, one: Method, options: Options, thetas: Floats, alpha: float, length: int) -> Floats:
    """Exact mean of θ after the sampled updates that one expected update stands for, ``[T, size]``."""
    chance = sequences(world, length)[-1]
    return np.einsum("k,tkd->td", chance, after_each(world, one, options, thetas, alpha, length))


# Episodes: histories that end.


def slope(change: dict[float, Floats]) -> Floats:
    """The slope at 0 of a polynomial of degree 4 at most that is 0 there, from its values at ±a and ±2a."""
    a = max(change) / 2
    near, far = ((change[b] - change[-b]) / (2 * b) for b in (a, 2 * a))
    return (4 * near - far) / 3


STEPS = (-0.5, -0.25, 0.25, 0.5)


def mean_change(world: World, one: Method, options: Options, thetas: Floats) -> Floats:
    """The long-run mean of the change of a held θ per unit of α, in the limit of small α, ``[T, size]``."""
    episodes, chance = world.episodes
    lengths, T = np.array([len(episode) for episode in episodes]), len(thetas)
    held, total = np.repeat(thetas, len(episodes), axis=0), {}
    for alpha in STEPS:
        learner, change = learner_of(world, one, options, held), np.zeros_like(held)
        for t in range(2 * lengths.max()):
            way = np.array([episode[t % len(episode)] for episode in episodes])
            learner.update(world.sample(np.tile(way, T), None, np.tile(t % lengths == 0, T)), alpha)
            counts = np.tile((t >= lengths) & (t < 2 * lengths), T)  # the second run of the episode
            change += np.where(counts[:, None], learner.theta - held, 0.0)
            learner.theta[:] = held
        total[alpha] = np.einsum("e,ted->td", chance, change.reshape(T, len(episodes), -1)) / (chance @ lengths)
    return slope(total)


def predicted_change(expected: Expected, thetas: Floats) -> Floats:
    """The slope at α = 0 of M θ + c − θ."""
    return slope({alpha: predicted(expected, thetas, alpha) - thetas for alpha in STEPS})


# What is held where.


def way_to_hold(one: Method, options: Options, world: World) -> str:
    """How this world can hold a method with these options: ``"sweep"``, ``"episodes"``, or not at all."""
    length = expected_of(world, one, options).updates_per_sweep
    if length == 1 and one.remembers(options):
        return "episodes" if world.ends else ""
    return "sweep" if length == 1 or len(world.behaviour.row) ** length <= MOST_SEQUENCES else ""


SAMPLED = [one for one in METHODS if one.name not in {*HELD_ANOTHER_WAY, *WITHOUT_LEARNER, *WITHOUT_EXPECTED}]


def in_worlds(methods: Iterable[Method], kinds: Iterable[str] = KINDS) -> pytest.MarkDecorator:
    """Each method in each world whose rows it can learn."""
    cases = [
        pytest.param(one, world_of(kind, pairs), id=f"{one.name}-{kind}-{'pairs' if pairs else 'states'}")
        for one in methods
        for kind in kinds
        for pairs in (False, True)
        if pairs or one.rows != "pairs"
    ]
    return pytest.mark.parametrize(("one", "world"), cases)


@in_worlds(SAMPLED)
def test_the_mean_of_the_sampled_update_is_the_expected_update(one: Method, world: World) -> None:
    for options in combinations(one):
        how = way_to_hold(one, options, world)
        if not how:
            continue
        expected = expected_of(world, one, options)
        thetas = thetas_for(expected)
        if how == "sweep":
            exact = predicted(expected, thetas, ALPHA)
            assert_same(mean_of_a_sweep(world, one, options, thetas, ALPHA, expected.updates_per_sweep), exact)
            assert np.abs(exact - thetas).max() > 1e-3  # the comparison is not idle
        else:
            exact = predicted_change(expected, thetas)
            assert_same(mean_change(world, one, options, thetas), exact)
            assert np.abs(exact).max() > 1e-2


def test_every_method_is_held_with_every_option() -> None:
    """A new method is held by enumeration, or named above with the reason; a new option is given values to try."""
    assert {one.name for one in METHODS if one.learner is None} == set(WITHOUT_LEARNER)
    assert {one.name for one in METHODS if one.expected is None} == set(WITHOUT_EXPECTED)
    assert {one.name for one in METHODS} >= {*HELD_ANOTHER_WAY, *WITHOUT_LEARNER, *WITHOUT_EXPECTED}
    for one in METHODS:
        for name in one.options:
            assert name in TRIED or f"{one.name}.{name}" in TRIED, f"values of {name} of {one.name} to try"
    for one in SAMPLED:
        worlds = [world_of(kind, pairs) for kind in KINDS for pairs in (False, True) if pairs or one.rows != "pairs"]
        for options in combinations(one):
            assert any(way_to_hold(one, options, world) for world in worlds), (one.name, options)


@in_worlds(one for one in METHODS if one.expected is not None)
def test_the_generator_is_that_of_the_pieces(one: Method, world: World) -> None:
    """Where there is one, M = I − αG and c = αg; a linear method has one piece, whatever θ."""
    for options in combinations(one):
        expected = expected_of(world, one, options)
        pieces = [expected.at(theta, ALPHA) for theta in thetas_for(expected)[:2]]
        if expected.linear:
            assert all(np.array_equal(one, other) for one, other in zip(*pieces, strict=True))
        if expected.generator is not None:
            assert expected.linear
            G, g = expected.generator
            assert_same(pieces[0][0], np.eye(expected.size) - ALPHA * G)
            assert_same(pieces[0][1], ALPHA * g)


# The methods that are held another way.


@in_worlds([method("gtd2-mp")])
def test_gtd2_mp_is_the_extragradient_of_gtd2_and_its_samples_differ_by_a_covariance(one: Method, world: World) -> None:
    """With D_t(θ) = g_t − G_t θ the direction of GTD2 on one transition, D = E D_t and G = E G_t:

    expected θ + αD(θ + αD(θ)), sampled in the mean θ + α E D_t(θ + αD_t(θ)), less by α² (E[G_t D_t(θ)] − G D(θ)).
    """
    options = {"lambda_": 0.0, "beta_over_alpha": 2.5}
    expected = expected_of(world, one, options)
    thetas, chance = thetas_for(expected), world.draws[-1]

    def directions(at: Floats) -> Floats:
        return after_each(world, method("gtd2"), options, at, 1.0) - (at if at.ndim == 3 else at[:, None])

    def mean(values: Floats) -> Floats:
        return np.einsum("k,tkd->td", chance, values)

    each = directions(thetas)
    direction = mean(each)
    extragradient = thetas + ALPHA * mean(directions(thetas + ALPHA * direction))
    assert_same(predicted(expected, thetas, ALPHA), extragradient)
    sampled = mean_of_a_sweep(world, one, options, thetas, ALPHA, 1)
    of_one = direction - mean(directions(thetas[:, None] + each))  # E[G_t D_t(θ)]
    of_means = direction - mean(directions(thetas + direction))  # G D(θ)
    assert_same(sampled - extragradient, -(ALPHA**2) * (of_one - of_means))
    assert np.abs(sampled - extragradient).max() > 1e-3


@pytest.mark.parametrize("lambda_", [0.0, 0.6, 1.0])
@in_worlds([method("gtd2-mp")], ["episodes"])
def test_gtd2_mp_over_episodes_is_the_extragradient_and_its_samples_agree_at_first_order(
    one: Method, world: World, lambda_: float
) -> None:
    options = {"lambda_": lambda_, "beta_over_alpha": 2.5}
    expected = expected_of(world, one, options)
    thetas = thetas_for(expected)
    halfway = thetas + ALPHA * mean_change(world, method("gtd2"), options, thetas)
    extragradient = thetas + ALPHA * mean_change(world, method("gtd2"), options, halfway)
    assert_same(predicted(expected, thetas, ALPHA), extragradient)
    assert_same(mean_change(world, one, options, thetas), predicted_change(expected, thetas))


@in_worlds([method("residual-adaptive")], ["off-policy", "redundant", "diverging"])
def test_adaptive_residual_whose_averages_are_exact(one: Method, world: World) -> None:
    """All transitions, each as often as its chance says and all of them 10¹⁵ times, before the one that counts.

    φ depends on the ratio of the averages only, and with a tracking so slow one more transition leaves it alone.
    """
    way, second, chance = world.draws
    for options in combinations(one):
        expected = expected_of(world, one, options)
        thetas = 3 * np.random.default_rng(7).normal(size=(8, expected.size))
        T, K = len(thetas), len(way)
        learner = learner_of(world, one, options, np.repeat(thetas, K, axis=0))
        for k in range(K):
            every = np.full(T * K, k)
            learner.update(world.sample(way[every], second[every], True, np.sqrt(1e15 * chance[k])), 0.0)
        learner.update(world.sample(np.tile(way, T), np.tile(second, T), True), ALPHA)
        assert_same(np.einsum("k,tkd->td", chance, learner.theta.reshape(T, K, -1)), predicted(expected, thetas, ALPHA))
        td = expected_of(world, method("td"), {})
        alone = [np.allclose(expected.at(theta, ALPHA)[0], td.at(theta, ALPHA)[0]) for theta in thetas]
        assert 0 < sum(alone) < T if world is world_of("diverging", world.pairs) else any(alone)  # φ = 0, and φ > 0


def solved(world: World, one: Method, options: Options, samples: list[tuple[int, int | None, bool, float]]) -> Floats:
    """The weights after transitions that count as often as the last number of each says, on the average once."""
    learner = learner_of(world, one, options, np.ones((1, world.X.shape[-1])))
    scale = len(samples) / sum(weight for *_, weight in samples)
    for way, second, begins, weight in samples:
        other = None if second is None else np.array([second])
        learner.update(world.sample(np.array([way]), other, begins, np.sqrt(scale * weight)), ALPHA)
    return learner.theta[0]


@in_worlds([method("lstd"), method("brm")])
def test_solvers_of_averages_solve_the_exact_ones(one: Method, world: World) -> None:
    """Every transition once, weighted by its chance; with a trace every episode."""
    draws = [(int(k), int(q), True, float(chance)) for k, q, chance in zip(*world.draws, strict=True)]
    for options in combinations(one):
        samples: list[tuple[int, int | None, bool, float]] = [*draws]
        if options.get("lambda_", 0.0) > 0:
            if not world.ends:
                continue
            samples = [
                (way, None, t == 0, chance)
                for episode, chance in zip(*world.episodes, strict=True)
                for t, way in enumerate(episode)
            ]
        M, c = expected_of(world, one, options).at(np.ones(world.X.shape[-1]), ALPHA)
        assert not M.any()
        np.testing.assert_allclose(solved(world, one, options, samples), c, rtol=1e-8, atol=1e-9)


# The methods without a sampled update.


def best_rows(world: World, w: Floats) -> Index:
    """The row with the largest value in the state of every next row, ``[K]``; -1 at an end."""
    value = world.features @ w
    best = []
    for following in world.behaviour.next_row:
        rivals = [i for i, row in enumerate(world.rows) if following >= 0 and row[0] == world.rows[following][0]]
        best.append(max(rivals, key=lambda i: value[i]) if rivals else -1)
    return np.array(best)


def by_least_squares(world: World, name: str, w: Floats, eta: float) -> Floats:
    """The next weights, from a regression over every transition with its chance as weight."""
    way, X, d = world.behaviour, world.features, len(w)
    weight = world.D[way.row] * way.chance
    if name == "fitted":
        weight, following = weight * way.rho, way.next_row
    else:
        following = best_rows(world, w)
    x, ahead = X[way.row], world.gamma * X[following]
    if name == "lspi":
        return np.linalg.lstsq((weight[:, None] * x).T @ (x - ahead), x.T @ (weight * way.reward), rcond=1e-10)[0]
    root = np.sqrt(weight)[:, None]
    left = np.vstack([root * x, np.sqrt(eta) * np.eye(d)])
    right = np.concatenate([root[:, 0] * (way.reward + ahead @ w), np.zeros(d)])
    return np.linalg.lstsq(left, right, rcond=1e-10)[0]


@in_worlds(method(name) for name in WITHOUT_LEARNER)
def test_methods_without_samples_are_least_squares_over_all_transitions(one: Method, world: World) -> None:
    for options in combinations(one):
        expected = expected_of(world, one, options)
        thetas = thetas_for(expected)
        wanted = np.array([by_least_squares(world, one.name, w, options.get("eta", 0.0)) for w in thetas])
        np.testing.assert_allclose(predicted(expected, thetas, ALPHA), wanted, rtol=1e-8, atol=1e-9)


def test_sarsa_is_td_where_its_own_policy_behaves() -> None:
    """Its samples are weighted by visits that the expected update uses too; here they are the problem's own."""
    world, epsilon = world_of("on-policy", True), 0.3
    expected = expected_of(world, method("sarsa"), {"epsilon": epsilon})
    for theta in thetas_for(expected):
        value = np.where(world.legal, world.X @ theta, -np.inf)
        own = epsilon * world.legal / np.maximum(world.legal.sum(axis=1, keepdims=True), 1)
        lively = np.flatnonzero(world.legal.any(axis=1))
        own[lively, value[lively].argmax(axis=1)] += 1 - epsilon
        itself = World(world.p, world.legal, world.r, own, own, world.start, world.X, world.gamma, None, False)
        for got, wanted in zip(
            expected.at(theta, ALPHA), expected_of(itself, method("td"), {}).at(theta, ALPHA), strict=True
        ):
            assert_same(got, wanted)
