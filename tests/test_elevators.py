"""The elevators against a slow readable version of them, quadrature, every sequence of decisions, and plain Python.

Mutants that die here: a turn that is free or charged where nobody turns, half a stop for a whole one, a wait that ends
when boarding ends, the farthest car woken, a car that looks down first, a full car that stops, two cars at one floor,
calls of the own floor counted as further on, a wait subtracted once too little; every sign, factor and index of the
three integrals; accounts that are opened a decision late, or discounted to the wrong one; inputs shifted by a floor,
directions exchanged, a footprint a floor too early; the next decision of another car bootstrapped from, its duration
that of the building, the target of the minimum; softmax of costs instead of values; weights averaged from the wrong
hour; contenders measured on different hours.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from elevators_slowly import Decision, Person, SlowBuilding, all_sequences, seen
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from scipy.integrate import quad

from neuralq.learners import SmdpNetwork, new_smdp_network
from neuralq.systems import run_system, system_named
from neuralq.systems.elevators import controllers, oracle
from neuralq.systems.elevators.contenders import CONTENDERS, CONTROLS, LEARNED, MYOPIC, UNCLIPPED
from neuralq.systems.elevators.controllers import new_controller, play
from neuralq.systems.elevators.film import elevator_film, record
from neuralq.systems.elevators.kernels import learn_hour, new_memory
from neuralq.systems.elevators.training import Settings, Training, Waits, held_out_hours, measure, train
from neuralq.tabular.kernels.random_numbers import new_stream, uniform
from neuralq_envs.elevators.building import COUNTED, NUM_WAITING, SETTLED, Building, open_building
from neuralq_envs.elevators.environment import ElevatorsEnv
from neuralq_envs.elevators.inputs import num_inputs, write_inputs
from neuralq_envs.elevators.kernels import (
    ENDED,
    PAUSED,
    advance,
    decide,
    discounted_powers,
    open_account,
    rewind,
)  # fmt: skip
from neuralq_envs.elevators.passengers import MINI, Passengers, draw_hour, given_passengers

SIZES = [(4, 10, 20, 1.0), (2, 6, 3, 0.5), (3, 4, 2, 1.0), (1, 3, 1, 0.3), (6, 12, 20, 1.5)]


def hour_of(seed: int, num_floors: int, busy: float) -> Passengers:
    return draw_hour(np.random.default_rng(seed), num_floors, [busy * rate for rate in (4, 12, 18, 2)])


def slow_building(passengers: Passengers, num_cars: int, num_floors: int, capacity: int) -> SlowBuilding:
    people = [Person(*one) for one in zip(*(column.tolist() for column in passengers), strict=True)]
    return SlowBuilding(people, num_cars, num_floors, capacity)


@pytest.mark.parametrize(("num_cars", "num_floors", "capacity", "busy"), SIZES)
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_compiled_building_is_the_slow_one(
    num_cars: int, num_floors: int, capacity: int, busy: float, share: float
) -> None:
    passengers = hour_of(num_cars, num_floors, busy)
    rng, decided = np.random.default_rng(1), []

    def stops(decision: Decision) -> bool:
        stop = bool(rng.random() < share)
        decided.append((decision.second, decision.car.number, decision.car.floor, stop, seen(decision)))
        return stop

    slow = slow_building(passengers, num_cars, num_floors, capacity)
    slow.run(stops)
    building = open_building(passengers, num_cars, num_floors, capacity)
    x, num = np.zeros(num_inputs(num_floors)), 0
    while (car := advance(building, np.inf)) != ENDED:
        second, number, floor, stop, expected = decided[num]
        assert (car, building.floor[car]) == (number, floor)
        assert building.clock[SETTLED] == pytest.approx(second, abs=1e-9)
        write_inputs(building, car, x)
        assert np.allclose(x, expected, atol=1e-12)
        decide(building, car, stop)
        num += 1
    assert num == len(decided) == building.counts[COUNTED] and (num > 10 or num_floors == 3)
    for ours, theirs in ((building.boarded, "boarded"), (building.left, "left")):
        assert np.allclose(ours, [getattr(person, theirs) for person in slow.people], rtol=0, atol=1e-9)
    assert building.cost[-1] == pytest.approx(slow.cost(), rel=1e-9)
    assert building.clock[NUM_WAITING] == 0 == building.waiting.sum() == building.aboard.sum()


def test_integrals_are_those_of_quadrature_for_short_and_long_stretches() -> None:
    for beta in (0.01, 1.0):
        for seconds in (0.0, 1e-9, 1e-4, 0.3, 0.99 / beta, 1.0 / beta, 1.01 / beta, 7.0, 300.0):
            *integrals, e = discounted_powers(seconds, beta)
            assert e == math.exp(-beta * seconds)
            for power, integral in enumerate(integrals):
                expected, _ = quad(
                    lambda t, n=power, b=beta: t**n * math.exp(-b * t), 0, seconds, epsabs=0, epsrel=1e-13
                )
                assert integral == pytest.approx(expected, rel=1e-11, abs=0)


def test_accounts_are_what_quadrature_says() -> None:
    assert 0 < oracle.cost_error(num_decisions=120, seed=3) < 1e-9
    building = open_building(MINI, 2, 6, beta=0.3, scale=2.0)
    play(building, new_controller(controllers.HUFF, 2, 6), np.inf)
    expected = sum(
        quad(lambda t, a=a: math.exp(-0.3 * t) * (t - a) ** 2, a, b, epsrel=1e-12)[0]
        for a, b in zip(building.arrival, building.boarded, strict=True)
    )
    assert building.cost[-1] == pytest.approx(2.0 * expected, rel=1e-9)


def test_a_paused_building_goes_on_as_if_nothing_had_been() -> None:
    passengers = hour_of(0, 10, 1.0)
    whole, parts = open_building(passengers), open_building(passengers)
    play(whole, new_controller(controllers.LQF), np.inf)
    controller = new_controller(controllers.LQF)
    for second in np.arange(0.0, 2000.0, 0.7):
        play(parts, controller, second)
        assert not (parts.boarded > second).any() and not (parts.arrival[parts.waiting.sum() :] < 0).any()
    assert np.array_equal(whole.boarded, parts.boarded) and advance(parts, 1e9) == ENDED
    assert advance(open_building(passengers), 0.0) == PAUSED
    ties = open_building(MINI, 2, 6)
    assert advance(ties, 0.0) == PAUSED and ties.waiting.tolist() == [0, 1, 2, 0, 1, 2]  # a second includes its moment
    write_inputs(ties, advance(ties, np.inf), x := np.zeros(27))
    assert x[-3:].tolist() == [0, 1, 1]  # on floor 1: of those who have waited equally long, the lowest floor
    rewind(parts)
    for ours, fresh in zip(parts, open_building(passengers), strict=True):
        assert np.array_equal(ours, fresh, equal_nan=True) or ours is parts.behind or ours.shape in ((10,), (4,))
    play(parts, new_controller(controllers.LQF), np.inf)
    assert np.array_equal(whole.left, parts.left) and np.array_equal(whole.cost, parts.cost)


# --------------------------------------------------------------------------------------------------- the mini building


def test_the_mini_building_has_the_published_optimum_and_nobody_is_below_it() -> None:
    slowly = all_sequences()
    optimum, num_sequences = oracle.brute_force()
    assert optimum == pytest.approx(0.01367532, abs=5e-9)
    assert optimum == pytest.approx(min(slowly)[0], rel=1e-12) and num_sequences == len(set(slowly))
    costs = {rule: oracle.mini_cost(rule) for rule in range(controllers.ALWAYS_STOP, controllers.NETWORK)}
    # of another program with the same building (four of its figures; ours of the others)
    assert costs[controllers.HUFF] == pytest.approx(0.03051826, abs=5e-9)
    assert costs[controllers.LQF] == pytest.approx(0.04663334, abs=5e-9)
    assert costs[controllers.ALWAYS_STOP] == pytest.approx(0.12525, abs=5e-6)
    below = [*costs.values(), *(oracle.mini_network_cost(seed) for seed in range(3))]
    assert min(below) >= optimum - 1e-12
    assert any(
        math.isclose(oracle.mini_cost(controllers.RANDOM, seed), cost, rel_tol=1e-12)
        for seed in (1,)
        for cost, _ in slowly
    )


def test_tabular_smdp_q_learning_reaches_the_optimum_and_with_one_discount_for_all_it_does_not() -> None:
    optimum, _ = oracle.brute_force()
    assert oracle.tabular_cost() == pytest.approx(optimum, rel=1e-12)
    env = ElevatorsEnv(num_cars=2, num_floors=6, passengers=np.stack([MINI.arrival, MINI.origin], axis=1))
    env.reset()
    total, discount, terminated = float(env.building.cost[-1]), float(env.building.discount[-1]), False
    for action in min(all_sequences())[1]:
        _, reward, terminated, _, said = env.step(action)
        total -= discount * reward
        discount *= said["discount"]
    assert terminated and total == pytest.approx(optimum, rel=1e-12)


# -------------------------------------------------------------------------------------------------------- environment


def test_the_environment_is_one_of_gymnasiums() -> None:
    env = gymnasium.make("neuralq/Elevators-v0", render_mode="rgb_array")
    check_env(env.unwrapped)
    assert env.observation_space.shape == (47,)
    first, said = env.reset(seed=5)
    again, _ = gymnasium.make("neuralq/Elevators-v0").reset(seed=5)
    assert np.array_equal(first, again) and said["second"] > 0 and env.render().shape == (404, 422, 3)
    text = ElevatorsEnv("ansi", num_cars=2, num_floors=4, passengers=[(0, 2), (0, 3), (1, 2)])
    assert text.render() is None
    text.reset()
    assert text.render().splitlines() == [
        " 3 |      |      | 1 waiting, 3 s", " 2 | ?0^  |      | 2 waiting, 3 s", " 1 |      |  0^  |",
        " 0 |      |      |", "3 s, 0 of 3 have arrived",
    ]  # fmt: skip


@pytest.mark.parametrize("num_steps", [5000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_environment_keeps_its_word_for_many_random_steps(num_steps: int) -> None:
    env = ElevatorsEnv(num_cars=3, capacity=5)
    rng = np.random.default_rng(0)
    x, said = env.reset(seed=0)
    hours, latest, paid = 0, said["second"], 0.0
    for action in rng.integers(2, size=num_steps).tolist():
        b = env.building
        come = b.arrival <= b.clock[SETTLED]
        waits, rides = come & np.isnan(b.boarded), ~np.isnan(b.boarded) & np.isnan(b.left)
        assert (
            waits.sum() == b.waiting.sum() == b.clock[NUM_WAITING]
        )  # everybody is on a floor, in a car, or has arrived
        assert rides.sum() == b.aboard.sum() and b.aboard.max() <= 5
        assert 0 <= b.floor.min() and b.floor.max() <= 9 and b.waiting[0] == 0
        standing = b.floor[b.phase >= 3]
        assert len(set(standing[standing > 0])) == np.count_nonzero(standing)  # no two at one floor above the lobby
        car = said["car"]
        assert b.waiting[b.floor[car]] > 0 and b.aboard[car] < 5 and x in env.observation_space
        x, reward, terminated, truncated, said = env.step(action)
        assert said["duration"] == pytest.approx(said["second"] - latest, abs=1e-9) and reward <= 0 and not truncated
        assert said["discount"] == pytest.approx(math.exp(-0.01 * said["duration"]), rel=1e-9)
        latest, paid = said["second"], paid + reward
        if terminated:
            assert (b.boarded >= b.arrival).all() and (b.left > b.boarded).all() and said["average_wait"] > 10
            with pytest.raises(ResetNeeded, match="call reset"):
                env.step(0)
            x, said = env.reset()
            hours, latest = hours + 1, said["second"]
    assert hours >= num_steps // 1500 and paid < 0


def test_options_give_passengers_and_nonsense_is_refused() -> None:
    env = ElevatorsEnv(num_cars=1, num_floors=4)
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(0)
    _, said = env.reset(options={"passengers": [(0, 2), (0, 3)]})
    assert said["second"] == pytest.approx(2.9)
    with pytest.raises(ValueError, match="action must be 0"):
        env.step(2)
    # Who comes at the very moment at which a car passes is seen: there is something further on.
    assert env.reset(options={"passengers": [(0, 2), (2.9, 3)]})[1]["second"] == 1.45 + 1.45
    for passengers in ([(0, 4)], [(0, 0)]):
        with pytest.raises(ValueError, match="must wait on floors 1 to 3"):
            env.reset(options={"passengers": passengers})
    with pytest.raises(ValueError, match="nothing to decide"):
        env.reset(options={"passengers": [(0, 3)]})
    with pytest.raises(ValueError, match="nothing to decide"):
        ElevatorsEnv(passengers_per_five_minutes=[1e-9]).reset(seed=0)


# ------------------------------------------------------------------------------------------------------------ learning


class Plain:
    """The network in torch, with gradients from autograd."""

    def __init__(self, network: SmdpNetwork) -> None:
        self.parts = [torch.tensor(part, requires_grad=True) for part in (network.w, network.b, network.v, network.c)]

    def values(self, x: Any) -> torch.Tensor:
        w, b, v, c = self.parts
        return v @ torch.sigmoid(torch.as_tensor(x) @ w + b) + c

    def update(self, x: Any, a: int, target: float, step_size: float, max_error: float) -> float:
        q = self.values(x)[a]
        error = target - float(q.detach())
        for part, gradient in zip(self.parts, torch.autograd.grad(q, self.parts), strict=True):
            with torch.no_grad():
                part += step_size * min(max(error, -max_error), max_error) * gradient
        return error


def plain_hour(
    building: Building, plain: Plain, step_size: float, max_error: float, temperature: float, rng: Any
) -> float:
    """As `learn_hour`, with costs from the building's account since the latest decision of any car."""
    latest: dict[int, tuple[Any, int, float]] = {}
    paid, discount = np.zeros(len(building.floor)), np.ones(len(building.floor))
    total, before, ends = 0.0, 0.0, False
    while not ends:
        car = advance(building, np.inf)
        ends = car == ENDED
        now = float(building.clock[SETTLED])
        paid += discount * building.cost[-2]
        discount *= math.exp(-0.01 * (now - before))
        open_account(building, -2)
        before = now
        for c in sorted(latest) if ends else [car]:
            x = np.zeros(num_inputs(len(building.waiting)))
            q = torch.zeros(2, dtype=torch.float64)
            if not ends:
                write_inputs(building, c, x)
                q = plain.values(x).detach()
            if c in latest:
                x_tm1, a_tm1, then = latest[c]
                target = -paid[c] + math.exp(-0.01 * (now - then)) * float(q.max())
                total += abs(plain.update(x_tm1, a_tm1, target, step_size, max_error))
            if not ends:
                stop = float(uniform(rng)) < float(torch.softmax(q / temperature, 0)[1])
                latest[c] = (x, int(stop), now)
                paid[c], discount[c] = 0.0, 1.0
                decide(building, c, stop)
    return total


@pytest.mark.parametrize("max_error", [0.01, np.inf])
def test_an_hour_of_learning_is_that_in_plain_python(max_error: float) -> None:
    passengers = hour_of(2, 10, 0.6)
    network = new_smdp_network(47, 5, 2, np.random.default_rng(0), scale=0.5)
    plain = Plain(network)
    expected = plain_hour(open_building(passengers), plain, 0.05, max_error, 0.2, new_stream(7))
    begun = network.flat.copy()
    total = learn_hour(open_building(passengers), network, new_memory(4, 10), 0.05, max_error, 0.2, new_stream(7))
    assert total == pytest.approx(expected, rel=1e-7) and np.abs(network.flat - begun).max() > 0.01
    for ours, theirs in zip((network.w, network.b, network.v, network.c), plain.parts, strict=True):
        assert np.allclose(ours, theirs.detach(), rtol=0, atol=1e-8)


def test_a_training_keeps_the_average_of_its_last_weights_and_repeats_itself() -> None:
    seed = np.random.SeedSequence(3)
    watched = held_out_hours(seed, 1)

    def trained(num_hours: int, averaged: float) -> Training:
        # without annealing, the first hours of a longer training are those of a shorter one
        steady = {"step_size": (0.02, 0.02), "temperature": (0.1, 0.1)}
        return train(seed, Settings(num_hours, num_drawn=1, averaged=averaged, **steady), watched)

    fourth, fifth, averaged = (trained(*given) for given in ((4, 1e-9), (5, 1e-9), (5, 0.4)))
    mean = (fourth.network.flat + fifth.network.flat) / 2
    assert np.allclose(averaged.network.flat, mean, rtol=0, atol=1e-14) and not np.array_equal(
        mean, fourth.network.flat
    )
    assert averaged.hours.tolist() == [1, 2, 3, 4, 5] and len(averaged.squared) == 5
    assert averaged.squared[-1] == measure(new_controller(controllers.NETWORK, network=fifth.network), watched).squared
    with pytest.raises(ValueError, match="num_hours must be"):
        Settings(0)
    with pytest.raises(ValueError, match="beta must be positive"):
        Settings(beta=-1.0)
    with pytest.raises(ValueError, match="temperature must be"):
        Settings(temperature=(0.3, 0.0))


def test_waits_are_counted_as_they_say() -> None:
    waits = Waits(np.array([10.0, 61.0, 60.0, 3.0]), np.array([0, 0, 1, 1]), np.array([20.0, 70.0, 80.0, 9.0]))
    assert (waits.average, waits.long_percent) == (33.5, 25.0) and waits.squared == (100 + 3721 + 3600 + 9) / 4
    assert waits.squared_by_hour.tolist() == [(100 + 3721) / 2, (3600 + 9) / 2]
    seeds = np.random.SeedSequence(0).spawn(2)
    first, again, other = (held_out_hours(seed, 1)[0].arrival[:5].tolist() for seed in (seeds[0], seeds[0], seeds[1]))
    assert first == again != other


def test_rules_of_thumb_do_what_they_say() -> None:
    """In a building of 5 floors, with people on floors 1 to 4, of whom somebody has waited longest on 2."""
    people = given_passengers([(0, 2), (1, 1), (1, 3), (1, 4)])

    def first_decisions(rule: int, num_cars: int) -> list[tuple[int, int, bool]]:
        building, found = open_building(people, num_cars, 5), []
        controller = new_controller(rule, num_cars, 5)
        while (car := advance(building, np.inf)) != ENDED:
            before = building.clock[SETTLED]
            stop = bool(controllers._stops(building, car, controller))
            found.append((car, int(building.floor[car]), stop))
            assert building.clock[SETTLED] == before
            decide(building, car, stop)
        return found

    assert first_decisions(controllers.LQF, 1)[:2] == [(0, 1, False), (0, 2, True)]
    assert first_decisions(controllers.HUFF, 1) == [
        (0, 1, False),
        (0, 2, False),
        (0, 3, False),
        (0, 3, True),
        (0, 2, True),
        (0, 1, True),
    ]
    assert first_decisions(controllers.NEAREST, 1) == first_decisions(controllers.HUFF, 1)
    assert first_decisions(controllers.ALWAYS_STOP, 1)[0] == (0, 1, True)
    sectors = first_decisions(controllers.SECTOR, 2)  # floors 1 and 2 are the first car's
    assert all(stop == ((floor > 2) == (car == 1)) for car, floor, stop in sectors) and len(sectors) > 4
    top_first = first_decisions(controllers.SECTOR_TOP, 2)
    assert (0, 1, False) in top_first and (0, 2, True) in top_first


def test_calls_belong_to_sectors_or_to_the_car_with_the_fewest_floors_to_go() -> None:
    whole = open_building(hour_of(0, 10, 1.0))
    assert [int(controllers._sector(whole, f)) for f in range(1, 10)] == [0, 0, 0, 1, 1, 2, 2, 3, 3]
    b = open_building(MINI, 4, 6)
    b.floor[:], b.phase[:], b.direction[:], b.aboard[:] = [3, 3, 3, 2], [0, 2, 2, 2], [1, 1, -1, 1], [0, 0, 2, 0]
    assert [[int(controllers._floors_to_go(b, c, f)) for f in range(6)] for c in range(4)] == [
        [3, 2, 1, 0, 1, 2],  # parked
        [7, 6, 5, 0, 1, 2],  # on its way up, it turns at the top
        [3, 2, 1, 0, 7, 8],  # on its way down, at the lobby
        [8, 7, 0, 1, 2, 3],
    ]
    mini, controller = open_building(MINI, 2, 6), new_controller(controllers.NEAREST, 2, 6)
    assert advance(mini, np.inf) == 0  # it is at floor 1, the other still on its way there
    controllers._assign(mini, controller)
    # Floor 1: 0 against 1. Floor 2: 1 + 1 against 2. Floor 4: 3 + 2 against 4. Floor 5: 4 + 2 against 5 + 1.
    assert controller.owner[[1, 2, 4, 5]].tolist() == [0, 0, 1, 0] and controller.owned.tolist() == [-1, 5, 3, -1, 2, 0]


def test_a_film_shows_cars_where_they_are_and_people_as_long_as_they_wait() -> None:
    passengers = given_passengers([(0, 3), (4, 2), (70, 9)])
    scene = record("three", new_controller(controllers.LQF), passengers, 2.0, 90.0)
    building = open_building(passengers)
    play(building, new_controller(controllers.LQF), np.inf)
    assert scene.arrival.tolist() == [0, 4, 70] and np.allclose(scene.boarded[:2], building.boarded[:2])
    assert (
        scene.height.shape == (89, 4) and scene.height[0, 0] == pytest.approx(2.0 / 1.45) and scene.load.max() == 0.05
    )
    film = elevator_film("lift", [scene, scene])
    assert film.count("<circle") == 6 and film.count("<svg") == 2 and "@@" not in film and "nan" not in film
    assert film.count("opacity:0}") == 2 * (2 * 2 + 1)  # before they come, but for the first, and after they have gone


# ------------------------------------------------------------------------------------------ what it must reach, and not


@pytest.mark.slow
def test_the_network_waits_less_than_every_rule_of_thumb_and_with_a_fault_it_always_stops() -> None:
    found = run_system(system_named("elevators"))
    squared, average = (
        {one.what.partition(":")[0]: np.array(one.values) for one in found.measured if unit in one.what}
        for unit in ("squared wait", "mean wait (s)")
    )
    ours = squared[LEARNED]
    assert len(ours) == 5 and set(squared) == set(CONTENDERS)
    reached = (
        (ours <= 0.93 * squared["LQF"]) & (ours <= 0.82 * squared["HUFF"]) & (ours <= 0.25 * squared["sector"])
        & (average[LEARNED] <= 17.0)
    )  # fmt: skip
    assert reached.sum() >= 4
    assert (ours <= 0.75 * squared["sector, top first"]).sum() >= 4  # the bound of sectors is easy: this one is not
    assert (squared[MYOPIC] > 0.8 * squared["always stop"]).sum() >= 4
    assert (squared[UNCLIPPED] > 0.8 * squared["always stop"]).sum() >= 4
    assert not found.wrong and set(CONTROLS) == {MYOPIC, UNCLIPPED}
