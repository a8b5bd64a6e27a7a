"""The monitor of a run: it sees divergence where there is some, says so once, and changes nothing.

Mutants that die here: a kernel with its successors on the wrong side · successors after the end that count · the mean
of the next values for their maximum · a bound without the discount · rewards as they were scaled · an n-step reward
taken for a step's · an alarm at every row · one for values that only rise to their level · a generator shared with
the run · a look at padding rows · two monitors of one run, or none · more than its share of the CPU time.
"""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.lab.networks.sampled import diagnose_sample
from neuralq.lab.watch.advice import RunTraits, advise
from neuralq.lab.watch.growth import fit_growth
from neuralq.lab.watch.monitor import DivergenceMonitor, DivergenceWarning
from neuralq.learners import OnlineSettings, ReplaySettings, RolloutSettings
from neuralq.learners.learner import Update
from neuralq.q import MLP, ActionOutputQ, LinearQ, TableQ
from neuralq.runs import RunConfig, train
from neuralq.runs import loop as training
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.stream.experience import Sample
from neuralq.types import Transition
from neuralq_envs.counterexamples import star

TRAITS = RunTraits(gamma=0.9, step_size=0.1)


def transitions(s: Any, s_t: Any, r: Any = 0.0, discount: Any = 0.9, a: Any = 0) -> Transition:
    s, s_t = (torch.from_numpy(np.array(x, np.float64)) for x in (s, s_t))
    n = len(s)
    reward, gamma = (torch.as_tensor(x, dtype=torch.float64).expand(n).clone() for x in (r, discount))
    action = torch.as_tensor(a).expand(n).clone()
    return Transition(s, action, torch.ones(n), reward, gamma, s_t, gamma == 0)


def w_to_2w(gamma: float) -> Transition:
    return transitions([[1.0], [2.0]], [[2.0], [2.0]], discount=gamma)


def row(steps: int, error: float = 1.0, max_abs_q: float = 1.0, **more: Any) -> dict[str, Any]:
    columns = {"abs_td_error": error, "max_abs_q": max_abs_q}
    return {"kind": "train", "env_steps": steps, "num_updates": steps, **columns, **more}


def quiet(monitor: DivergenceMonitor, *rows: dict[str, Any]) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for each in rows:
            monitor(each)
    assert all(issubclass(one.category, DivergenceWarning) for one in caught)
    return [alarm.kind for alarm in monitor.alarms]


# The kernel on a sample


@pytest.mark.parametrize(("gamma", "verdict"), [(0.9, "grows"), (0.8, "shrinks")])
def test_w_to_2w_on_both_sides_of_five_sixths(gamma: float, verdict: str) -> None:
    """Uniform updates: A = (5 − 6γ)/2 (Sutton & Barto 2018, exercise 11.1)."""
    found = diagnose_sample(LinearQ(1, 1), w_to_2w(gamma), step_size=0.1)
    assert (found.verdict, found.rank, found.scope) == (verdict, 1, "local")
    assert found.min_real_eigenvalue == pytest.approx((5 - 6 * gamma) / 2)
    assert found.growth == pytest.approx(1 - 0.1 * (5 - 6 * gamma) / 2)
    assert found.overlap == pytest.approx((2 + 1) / 2)  # K'/K: 2 · 1 / 1 and 2 · 2 / 4


def test_the_share_of_the_discount_and_the_bound_on_the_step() -> None:
    found = diagnose_sample(LinearQ(1, 1), w_to_2w(0.95), step_size=0.1)
    assert found.discount_share == pytest.approx(5 / 6 / 0.95, abs=0.02)
    slow = diagnose_sample(LinearQ(1, 1), w_to_2w(0.5), step_size=3.0)
    assert slow.verdict == "step size too large" and slow.step_size_bound == pytest.approx(2 / 1)  # A = 1
    assert "below 2 their errors" in slow.explain() and "whatever the step" in found.explain()


def test_all_transitions_of_the_star_give_the_stars_own_eigenvalues() -> None:
    x = star().features
    found = diagnose_sample(LinearQ(8, 1), transitions(x, np.tile(x[6], (7, 1)), discount=0.99), step_size=0.01)
    assert found.min_real_eigenvalue == pytest.approx(-0.2392504643, abs=1e-9)
    assert found.growth == pytest.approx(1.0023925, abs=5e-8)
    assert found.rank == 7 and found.verdict == "grows"
    twice = diagnose_sample(
        LinearQ(8, 1), transitions(np.tile(x, (2, 1)), np.tile(x[6], (14, 1)), discount=0.99), step_size=0.01
    )
    assert twice.growth == pytest.approx(found.growth, abs=1e-9) and twice.rank == 7  # duplicates add nothing


def gradients(q: Any, values: torch.Tensor) -> torch.Tensor:
    parameters = list(q.parameters())
    rows = [torch.autograd.grad(value, parameters, retain_graph=True) for value in values]
    return torch.stack([torch.cat([part.reshape(-1) for part in row]) for row in rows])


def test_errors_of_a_sample_follow_the_kernel() -> None:
    """One gradient step on ½ mean δ², with the errors before and after it measured."""
    rng = np.random.default_rng(0)
    step = transitions(
        rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), rng.normal(size=6), [0.9] * 5 + [0.0], [0, 1] * 3
    )
    mismatch = []
    for alpha in (1e-3, 1e-4):
        q = ActionOutputQ((3,), 2, body=MLP((5,), activation="tanh"), rng=0, dtype=torch.float64)

        def errors(q: Any = q) -> torch.Tensor:
            target: torch.Tensor = step.r_t + step.discount_t * q.all(step.s_t).max(-1).values
            return target.detach() - q.at(step.s_tm1, step.a_tm1)

        before = errors()
        grads = torch.autograd.grad(0.5 * (before**2).mean(), list(q.parameters()))
        found = diagnose_sample(q, step, alpha)
        assert found.mean_error == pytest.approx(float(before.detach().abs().mean()))
        here = gradients(q, q.at(step.s_tm1, step.a_tm1))
        there = gradients(q, q.at(step.s_t, q.all(step.s_t).argmax(-1)))
        matrix = (here @ here.T - step.discount_t[:, None] * (there @ here.T)) / 6
        eigenvalues = torch.linalg.eigvals(matrix)
        assert found.min_real_eigenvalue == pytest.approx(float(eigenvalues.real.min()), abs=1e-9)
        with torch.no_grad():
            for p, g in zip(q.parameters(), grads, strict=True):
                p -= alpha * g
        told = before - alpha * matrix @ before
        mismatch.append(float((errors() - told).detach().abs().max()))
    assert mismatch[0] / mismatch[1] == pytest.approx(100, rel=0.1)  # second order in α


def test_a_table_has_no_overlap_and_masked_ends_do_not_count() -> None:
    index = torch.arange(4)
    one, gamma = torch.ones(4), torch.tensor([0.9, 0.9, 0.9, 0.0])
    step = Transition(index, 0 * index, one, one, gamma, (index + 1) % 4, index == 3)
    found = diagnose_sample(TableQ(4, 1), step, 0.5)
    # I − γN with N nilpotent: all eigenvalues are 1/4, in one Jordan block, hence ε^(1/4).
    assert found.overlap == 0.0 and found.min_real_eigenvalue == pytest.approx(0.25, abs=1e-3)
    assert found.verdict == "shrinks" and found.mean_error == 1.0
    with pytest.raises(ValueError, match="at least 2 transitions, got 1"):
        diagnose_sample(TableQ(4, 1), step.map(lambda x: x[:1]), 0.5)


# Growth


def test_growth_is_fitted_and_told_from_learning() -> None:
    x = np.arange(20.0)
    diverging = fit_growth(x, np.exp(0.3 * x))
    assert diverging is not None and diverging.explosive
    assert diverging.doubling == pytest.approx(np.log(2) / 0.3) and diverging.fit == pytest.approx(1.0)
    learning = fit_growth(x, 100 * (1 - np.exp(-0.2 * (x + 0.1))))
    assert learning is not None and learning.rise > 3 and not learning.explosive
    assert not fit_growth(x, np.exp(0.05 * x)).explosive  # type: ignore[union-attr]
    noise = fit_growth(x, np.random.default_rng(0).lognormal(sigma=3.0, size=20))
    assert noise is not None and not noise.explosive
    assert fit_growth([1, 2, 3], [1, 2, 3]) is None and fit_growth(x, np.full(20, np.nan)) is None
    flat = fit_growth(x, np.ones(20))
    assert flat is not None and flat.doubling is None and flat.rise == 1.0


# Alarms


def test_soft_divergence_is_said_once_with_the_bound() -> None:
    monitor = DivergenceMonitor(TRAITS, largest_reward=2.0, margin=1.0)
    assert monitor.bound == pytest.approx(20)
    assert quiet(monitor, row(1, max_abs_q=20.0)) == []
    assert quiet(monitor, row(2, max_abs_q=20.5), row(3, max_abs_q=30.0)) == ["soft divergence"]
    assert monitor.alarms[0].env_steps == 2 and "20.5" in monitor.alarms[0].message
    assert quiet(DivergenceMonitor(TRAITS, largest_reward=2.0), row(1, max_abs_q=21.9)) == []  # within the margin
    assert DivergenceMonitor(RunTraits(gamma=1.0, step_size=0.1), largest_reward=2.0).bound is None


def test_all_is_told_in_the_units_of_the_environment() -> None:
    """Rewards that the stream multiplied by 4 and the learner by 0.1: 2 and 8 in what it is shown are 0.5 and 2."""
    traits = RunTraits(gamma=0.9, step_size=0.1, reward_scale=0.1)
    assert DivergenceMonitor(traits, largest_reward=2.0).bound == pytest.approx(20)
    monitor = DivergenceMonitor(traits, margin=1.0)
    for reward in (2.0, 8.0, 4.0):
        shown = transitions([[1.0]] * 2, [[1.0]] * 2, r=[0.0, reward])
        monitor.observe(learner_of(LinearQ(1, 1)), Sample(shown, reward_scale=4.0))
    assert monitor.bound == pytest.approx(20)
    assert quiet(monitor, row(1, max_abs_q=19.5)) == []
    assert "was 19.5; by the rewards of the same steps no return exceeds 20." in monitor.explain()
    assert (monitor.verdict()["largest_value"], monitor.report()["bound"]) == (19.5, pytest.approx(20))
    assert quiet(monitor, row(2, max_abs_q=20.5)) == ["soft divergence"]
    assert "|Q| is 20.5" in monitor.alarms[0].message and "r_max/(1 − γ) = 20." in monitor.alarms[0].message


@pytest.mark.parametrize("scaled", [{"reward_scale": 0.01}, {"learner": "streaming"}], ids=["scaled", "normalised"])
def test_what_it_says_of_values_repeats_and_is_of_the_values(scaled: dict[str, Any], tmp_path: Path) -> None:
    """CartPole's rewards are all 1, so no return exceeds 1/(1 − γ) however they are scaled for learning."""
    config = RunConfig(
        total_steps=256, log_every=32, evaluate_every=256, evaluation_episodes=1, gamma=0.9, body=MLP((8,)), **scaled
    )
    one, two = (train(config, tmp_path / name).monitor for name in ("one", "two"))
    assert one is not None and two is not None
    assert one["bound"] == two["bound"] == pytest.approx(10, rel=1e-3)
    rows = [row for row in read_metrics(tmp_path / "one") if row["kind"] == "train"]
    assert one["largest_value"] == two["largest_value"] == max(row.get("max_abs_q", 0.0) for row in rows) > 0


def test_the_largest_value_of_an_update_is_that_of_its_pairs() -> None:
    """Q = target − δ: 2 − 1 and −4 + 2.5."""
    seen = Update(torch.tensor([1.0, -2.5]), torch.tensor([2.0, -4.0])).metrics()
    assert (seen["max_abs_q"], seen["max_q"]) == (1.5, 2.0)


def test_growth_is_said_once_for_each_measure_and_not_below_the_bound() -> None:
    rows = [row(i, error=np.exp(0.3 * i), max_abs_q=np.exp(0.2 * i)) for i in range(30)]
    monitor = DivergenceMonitor(TRAITS)
    assert quiet(monitor, *rows) == ["growth of abs_td_error", "growth of largest_value"]
    assert "doubles every 2.31 updates" in monitor.alarms[0].message
    low = [row(i, error=1e-6 * np.exp(0.3 * i), max_abs_q=1e-6 * np.exp(0.2 * i)) for i in range(30)]
    assert quiet(DivergenceMonitor(TRAITS, largest_reward=1.0), *low) == []  # values that start at 0 have to grow
    decay = [row(i, error=np.exp(-0.3 * i)) for i in range(30)]
    assert quiet(DivergenceMonitor(TRAITS), *decay) == []


def test_numbers_that_are_no_longer_finite_are_said_and_kept_out_of_the_report() -> None:
    monitor = DivergenceMonitor(TRAITS, largest_reward=1.0)
    kinds = quiet(monitor, row(1), row(2, error=np.nan, max_abs_q=np.inf), row(3, error=np.inf))
    assert kinds == ["not finite"]
    monitor.inspect(LinearQ(1, 1), transitions([[0.0]] * 2, [[0.0]] * 2))  # nothing can move: every step size will do
    json.dumps(monitor.report(), allow_nan=False)


def test_rows_of_other_kinds_and_without_measures_pass() -> None:
    monitor = DivergenceMonitor(TRAITS, largest_reward=1.0)
    assert (
        quiet(monitor, {"kind": "evaluation", "env_steps": 5, "greedy_return": 1e9}, {"kind": "train", "env_steps": 6})
        == []
    )
    assert monitor.report()["env_steps"] == 6 and "no alarm" in monitor.explain()


def test_the_kernel_alarm_needs_three_in_a_row() -> None:
    monitor = DivergenceMonitor(TRAITS)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for gamma in (0.9, 0.9, 0.8, 0.9, 0.9):
            monitor.inspect(LinearQ(1, 1), w_to_2w(gamma), env_steps=7)
        assert not caught
        monitor.inspect(LinearQ(1, 1), w_to_2w(0.9))
        monitor.inspect(LinearQ(1, 1), w_to_2w(0.9))
    assert len(caught) == 1 and [alarm.kind for alarm in monitor.alarms] == ["kernel"]
    assert "a target network" in str(monitor.alarms[0])
    report = json.loads(json.dumps(monitor.report(), allow_nan=False))
    assert [one["verdict"] for one in report["kernels"]] == [
        "grows",
        "grows",
        "shrinks",
        "grows",
        "grows",
        "grows",
        "grows",
    ]
    large = DivergenceMonitor(RunTraits(gamma=0.5, step_size=3.0))
    with pytest.warns(DivergenceWarning, match="a step size below 2"):
        for _ in range(3):
            large.inspect(LinearQ(1, 1), w_to_2w(0.5))
    adaptive = DivergenceMonitor(RunTraits(gamma=0.5, step_size=3.0, plain_steps=False))
    for _ in range(3):
        adaptive.inspect(LinearQ(1, 1), w_to_2w(0.5))  # Adam's step size says nothing by itself


def learner_of(q: Any) -> Any:
    return SimpleNamespace(engine=SimpleNamespace(q=q))


def test_the_bound_is_found_from_rewards_and_n_steps_are_seen_through() -> None:
    q = LinearQ(1, 1)
    one = DivergenceMonitor(TRAITS)
    one.observe(learner_of(q), Sample(transitions([[1.0]] * 2, [[1.0]] * 2, r=[0.5, -2.0])))
    assert one.bound == pytest.approx(2.0 / 0.1)
    three = DivergenceMonitor(TRAITS)  # 1 + γ + γ² over three steps, discounted by γ³
    three.observe(learner_of(q), Sample(transitions([[1.0]] * 2, [[1.0]] * 2, r=1 + 0.9 + 0.81, discount=0.9**3)))
    assert three.bound == pytest.approx(1.0 / 0.1)


def test_padding_rows_are_not_looked_at_and_single_steps_are_collected() -> None:
    q = LinearQ(1, 1)
    with torch.no_grad():
        q.weight.fill_(1.0)
    monitor = DivergenceMonitor(TRAITS, num_samples=8, every=1)
    padded = transitions([[1.0], [1e6]], [[1.0], [1e6]], r=[1.0, 1e6])
    monitor.observe(learner_of(q), Sample(padded, torch.tensor([1.0, 0.0])))
    assert quiet(monitor, row(1)) == [] and monitor.bound == pytest.approx(10)
    assert monitor.diagnoses == []
    monitor.observe(learner_of(q), Sample(padded, torch.zeros(2)))  # nothing at all
    for _ in range(7):
        monitor.observe(learner_of(q), Sample(transitions([[1.0]], [[0.5]], r=1.0)))
        monitor(row(2))
    assert [one.num_samples for _, one in monitor.diagnoses] == [8]


def test_a_module_that_cannot_be_differentiated_this_way_stops_nothing() -> None:
    class Awkward(LinearQ):
        def at(self, s: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(super().at(s, a).numpy())  # refused where a gradient is wanted

    monitor = DivergenceMonitor(TRAITS, every=1)
    monitor.observe(learner_of(Awkward(1, 1)), Sample(transitions([[1.0]] * 9, [[1.0]] * 9)))
    assert quiet(monitor, row(1)) == [] and monitor.unavailable is not None
    assert "could not be computed" in monitor.explain()


# In a run

CONFIGS = {
    "rollout": RunConfig(
        total_steps=512, log_every=64, evaluate_every=200, evaluation_episodes=1, checkpoint_every=300,
        rollout=RolloutSettings(num_envs=4, num_steps=8), body=MLP((8,)),
    ),
    "replay": RunConfig(
        learner="replay", total_steps=300, log_every=20, evaluate_every=200, evaluation_episodes=1,
        replay=ReplaySettings(learning_starts=64, batch_size=16, prioritised=True), body=MLP((8,)), engine="torch",
    ),
    "online": RunConfig(
        learner="online", layout="linear", total_steps=200, log_every=10, evaluate_every=100, evaluation_episodes=1,
        online=OnlineSettings(step_size=0.01),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", CONFIGS)
def test_a_watched_run_ends_with_the_same_bits(kind: str, tmp_path: Path) -> None:
    config = CONFIGS[kind]
    monitor = DivergenceMonitor(RunTraits.of(config), largest_reward=1.0, num_samples=8, every=1)
    watched = train(config, tmp_path / "watched", [monitor])
    alone = train(config, tmp_path / "alone")
    assert watched.parameters_sha256 == alone.parameters_sha256
    assert watched.greedy_return == alone.greedy_return
    assert monitor.unavailable is None and len(monitor.diagnoses) >= 3
    assert {alarm.kind for alarm in monitor.alarms} <= {"kernel"} and monitor.report()["largest_value"] > 0
    json.dumps(monitor.report(), allow_nan=False)
    for _, found in monitor.diagnoses:
        assert np.isfinite([found.growth, found.min_real_eigenvalue, found.overlap, found.step_size_bound]).all()


def test_every_run_is_watched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[DivergenceMonitor] = []
    init = DivergenceMonitor.__init__
    monkeypatch.setattr(
        DivergenceMonitor, "__init__", lambda self, *a, **k: (made.append(self), init(self, *a, **k))[1]
    )
    config = CONFIGS["rollout"]
    run = train(config, tmp_path / "watched")
    assert len(made) == 1 and run.monitor is not None and run.monitor["alarms"] == []
    assert "steps watched: no alarm" in run.monitor["seen"]
    assert all(row["alarm"] is None for row in read_metrics(tmp_path / "watched"))
    mine = DivergenceMonitor.of(config)  # as --hook neuralq.lab:DivergenceMonitor makes it
    assert train(config, tmp_path / "twice", [mine]).monitor is not None and made[1:] == [mine]
    alone = train(dataclasses.replace(config, monitor=False), tmp_path / "alone")
    assert len(made) == 2 and alone.monitor is None and alone.parameters_sha256 == run.parameters_sha256
    assert "alarm" not in read_metrics(tmp_path / "alone")[0]


def test_unasked_it_spends_no_more_than_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only its own work moves: looks cost 0.001 s, kernels 0.1 s, and the run 0.2 s between two rows."""
    now = [0.0]
    monkeypatch.setattr("neuralq.lab.watch.monitor.time.process_time", lambda: now[0])
    monitor = DivergenceMonitor.sparing(RunConfig())
    looks, kernels = [0], [0]

    def observe(learner: Any, sample: Any) -> None:
        looks[0] += 1
        now[0] += 0.001
        if monitor._affords(monitor._kernel_seconds):
            kernels[0] += 1
            monitor._kernels += 1
            now[0] += 0.1

    monkeypatch.setattr(monitor, "_observe", observe)
    monkeypatch.setattr(monitor, "_note_rewards", lambda sample: None)
    for k in range(1, 401):
        monitor.observe(None, None)  # type: ignore[arg-type]
        quiet(monitor, {**row(k), "cpu_seconds": 0.2 * k})
        assert monitor.cpu_seconds <= 0.02 * 0.2 * k
    assert looks[0] > 300 and 5 <= kernels[0] <= 16 and monitor.cpu_seconds > 0.01 * 80


def test_what_was_said_is_remembered_by_a_resumed_run() -> None:
    first = DivergenceMonitor(TRAITS, largest_reward=1.0, every=1)
    assert quiet(first, row(1, max_abs_q=50.0)) == ["soft divergence"]
    first.observe(learner_of(LinearQ(1, 1)), Sample(w_to_2w_rows()))
    quiet(first, row(1))
    assert first.columns() == {"alarm": "soft divergence"} and first.verdict()["advice"][0] == "a target network"
    again = DivergenceMonitor(TRAITS, largest_reward=1.0)
    again.load_state_dict(first.state_dict())
    assert again.verdict()["alarms"] == ["soft divergence"] and again.report()["kernels"] == first.report()["kernels"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again({**row(2, max_abs_q=60.0), "cpu_seconds": 100.0})
    assert len(again.alarms) == 1 and not again._run_seconds  # the hundred seconds were before it came


def w_to_2w_rows() -> Transition:
    return transitions([[1.0], [2.0]] * 4, [[2.0], [2.0]] * 4)


def test_an_explosion_is_never_left_out_for_its_cost() -> None:
    """What a fit would call explosive passes the cheap question before it, at the flattest curve that still is."""
    monitor = DivergenceMonitor(RunTraits(gamma=1.0, step_size=0.1))
    for k in range(20):
        monitor._rows.append((float(k), {"abs_td_error": 10.0 ** (k / 19)}))
    found = monitor.growth()
    assert found is not None and found.rise == pytest.approx(10.0) and monitor._may_explode("abs_td_error")
    monitor._rows.extend((float(k), {"abs_td_error": 1.0 + 0.01 * (k % 2)}) for k in range(20))
    assert not monitor._may_explode("abs_td_error")


def test_a_run_that_diverges_is_seen(tmp_path: Path) -> None:
    config = RunConfig(
        learner="online", layout="linear", total_steps=1200, log_every=16, evaluate_every=600, evaluation_episodes=1,
        online=OnlineSettings(step_size=0.5, lambda_=0.0),
    )  # fmt: skip
    monitor = DivergenceMonitor.of(config, largest_reward=1.0)
    with pytest.warns(DivergenceWarning):
        train(config, tmp_path / "run", [monitor])
    kinds = [alarm.kind for alarm in monitor.alarms]
    assert "soft divergence" in kinds and len(kinds) == len(set(kinds))
    assert "λ nearer 1" in monitor.explain() and "a target network" in monitor.explain()


def test_only_hooks_that_look_are_shown_the_learner(tmp_path: Path) -> None:
    seen: list[Any] = []

    class Looker:
        def observe(self, learner: Any, sample: Any) -> None:
            seen.append((learner.num_updates, sample.transition.a_tm1.shape))

        def __call__(self, row: Any) -> None:
            seen.append(row["kind"])

    assert isinstance(Looker(), training.Observer) and not isinstance(print, training.Observer)
    train(CONFIGS["online"], tmp_path / "run", [Looker(), lambda row: None])
    assert seen[0] == (1, (1,)) and seen[1] == "train"  # what was learned from, then the row
    assert seen[-1] == "evaluation" and seen[-2] == (200, (1,))


# Words


def test_traits_come_from_the_configuration() -> None:
    online = RunTraits.of(CONFIGS["online"])
    assert (online.plain_steps, online.lambda_, online.target_period, online.layer_norm) == (True, 0.8, None, None)
    replay = RunTraits.of(CONFIGS["replay"])
    assert (replay.plain_steps, replay.lambda_, replay.target_period, replay.layer_norm) == (False, 0.0, 500, False)
    assert replay.replay and not replay.double
    rollout = RunTraits.of(RunConfig(body=MLP((8,), layer_norm=True), reward_scale=0.5))
    assert (rollout.lambda_, rollout.layer_norm, rollout.reward_scale, rollout.target_period) == (0.65, True, 0.5, None)


def test_advice_leaves_out_what_is_done_already() -> None:
    done = advise(RunTraits(gamma=0.9, step_size=0.1, lambda_=1.0, target_period=10, layer_norm=True))
    assert done[0] == "a longer period of the target network (it is 10 updates)"
    assert not any("normalisation" in one or "λ" in one for one in done)
    unstable = diagnose_sample(LinearQ(1, 1), w_to_2w(0.95), step_size=0.1)
    told = advise(RunTraits(gamma=0.95, step_size=0.1, layer_norm=False, replay=True), unstable)
    assert any("turns stable near 0.8" in one for one in told)
    assert not any("smaller step size" in one for one in told)  # no step size helps
    assert any("double" in one for one in told) and any("MLP(layer_norm=True)" in one for one in told)


def test_broken_arguments_are_named() -> None:
    for arguments, message in [
        ({"margin": 0.5}, "margin must be at least 1"), ({"window": 3}, "window must be"),
        ({"num_samples": 1}, "num_samples must be"), ({"largest_reward": 0.0}, "largest_reward must be"),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=message):
            DivergenceMonitor(TRAITS, **arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="gamma must lie in"):
        RunTraits(gamma=1.5, step_size=0.1)
