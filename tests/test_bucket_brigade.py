"""ZCS against the same in plain Python on strings, Woods1 against its map, the chain against its closed form.

Mutants that die here: a bid paid to the present set or to the one before that, a bucket that is not divided or not
discounted, a tax on those that act or on none, a reward that is paid whole; covering that does not match or does not
count its strength, children with another point, parents that keep their strength, a mutation that cannot reach a sign,
a mark that outlives the classifier; the strongest that go; neighbours in another order, a map that ends at its edge; a
brigade in which somebody is paid before the others have bid.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from neuralq.runs.report.claims import Measured
from neuralq.systems import run_system, system_named
from neuralq.systems.bucket_brigade import chain, lives, oracle, system
from neuralq.tabular import ZcsRates, new_stream, new_zcs, zcs_action, zcs_strengths, zcs_update
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.woods import MOVES, WOODS1, WoodsEnv, mdp, percepts, successors


class Rule:
    """A classifier as it is printed: ``"#01"`` looks at the bits from the lowest."""

    def __init__(self, condition: list[str], action: int, strength: float) -> None:
        self.condition, self.action, self.strength = condition, action, strength

    def matches(self, s: int) -> bool:
        return all(sign in ("#", str(s >> i & 1)) for i, sign in enumerate(self.condition))


class Written:
    """ZCS in plain Python; it draws the same random numbers in the same order."""

    def __init__(self, zcs: Any, rates: ZcsRates, stream: Any) -> None:
        self.rates, self.num_bits, self.num_actions = rates, zcs.num_bits, zcs.num_actions
        self.draw = lambda: float(uniform(stream))
        self.rules = [
            Rule(
                [str(int(want) >> i & 1) if int(care) >> i & 1 else "#" for i in range(zcs.num_bits)], int(a), float(s)
            )
            for care, want, a, s in zip(zcs.cares, zcs.wants, zcs.action, zcs.strength, strict=True)
        ]
        self.before: list[Rule] = []

    def pick(self, rules: list[Rule], weights: list[float]) -> Rule:
        left = self.draw() * sum(weights)
        for rule, weight in zip(rules, weights, strict=True):
            left -= weight
            if left < 0:
                return rule
        return rules[-1]

    def replace(self, rule: Rule) -> None:
        weak = self.pick(self.rules, [1 / max(one.strength, 1e-6) for one in self.rules])
        self.rules[self.rules.index(weak)] = rule
        self.match = [one for one in self.match if one is not weak]
        self.before = [one for one in self.before if one is not weak]

    def act(self, s: int) -> int:
        self.match = [rule for rule in self.rules if rule.matches(s)]
        mean = sum(rule.strength for rule in self.rules) / len(self.rules)
        if sum(rule.strength for rule in self.match) < self.rates.covering * mean or not self.match:
            weak = self.pick(self.rules, [1 / max(one.strength, 1e-6) for one in self.rules])
            condition = [str(s >> i & 1) if self.draw() >= self.rates.blind else "#" for i in range(self.num_bits)]
            self.rules[self.rules.index(weak)] = Rule(condition, int(self.draw() * self.num_actions), mean)
            self.before = [one for one in self.before if one is not weak]
            self.match = [rule for rule in self.rules if rule.matches(s)]
        chosen = self.pick(self.match, [rule.strength for rule in self.match]).action
        self.acting = [rule for rule in self.match if rule.action == chosen]
        return chosen

    def learn(self, reward: float, last: bool) -> None:
        beta, bucket = self.rates.beta, self.rates.beta * sum(rule.strength for rule in self.acting)
        for rule in self.match:
            if rule in self.acting:
                rule.strength += beta * reward / len(self.acting) - beta * rule.strength
            else:
                rule.strength *= 1 - self.rates.tax
        for rule in self.before:
            rule.strength += self.rates.gamma * bucket / len(self.before)
        self.before = [] if last else self.acting
        if self.draw() < self.rates.breeding:
            self.breed()

    def breed(self) -> None:
        mother = self.pick(self.rules, [rule.strength for rule in self.rules])
        father = self.pick(self.rules, [rule.strength for rule in self.rules])
        mother.strength /= 2
        given = [mother.strength]
        father.strength /= 2
        given.append(father.strength)
        conditions = [list(mother.condition), list(father.condition)]
        actions = [mother.action, father.action]
        if self.draw() < self.rates.crossover:
            point = 1 + int(self.draw() * (self.num_bits - 1))
            one, two = conditions
            conditions = [one[:point] + two[point:], two[:point] + one[point:]]
            given = [sum(given) / 2] * 2
        for condition, action, strength in zip(conditions, actions, given, strict=True):
            for i, sign in enumerate(condition):
                if self.draw() < self.rates.mutation:
                    high = self.draw() < 0.5
                    condition[i] = ("1" if high else "0") if sign == "#" else "#" if high else "10"[int(sign)]
            if self.draw() < self.rates.mutation:
                action = (action + 1 + int(self.draw() * (self.num_actions - 1))) % self.num_actions
            self.replace(Rule(condition, action, strength))


@pytest.mark.parametrize("breeding", [0.25, 0.9])
def test_zcs_is_what_it_is_in_plain_python(breeding: float) -> None:
    rates = ZcsRates(breeding=breeding, mutation=0.05)
    stream, same = new_stream(3), new_stream(3)
    zcs, again = new_zcs(16, 8, stream, 60), new_zcs(16, 8, same, 60)
    written, env = Written(again, rates, same), gymnasium.make("neuralq/Woods1-v0")
    bits, _ = env.reset(seed=0)
    ends = 0
    for step in range(600):
        s = int(bits @ (1 << np.arange(16)))
        a = zcs_action(zcs, rates, s, stream)
        assert a == written.act(s), step
        assert int((zcs.now == 2).sum()) == len(written.acting)
        bits, reward, terminated, truncated, _ = env.step(a)
        zcs_update(zcs, rates, reward, terminated or truncated, stream)
        written.learn(reward, terminated or truncated)
        assert np.allclose(zcs.strength, [rule.strength for rule in written.rules], rtol=1e-9), step
        assert int(zcs.before.sum()) == len(written.before)
        if terminated or truncated:
            ends += 1
            bits, _ = env.reset()
    for i, rule in enumerate(written.rules):
        signs = [str(zcs.wants[i] >> k & 1) if zcs.cares[i] >> k & 1 else "#" for k in range(16)]
        assert signs == rule.condition and zcs.action[i] == rule.action
    strengths = np.zeros(8)
    zcs_strengths(zcs, s, strengths)
    expected = [sum(r.strength for r in written.rules if r.matches(s) and r.action == k) for k in range(8)]
    assert ends > 5 and np.allclose(strengths, expected)


def test_a_new_population_is_blind_to_a_third() -> None:
    zcs = new_zcs(60, 4, new_stream(0), 100)
    cares = sum(bin(int(one)).count("1") for one in zcs.cares)
    wants = sum(bin(int(one)).count("1") for one in zcs.wants)
    assert abs(cares / 6000 - 0.67) < 0.03 and abs(wants / cares - 0.5) < 0.03 and not (zcs.wants & ~zcs.cares).any()
    assert set(zcs.action.tolist()) == {0, 1, 2, 3}


def test_the_chain_is_its_closed_form_and_td() -> None:
    for num_rules, share in ((1, 0.5), (7, 0.3), (20, 0.05), (4, 1.0)):
        assert oracle.closed_form_difference(num_rules, 300, share) < 1e-9
        assert oracle.td_difference(num_rules, 120, share) < 1e-9
    told = chain.bids(10, 12)
    assert [np.count_nonzero(bids) for bids in told] == [*range(11), 10, 10]  # the wave moves one rule in a pass
    assert [chain.passes_to_half(n) for n in (5, 10, 20)] == [47, 97, 197]
    assert chain.bids(10, 3000)[-1] / 0.1 == pytest.approx(np.full(10, 1000.0))  # the limit S = R / b


@pytest.mark.parametrize("num_steps", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_woods_are_walked_as_on_their_map(num_steps: int) -> None:
    check_env(gymnasium.make("neuralq/Woods1-v0", render_mode="rgb_array").unwrapped)
    env, rows, rng = gymnasium.make("neuralq/Woods1-v0"), WOODS1.split(), np.random.default_rng(0)
    bits, extra = env.reset(seed=0)
    at, ends, steps = divmod(extra["cell"], 5), 0, 0
    for a in rng.integers(0, 8, num_steps).tolist():
        around = [rows[(at[0] + down) % 5][(at[1] + across) % 5] for down, across in MOVES]
        assert "".join(map(str, bits)) == "".join({".": "00", "O": "01", "F": "11"}[sign] for sign in around)
        if around[a] != "O":
            at = ((at[0] + MOVES[a][0]) % 5, (at[1] + MOVES[a][1]) % 5)
        bits, reward, terminated, truncated, extra = env.step(a)
        steps += 1
        assert divmod(extra["cell"], 5) == at and terminated == (around[a] == "F") and reward == 1000 * terminated
        if terminated or truncated:
            ends, steps = ends + 1, 0
            bits, extra = env.reset()
            at = divmod(extra["cell"], 5)
            assert rows[at[0]][at[1]] == "."
    assert ends > num_steps / 60


def test_the_model_of_the_cells_is_the_woods() -> None:
    model, led = mdp(), successors()
    goes_on = model.termination == 0
    assert model.num_rows == 128 and np.array_equal(
        model.transition.indices, led[model.s_tm1, model.a_tm1][goes_on]
    )  # fmt: skip
    assert np.array_equal(model.reward, 1000.0 * ~goes_on)
    assert oracle.shortest_steps() == 1.6875 and round(oracle.random_steps(), 2) == 29.06
    assert len(set(percepts()[lives.FREE].tolist())) == 16
    wider = ".....\n.F...\n.....\n.....\n....."  # food that one walks around the edge to
    assert successors(wider)[0, 3] == 6 and np.array_equal(successors(wider)[4], [24, 20, 0, 5, 9, 8, 3, 23])


def test_the_woods_can_be_looked_at() -> None:
    env = WoodsEnv("ansi")
    assert env.render() is None
    env.reset(options={"cell": 4})
    assert env.render() == ". . . . A\n. O O F .\n. O O O .\n. O O O .\n. . . . .\n"
    picture = WoodsEnv("rgb_array")
    picture.reset(options={"cell": 20})
    row, column = np.argwhere((picture.render() == (40, 90, 190)).all(axis=2)).mean(axis=0)
    assert abs(row - 4.5 * 48) < 1 and abs(column - 0.5 * 48) < 1


@pytest.mark.parametrize(
    ("act", "error", "said"),
    [
        (lambda: WoodsEnv("human"), ValueError, "render_mode must be one of"),
        (lambda: WoodsEnv(layout="..\n."), ValueError, "rows of one length"),
        (lambda: WoodsEnv(layout=".O"), ValueError, "a free cell '.' and food 'F'"),
        (lambda: WoodsEnv().step(0), ResetNeeded, "call reset"),
        (lambda: WoodsEnv().reset(options={"cell": 8}), ValueError, "must be one of the free cells"),
        (lambda: new_zcs(63, 2, new_stream(0)), ValueError, "num_bits must be at most 62, got 63"),
        (lambda: new_zcs(4, 2, new_stream(0), 1), ValueError, "num_classifiers must be a whole number of at least 2"),
        (lambda: new_zcs(4, 2, new_stream(0), strength=0.0), ValueError, "strength must be"),
        (lambda: chain.bids(3, 4, share=0.0), ValueError, "share must be"),
        (lambda: lives.live(0, num_problems=0), ValueError, "num_problems must be"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        act()


def test_an_episode_that_has_ended_wants_a_reset() -> None:
    env = WoodsEnv()
    env.reset(options={"cell": 4})
    with pytest.raises(ValueError, match="action must be a whole number from 0 to 7"):
        env.step(8)
    env.step(5)
    with pytest.raises(ResetNeeded, match="the food is found"):
        env.step(5)


def test_the_page_says_what_came_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("chain_picture", "woods_picture", "curve_picture"):
        monkeypatch.setattr(system, picture, lambda *_: None)

    def page(learned: float, untaxed: float) -> Any:
        steps = {"ZCS": learned, "no tax": untaxed, "no breeding": 5.0, "random moves": 29.0}
        made = {name: (lives.Life(np.full(1000, value), np.zeros(16, int)),) for name, value in steps.items()}
        return system.BUCKET_BRIGADE.page(made, False)

    assert page(3.5, 4.6).reproduced and page(3.5, 4.6).text[0].startswith("Reproduced")
    assert [row.verdict for row in page(3.7, 4.6).rows[:2]] == ["not reproduced", "agrees"]
    assert [row.verdict for row in page(3.5, 4.4).rows[:2]] == ["agrees", "not reproduced"]
    assert page(3.5, 4.4).text[0].startswith("Not reproduced")
    assert lives.Life(np.array([9] * 9 + [2]), np.zeros(16, int)).late == 2


def test_moves_are_judged_by_the_shortest_ways() -> None:
    shortest = np.array([[lives.best_moves(np.where(np.arange(16) == i, a, 0)) for a in range(8)] for i in range(16)])
    assert ((shortest.max(axis=1) - shortest.min(axis=1)) == 1).all()  # every cell has moves that are and that are not
    assert abs(lives.random_life(1).late - 29.06) < 3
    assert Measured("", (lives.random_life(2).late,)).median > 20


@pytest.mark.slow
def test_zcs_finds_food_and_without_its_tax_does_not() -> None:
    found = run_system(system_named("bucket-brigade"), num_seeds=8)
    late = {one.what.partition(":")[0]: one for one in found.measured}
    assert found.reproduced and np.mean(late["ZCS"].values[:4]) <= 3.6 and late["ZCS"].median <= 3.6
    assert np.mean(late["no tax"].values[:4]) >= 4.5 and late["no tax"].median >= 4.5  # the control that must fail
    assert late["random moves"].median > 20
