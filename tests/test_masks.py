"""Illegal actions are neither taken nor believed: by no policy, and in no maximum or expectation of any learner.

The environment raises when an illegal action is stepped. The illegal action is made tempting: its value starts at 80 or
more while no return exceeds 5, so that a single maximum that sees it shows in the values of legal actions. A control
takes the mask off the targets alone and must be found out.

Mutants that must die here: `MaskedQ.all` without its −∞ · a mask method never asked, or asked before the step · bytes
turned into float32 by the mask · targets computed from unmasked values (the control).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq import rules
from neuralq.learners import GradientSettings, OnlineSettings, ReplaySettings, RolloutSettings, StreamingSettings
from neuralq.q import MLP, MaskedQ
from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.evaluation import evaluate_greedy
from neuralq.runs.folder.env_probe import Resumability, is_resumable
from neuralq.runs.recipe import build
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.presets import with_preset
from neuralq.runs.session import Session
from neuralq.runs.stream import Interaction, SubEnv, legal_actions, make_vector_env
from neuralq.runs.stream.acting import choose_epsilon_greedy, choose_greedy

LEGAL = np.array([[1, 1, 0], [0, 1, 0], [1, 1, 0]], np.int8)  # action 2 never, action 0 not in state 1
LENGTH = 5


class Tempting(gym.Env[Any, Any]):
    """Action a in state s pays 0.5·a and leads to (s + a + 1) mod 3, for five steps; what is illegal raises."""

    action_space = spaces.Discrete(3)

    def __init__(self, kind: str = "vector", told: str = "info") -> None:
        self.kind, self.told = kind, told
        high, dtype, shape = {
            "vector": (1.0, np.float32, (3,)), "bytes": (255, np.uint8, (4, 4)), "flags": (1, np.bool_, (4, 4, 2)),
        }.get(kind, (1.0, np.float32, (3,)))  # fmt: skip
        self.observation_space = spaces.Discrete(3) if kind == "index" else spaces.Box(0, high, shape, dtype)  # type: ignore[arg-type]
        self.s = self.t = 0
        if told != "info":
            setattr(self, told, lambda: LEGAL[self.s].astype(bool))

    def look(self) -> tuple[Any, dict[str, Any]]:
        extra = {"action_mask": LEGAL[self.s].copy()} if self.told == "info" else {}
        if self.kind == "index":
            return self.s, extra
        space: Any = self.observation_space
        seen = np.zeros(space.shape, space.dtype)
        seen[self.s] = np.array(space.high).max()
        return seen, extra

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = self.t = 0
        return self.look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if not LEGAL[self.s, action]:
            raise RuntimeError(f"illegal action {action} in state {self.s}")
        self.s, self.t = (self.s + int(action) + 1) % 3, self.t + 1
        seen, extra = self.look()
        return seen, 0.5 * float(action), self.t == LENGTH, False, extra


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    gym.register("Tempting-v0", Tempting)
    with pytest.MonkeyPatch.context() as patch:  # what it finds is tested elsewhere, and takes most of the time here
        patch.setattr(build, "is_resumable", lambda *_: Resumability(False, "not asked"))
        yield
    del gym.registry["Tempting-v0"]


# Steps large enough that fifty updates would carry a wrong maximum into the values of legal actions.
ROLLOUT: dict[str, Any] = {"num_envs": 4, "num_steps": 8, "optimiser": "adam", "learning_rate": 0.3}
DQRC: dict[str, Any] = {"batch_size": 16, "learning_starts": 40, "train_period": 4, "optimiser": "adam"}
SINGLE: dict[str, Any] = {**DQRC, "learning_rate": 0.5, "max_grad_norm": None, "target_period_updates": 5}
BLOCKS: dict[str, Any] = {**SINGLE, "block_length": 4}
QUANTILE: dict[str, Any] = {**SINGLE, "distribution": "quantile", "num_atoms": 4}
LEARNERS: dict[str, dict[str, Any]] = {
    "rollout peng": {"rollout": RolloutSettings(**ROLLOUT)},
    "rollout watkins": {"rollout": RolloutSettings(**ROLLOUT, returns="watkins")},
    "rollout target": {"rollout": RolloutSettings(**ROLLOUT, target_period_updates=2)},
    "dqn": {"replay": ReplaySettings(**SINGLE)},
    "double": {"replay": ReplaySettings(**SINGLE, target_rule="double")},
    "prioritised n-step": {"replay": ReplaySettings(**SINGLE, prioritised=True, num_steps=3)},
    "munchausen": {"replay": ReplaySettings(**SINGLE, target_rule="munchausen")},
    "dqrc": {"replay": ReplaySettings(**DQRC, learning_rate=0.5, target_rule="dqrc", loss="squared")},
    "quantile": {"replay": ReplaySettings(**QUANTILE)},
    "expected sarsa": {"replay": ReplaySettings(**SINGLE, target_rule="expected_sarsa")},
    "iqn": {"replay": ReplaySettings(**SINGLE, distribution="iqn", num_atoms=4)},
    "quantile munchausen": {"replay": ReplaySettings(**QUANTILE, target_rule="munchausen")},
    "categorical": {
        "replay": ReplaySettings(**SINGLE, distribution="categorical", num_atoms=51, value_min=-20.0, value_max=80.0)
    },
    **{
        rule: {"replay": ReplaySettings(**BLOCKS, target_rule=rule)}
        for rule in ("peng", "watkins", "harutyunyan", "retrace", "tree_backup")
    },
    "online": {"online": OnlineSettings(step_size=0.02)},
    "online naive": {"online": OnlineSettings(step_size=0.02, cut="naive")},
    "streaming": {"streaming": StreamingSettings(scale_rewards=False)},
    "streaming published": {"streaming": StreamingSettings(scale_rewards=False, cut="published")},
    "streaming intentional": {"streaming": StreamingSettings(scale_rewards=False, bound="intentional")},
    "qrc": {"gradient": GradientSettings(step_size=0.05, scale_rewards=False)},
    "gq": {"gradient": GradientSettings(method="gq", step_size=0.05, scale_rewards=False)},
}
CASES = [
    *((name, "linear") for name in LEARNERS),
    *((name, "table") for name in ("dqn", "streaming")),
    *((name, "action-output") for name in ("rollout watkins", "qrc")),
    *(pytest.param(name, "table", marks=pytest.mark.slow) for name in ("rollout peng", "quantile", "online", "qrc")),
    *(pytest.param(name, "action-output", marks=pytest.mark.slow) for name in ("dqn", "double", "online", "streaming")),
]
BOUND = 15.0  # no return exceeds 5, and the control shows what seeing the illegal action does
STEPS = 240


def session_of(name: str, layout: str, kind: str, told: str = "info", engine: str = "auto") -> Session:
    settings = LEARNERS[name]
    return build_session(
        RunConfig(
            env="Tempting-v0", env_kwargs={"kind": kind, "told": told}, learner=next(iter(settings)), layout=layout,
            body=MLP((16,)) if layout == "action-output" and kind != "flags" else None, epsilon_start=0.5,
            epsilon_end=0.5, evaluation_episodes=2, engine=engine, **settings,
        )
    )  # fmt: skip


def tempt(session: Session, name: str) -> None:
    """The illegal action's value, in every state, far above all returns."""
    inner: Any = session.learner.engine.q
    while hasattr(inner, "inner"):
        inner = inner.inner
    width = inner.num_actions // 3
    best = slice(3 * width - 1, None) if name == "categorical" else slice(2 * width, None)  # logits: its largest atom
    with torch.no_grad():
        if hasattr(inner, "trunk"):
            inner.trunk.layers[-1].bias[:, best] += 80.0
        elif getattr(inner, "bias", None) is not None:
            inner.bias[best] += 80.0
        elif hasattr(inner, "num_states"):
            inner.weight[:, best] += 80.0
        else:
            inner.weight[best] += 80.0


def fold(session: Session, num_steps: int) -> None:
    while session.stream.num_steps < num_steps:
        session.experience.add(session.stream.step(session.policy))
        for sample in session.experience.draw():
            update = session.learner.update(sample.transition, sample.weight)
            session.experience.return_errors(sample, update.errors)


def states(session: Session, kind: str) -> torch.Tensor:
    """Every state as the learner is handed it, mask included."""
    env, rows = Tempting(kind), []
    for env.s in range(3):
        seen = np.asarray(session.stream.encoder.encode_single(env.look()[0]))[None]
        if session.stream.normalisation is not None:
            seen = session.stream.normalisation.frozen().observe(seen)
        rows.append(np.concatenate([seen.reshape(-1), LEGAL[env.s]]))
    return torch.from_numpy(np.stack(rows).astype(session.stream.spec.dtype))


def largest_legal(session: Session, kind: str) -> float:
    q = session.learner.engine.all(states(session, kind))
    np.testing.assert_array_equal(torch.isneginf(q).numpy(), LEGAL == 0)
    assert torch.isfinite(q[torch.from_numpy(LEGAL != 0)]).all()
    return float(q.max())


@pytest.mark.parametrize(("name", "layout"), CASES)
def test_no_learner_takes_or_believes_an_illegal_action(name: str, layout: str) -> None:
    kind = "index" if layout == "table" else "vector"
    session = session_of(name, layout, kind)
    try:
        tempt(session, name)
        before = largest_legal(session, kind)
        assert before == pytest.approx(30.0, abs=12) if name == "categorical" else before < 2
        fold(session, STEPS)
        assert session.learner.num_updates > 5
        # Categorical means start amid the grid, at 30; what is legal there must not rise towards 80.
        assert largest_legal(session, kind) < max(BOUND, before + 5)
        played = evaluate_greedy(session.learner.engine.all, session.evaluation_stream, 2, seed=0)
        assert played.lengths == (LENGTH, LENGTH)
    finally:
        session.close()


@pytest.mark.parametrize("name", ["rollout watkins", "dqn", "munchausen", "retrace", "online", "streaming"])
def test_control_targets_that_see_illegal_actions_are_found_out(name: str) -> None:
    session = session_of(name, "linear", "vector")
    try:
        tempt(session, name)
        engine: Any = session.learner.engine
        masked: Any = engine.q
        held = engine.all

        def unmasked(s: torch.Tensor, target: bool = False) -> torch.Tensor:
            network = engine.network(target)
            with torch.no_grad():
                return network.inner.all(masked.observation(s))  # type: ignore[no-any-return]

        if name == "streaming":  # it acts through engine.all as well, which others have captured
            session.policy = lambda s: choose_epsilon_greedy(held(s), 0.5, np.random.default_rng(0).random(len(s)))
        engine.all = unmasked
        fold(session, STEPS)
        engine.all = held
        assert largest_legal(session, "vector") > BOUND
    finally:
        session.close()


POLICIES = {
    "greedy": lambda q, rng: choose_greedy(q),
    "ε-greedy": lambda q, rng: choose_epsilon_greedy(q, 1.0, rng.random(len(q))),
    "softmax": lambda q, rng: _drawn(rules.softmax(q, 10.0), rng),
    "k^Q": lambda q, rng: _drawn(rules.k_to_the_q(q, 1.05), rng),
}


def _drawn(pi: torch.Tensor, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    a = rules.sample(pi, torch.from_numpy(rng.random(len(pi))))
    return a, pi.gather(-1, a[:, None])[:, 0]


@pytest.mark.parametrize("told", ["info", "action_masks", "valid_action_mask"])
@pytest.mark.parametrize("policy", POLICIES)
def test_no_policy_takes_an_illegal_action_however_it_is_told(policy: str, told: str) -> None:
    stream = Interaction(make_vector_env(lambda: Tempting("index", told), 3), 0.9, seed=0)
    assert stream.spec.masked
    values = torch.tensor([1.0, 2.0, 90.0]).expand(3, 3)
    rng, taken = np.random.default_rng(1), set()
    for _ in range(60):
        step = stream.step(lambda s: POLICIES[policy](values.masked_fill(s[:, 1:] == 0, -torch.inf), rng))  # type: ignore[no-untyped-call]
        taken |= set(zip(step.rows[0][:, 0].tolist(), step.rows[1].tolist(), strict=True))
    legal = set(zip(*(x.tolist() for x in np.nonzero(LEGAL)), strict=True))
    assert taken <= legal and (policy == "greedy" or taken == legal)


@pytest.mark.parametrize("told", ["action_masks", "valid_action_mask"])
def test_a_mask_method_says_what_is_legal_now_and_info_wins_over_it(told: str) -> None:
    env_index = SubEnv(gym.make("Tempting-v0", told=told), 0)
    assert env_index.reset(seed=0)[1]["action_mask"].tolist() == [True, True, False]
    assert env_index.step(0)[4]["action_mask"].tolist() == [False, True, False]
    assert legal_actions(env_index.env, {}).tolist() == [False, True, False]
    assert legal_actions(env_index.env, {"action_mask": [1, 1, 1]}) == [1, 1, 1]
    assert legal_actions(gym.make("CartPole-v1"), {}) is None


def test_a_mask_method_that_raises_names_the_environment() -> None:
    class Broken(Tempting):
        def action_masks(self) -> Any:
            raise KeyError("board")

    with pytest.raises(RuntimeError, match="environment 0 raised KeyError: 'board'"):
        Interaction(make_vector_env(lambda: Broken(told="none"), 2), 0.9, seed=0)


@pytest.mark.parametrize(("kind", "dtype"), [("bytes", np.uint8), ("flags", np.bool_), ("index", np.int64)])
def test_a_mask_is_stored_in_the_kind_of_what_it_goes_with(kind: str, dtype: type) -> None:
    session = session_of("dqn", "action-output", kind, "action_masks")
    try:
        assert session.stream.spec.dtype == dtype and session.experience.buffer.observation_dtype == dtype  # type: ignore[attr-defined]
        fold(session, 100)
        stored = session.experience.buffer.sample(64, np.random.default_rng(0)).transition.s_tm1  # type: ignore[attr-defined]
        masks = stored[:, -3:].numpy().astype(int).tolist()
        assert {tuple(mask) for mask in masks} == {tuple(row) for row in LEGAL.tolist()}
        q = session.learner.engine.q
        assert isinstance(q, MaskedQ) and session.learner.num_updates > 5
        agent = Agent(q, session.stream.encoder, session.stream.spec)
        env = Tempting(kind, "action_masks")
        seen, _ = env.reset()
        assert np.isneginf(agent.values(seen, env.action_masks())).tolist() == [False, False, True]  # type: ignore[attr-defined]
    finally:
        session.close()


class Strict(Tempting):
    """One action is legal in each state and 0 in none; what is illegal raises, from the first step on."""

    LEGAL = np.array([[0, 0, 1], [0, 1, 0], [0, 0, 1]], np.int8)

    def __init__(self, kind: str = "vector", told: str = "info") -> None:
        super().__init__(kind, told)
        if told != "info":
            setattr(self, told, lambda: self.LEGAL[self.s].astype(bool))

    def look(self) -> tuple[Any, dict[str, Any]]:
        seen, extra = super().look()
        return seen, {"action_mask": self.LEGAL[self.s].copy()} if extra else {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.LEGAL[self.s][action], f"action {action} is illegal in state {self.s}"
        self.s, self.t = (self.s + 1) % 3, self.t + 1
        seen, extra = self.look()
        return seen, 1.0, self.t == LENGTH, False, extra


gym.register("Strict-v0", Strict)


@pytest.mark.parametrize(
    ("layout", "told"),
    [
        ("table", "info"),
        ("action-output", "action_masks"),
        pytest.param("table", "action_masks", marks=pytest.mark.slow),
        pytest.param("action-output", "info", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    ("learner", "settings"),
    [
        ("rollout", {}), ("online", {}), ("gradient", {}), ("streaming", {}), ("streaming", {"bound": "intentional"}),
        ("replay", {"prioritised": True}), ("replay", {"target_rule": "retrace", "block_length": 8, "batch_size": 32}),
        ("replay", {"target_rule": "dqrc", "target_period_updates": None}),
    ],
)  # fmt: skip
def test_nothing_that_is_done_before_training_takes_an_illegal_action(
    learner: str, settings: dict[str, Any], told: str, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "is_resumable", is_resumable)
    session = build_session(
        with_preset({
            "env": "Strict-v0", "env_kwargs": {"kind": "index" if layout == "table" else "vector", "told": told},
            "layout": layout, "learner": learner, learner: settings, "evaluation_episodes": 2,
        })
    )  # fmt: skip
    assert session.resumability.exact, session.resumability.reason  # the probe played, and nothing was raised
    assert session.play_greedily(0).returns == (LENGTH, LENGTH)
    session.close()
