"""The pole, ASE/ACE and Q(λ) on it, against Gymnasium, mechanics, and plain Python.

Mutants that die here: cosine for sine, 3/4 for 4/3, friction with the other sign or on the wrong body, the new
velocity moving the position, the wrong mass under a fraction; a bound of a box moved or counted to the other side, two
factors of the box's number exchanged; falling at 11 degrees or 2.3 m; a reward before the fall; δ and λ exchanged, the
trace added before it decays, the prediction of the state left out or taken after the update, a trace that outlives its
trial, a prediction of where the pole has fallen; noise of another width or sign; in the loops a trial that starts where
the last one ended, the count of failures off by one, a film of another trial.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from scipy.stats import norm

from neuralq.systems.ase_ace import trials as ase_ace
from neuralq.systems.ase_ace.system import difference_from_cart_pole
from neuralq.tabular import AseAce, AseAceRates, ase_ace_action, ase_ace_update, new_ase_ace, new_stream
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.pole import BSA_FRICTION, PoleBoxesEnv
from neuralq_envs.pole_kernels import box_of, has_fallen, pole_step

RATES = AseAceRates()


def accelerations(state: tuple[float, ...], action: int, friction: tuple[float, float]) -> tuple[float, float]:
    """ẍ and θ̈ from the two equations of motion, solved as they stand: M ẍ + m l cos θ θ̈, m l cos θ ẍ + 4/3 m l² θ̈."""
    _, x_dot, theta, theta_dot = state
    m, both, half, g = 0.1, 1.1, 0.5, 9.8
    push = 10.0 if action else -10.0
    left = [[both, m * half * math.cos(theta)], [m * half * math.cos(theta), 4 / 3 * m * half**2]]
    right = [
        push + m * half * theta_dot**2 * math.sin(theta) - friction[0] * np.sign(x_dot),
        m * g * half * math.sin(theta) - friction[1] * theta_dot,
    ]
    x_acceleration, theta_acceleration = np.linalg.solve(left, right)
    return float(x_acceleration), float(theta_acceleration)


def test_a_step_is_gymnasiums_without_friction_and_the_equations_of_motion_with_it() -> None:
    assert difference_from_cart_pole(num_steps=1500) <= 1e-12
    rng = np.random.default_rng(0)
    for friction in ((0.0, 0.0), BSA_FRICTION, (0.7, 0.02)):
        for _ in range(40):
            state = tuple(rng.normal(size=4).tolist())
            x, x_dot, theta, theta_dot = state
            action = int(rng.integers(2))
            x_acceleration, theta_acceleration = accelerations(state, action, friction)
            expected = (
                x + 0.02 * x_dot, x_dot + 0.02 * x_acceleration,
                theta + 0.02 * theta_dot, theta_dot + 0.02 * theta_acceleration,
            )  # fmt: skip
            assert np.allclose(pole_step(x, x_dot, theta, theta_dot, action, *friction), expected, rtol=0, atol=1e-13)


def test_boxes_are_the_published_ones_and_a_bound_belongs_to_the_interval_above_it() -> None:
    degree = math.pi / 180
    bounds = ([-0.8, 0.8], [-0.5, 0.5], [-6 * degree, -degree, 0.0, degree, 6 * degree], [-50 * degree, 50 * degree])
    rng = np.random.default_rng(0)
    states = rng.normal(size=(300, 4)) * [1.2, 0.7, 0.1, 1.2]
    for i, part in enumerate(bounds):
        for bound in part:
            for value in (bound, np.nextafter(bound, -9)):
                states = np.append(states, [[*states[0, :i], value, *states[0, i + 1 :]]], axis=0)
    for state in states.tolist():
        a, b, c, d = (int(np.digitize(value, part)) for value, part in zip(state, bounds, strict=True))
        assert box_of(*state) == a + 3 * b + 9 * c + 54 * d
    for x, theta, fallen in ((2.4, 0.0, 0), (2.4001, 0.0, 1), (0.0, 0.2094, 0), (0.0, 0.2095, 1)):
        assert has_fallen(x, theta) == has_fallen(-x, -theta) == bool(fallen)


@pytest.mark.parametrize("num_steps", [3000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_environment_keeps_its_word_for_many_random_steps(num_steps: int) -> None:
    env = PoleBoxesEnv(start_spread=0.05)
    rng = np.random.default_rng(0)
    box, extra = env.reset(seed=0)
    falls, starts = 0, [extra["state"]]
    for action in rng.integers(2, size=num_steps).tolist():
        state = extra["state"]
        assert abs(state[0]) <= 2.4 and abs(state[2]) <= 0.2094396 and box == box_of(*state)
        box, reward, fallen, truncated, extra = env.step(action)
        assert reward == -float(fallen) and not truncated and fallen == has_fallen(extra["state"][0], extra["state"][2])
        if fallen:
            falls += 1
            box, extra = env.reset()
            starts.append(extra["state"])
    spread = np.array(starts)
    assert (np.abs(spread) <= 0.05).all() and (spread.min(axis=0) < -0.04).all() and (spread.max(axis=0) > 0.04).all()
    assert 20 < num_steps / falls < 25  # a pole pushed at random stands for 22 steps


def test_the_environment_is_one_of_gymnasiums() -> None:
    env = gymnasium.make("neuralq/PoleBoxes-v0", render_mode="rgb_array")
    assert env.spec is not None and env.spec.max_episode_steps == 10_000
    check_env(env.unwrapped)
    assert gymnasium.make("neuralq/PoleBoxes-v0").reset()[0] == 85
    text = PoleBoxesEnv("ansi")
    assert text.render() is None
    text.reset(options={"state": (1.0, 0.0, 0.2, 0.0)})
    *pole, track, said = text.render().splitlines()
    assert [row.index("/") for row in pole] == [38, 37, 37, 36] and track.index("[#]") == 35
    assert said == "x +1.00 m, angle +11.5 degrees, box 104"
    picture = PoleBoxesEnv("rgb_array")
    picture.reset(options={"state": (-1.0, 0.0, 0.0, 0.0)})
    blue = np.argwhere((picture.render() == (40, 90, 190)).all(axis=2))
    assert abs(blue[:, 1].mean() - 1.6 * 110) < 1 and 95 < np.ptp(blue[:, 0]) < 115  # a metre, less the hinge


@pytest.mark.parametrize(
    ("act", "error", "said"),
    [
        (lambda: PoleBoxesEnv(cart_friction=-0.1), ValueError, "cart_friction must be a finite number of at least 0"),
        (lambda: PoleBoxesEnv(start_spread=math.nan), ValueError, "start_spread must be"),
        (lambda: PoleBoxesEnv("human"), ValueError, "render_mode must be one of"),
        (lambda: PoleBoxesEnv().step(0), ResetNeeded, "call reset"),
        (lambda: PoleBoxesEnv().reset(options={"state": (3.0, 0, 0, 0)}), ValueError, "has fallen"),
        (lambda: PoleBoxesEnv().reset(options={"state": (0, 0, 0)}), ValueError, "four finite numbers"),
        (lambda: ase_ace.train(0, most_failures=0), ValueError, "most_failures must be a whole number"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        act()


def test_a_pole_that_has_fallen_needs_a_reset_and_other_actions_are_refused() -> None:
    env = PoleBoxesEnv()
    env.reset(options={"state": (0.0, 0.0, 0.209, 2.0)})
    with pytest.raises(ValueError, match="action must be 0"):
        env.step(2)
    assert env.step(1)[1:3] == (-1.0, True)
    with pytest.raises(ResetNeeded):
        env.step(1)


# ------------------------------------------------------------------------------------------------------------ ASE/ACE


class Written:
    """Both elements as they were published, in plain Python."""

    def __init__(self, num_states: int, rates: AseAceRates) -> None:
        self.w, self.e, self.p, self.x_bar = (np.zeros(num_states) for _ in range(4))
        self.rates = rates

    def update(self, s: int, a: int, r: float, gamma: float, s_t: int, ends: bool) -> float:
        one_hot = np.eye(len(self.w))[s]
        self.e = self.rates.eligibility_decay * self.e + (1 - self.rates.eligibility_decay) * (2 * a - 1) * one_hot
        self.x_bar = self.rates.trace_decay * self.x_bar + (1 - self.rates.trace_decay) * one_hot
        internal = r + (gamma * self.p[s_t] if gamma else 0.0) - self.p[s]
        self.w = self.w + self.rates.alpha * internal * self.e
        self.p = self.p + self.rates.beta * internal * self.x_bar
        if ends:
            self.e, self.x_bar = 0 * self.e, 0 * self.x_bar
        return float(internal)


@pytest.mark.parametrize("rates", [RATES, AseAceRates(3.0, 0.3, 0.5, 0.95)])
def test_the_rule_is_the_published_one(rates: AseAceRates) -> None:
    rng = np.random.default_rng(1)
    ours, theirs, s = new_ase_ace(6), Written(6, rates), 0
    for _ in range(300):
        a, r, s_t = int(rng.integers(2)), float(rng.normal()), int(rng.integers(6))
        kind = rng.random()
        gamma, ends = (0.0, True) if kind < 0.1 else (0.9, kind < 0.15)  # termination, and a time limit
        # Where the world has ended there is no state: whatever stands there must not count.
        given = -1 if gamma == 0.0 else s_t
        internal = ase_ace_update(ours, rates, s, a, r, gamma, given, ends)
        assert internal == pytest.approx(theirs.update(s, a, r, gamma, s_t, ends), abs=1e-9)
        s = s_t
    for mine, its in zip(ours, (theirs.w, theirs.e, theirs.p, theirs.x_bar), strict=True):
        assert np.abs(its).max() > 0 and np.allclose(mine, its, rtol=1e-10, atol=1e-12)


def test_without_the_critic_only_the_reward_is_left() -> None:
    alone = ase_ace.train(0, AseAceRates(beta=0.0), most_failures=50)
    assert not alone.elements.predictions.any() and alone.elements.weights.any()


def test_traces_that_have_all_but_faded_are_dropped_and_change_nothing() -> None:
    elements = new_ase_ace(2)
    elements.weights[1] = 5.0
    ase_ace_update(elements, RATES, 1, 1, 0.0, 0.9, 0, False)
    for _ in range(2200):  # .9^2200 is 10^-101
        ase_ace_update(elements, RATES, 0, 1, 0.0, 0.9, 0, False)
    assert elements.eligibility[1] == 0 == elements.traces[1] and elements.eligibility[0] > 0.99
    ase_ace_update(elements, RATES, 0, 1, -1.0, 0.0, 0, True)
    assert elements.weights[1] == 5.0


def test_actions_have_the_probability_of_the_noise() -> None:
    elements, stream = new_ase_ace(4), new_stream(0)
    elements.weights[:] = [-0.012, -0.003, 0.0, 0.007]
    for s, w in enumerate(elements.weights):
        share = np.mean([ase_ace_action(elements, RATES, s, stream) for _ in range(4000)])
        assert share == pytest.approx(norm.cdf(w / 0.01), abs=4 * 0.5 / math.sqrt(4000))
    assert [ase_ace_action(elements, AseAceRates(noise=0.0), s, stream) for s in range(4)] == [0, 0, 1, 1]


def written_trials(seed: int, rates: AseAceRates, friction: tuple[float, float], num: int) -> tuple[Written, list[int]]:
    """The whole loop in plain Python, on the Gymnasium environment."""
    env, stream, elements = PoleBoxesEnv(None, *friction), new_stream(seed), Written(162, rates)
    lengths = []
    for _ in range(num):
        s, steps, fallen = env.reset()[0], 0, False
        while not fallen:
            a = int(uniform(stream) < norm.cdf(elements.w[s] / rates.noise))
            s_t, reward, fallen, _, _ = env.step(a)
            elements.update(s, a, reward, 0.0 if fallen else 0.95, s_t, fallen)
            s, steps = s_t, steps + 1
        lengths.append(steps)
    return elements, lengths


@pytest.mark.parametrize("friction", [(0.0, 0.0), BSA_FRICTION])
def test_the_compiled_trials_are_those_in_plain_python(friction: tuple[float, float]) -> None:
    elements, lengths = written_trials(3, RATES, friction, 12)
    ours = ase_ace.train(3, most_failures=12, friction=friction)
    assert ours.lengths.tolist() == lengths and not ours.balanced and ours.failures == 12
    assert max(lengths) > 3 * min(lengths)  # something was learned
    for mine, its in zip(ours.elements[::2], (elements.w, elements.p), strict=True):
        assert np.allclose(mine, its, rtol=1e-9, atol=1e-12)


def test_a_training_ends_with_the_long_trial_and_its_films_are_of_its_own_trials() -> None:
    lengths = ase_ace.train(3, most_failures=12).lengths
    long_trial = int(lengths.max()) - 1  # it would have fallen with the next push
    ours = ase_ace.train(3, most_failures=12, long_trial_steps=long_trial)
    expected = int(np.argmax(lengths >= long_trial))
    assert (
        ours.balanced
        and ours.failures == expected
        and ours.lengths.tolist() == [*lengths[:expected].tolist(), long_trial]
    )
    first, last = ase_ace.film_trials(ours, RATES, [0, expected], 10_000)
    assert (len(first), len(last)) == (lengths[0], long_trial)
    for states in (first, last):
        assert not states[0].any() and all(
            any(np.allclose(pole_step(*before, a, 0.0, 0.0), after, atol=1e-15) for a in (0, 1))
            for before, after in zip(states[:-1].tolist(), states[1:].tolist(), strict=True)
        )
    ends = [pole_step(*first[-1].tolist(), a, 0.0, 0.0) for a in (0, 1)]
    assert any(has_fallen(x, theta) for x, _, theta, _ in ends)
    assert isinstance(ours.elements, AseAce)
