"""From a configuration to the parts of a run: environments, representation, learner, experience and behaviour.

What a learner needs is asked of its record (`neuralq.learners.LearnerKind`); nothing here knows one by name.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import nn

from neuralq.learners import HasEngineName, HasValues, Learner, Parts
from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import (
    ActionInputQ,
    ActionOutputQ,
    DuelingQ,
    LinearQ,
    MaskedQ,
    RecurrentQ,
    Rule,
    SeparateQ,
    TableQ,
    body_for,
    insert_rules,
)
from neuralq.q.compiled import MlpEngine, array_values, make_engine
from neuralq.q.engine import Engine
from neuralq.q.inputs import OneHot, Pixels
from neuralq.rules import Linear
from neuralq.runs.beside import Beside
from neuralq.runs.evaluation import MOST_STEPS
from neuralq.runs.folder.env_probe import PROBE_SECONDS, SIMULATED, Resumability, is_resumable, untried
from neuralq.runs.loop import Plan, seed_for
from neuralq.runs.offline.files import read_recorded
from neuralq.runs.offline.playback import OFFLINE, OfflineExperience, Playback, rows_of, whole_buffer
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.recipe.environments import has_time_limit, make_envs, make_evaluation_envs, make_one
from neuralq.runs.recipe.lookahead import require_room
from neuralq.runs.recipe.remembering import interaction, remembering
from neuralq.runs.session import Session
from neuralq.runs.stream import Interaction, Normalisation, ObservationSpec, make_vector_env
from neuralq.runs.stream.acting import EpsilonGreedyPolicy, choose_greedy
from neuralq.runs.stream.encoding import discrete_actions, encoder_for
from neuralq.runs.stream.experience import ExperienceSource, ReplayExperience, RolloutExperience
from neuralq.runs.stream.table import TableWalk
from neuralq.runs.stream.workers import WorkerVectorEnv
from neuralq.types import QFunction, Transition

__all__ = [
    "build_q",
    "build_session",
    "engine_name",
    "normalisation_for",
    "plan_of",
]

_NETWORKS: dict[str, type[ActionInputQ] | type[SeparateQ] | type[ActionOutputQ]] = {
    "action-input": ActionInputQ,
    "separate": SeparateQ,
    "action-output": ActionOutputQ,
}


def build_q(config: RunConfig, spec: ObservationSpec, rng: np.random.Generator) -> QFunction:
    """The representation for an environment's observations.

    Args:
        config: says which layout and body.
        spec: shape and kind of the observations.
        rng: draws the initial weights of networks.

    Raises:
        ValueError: where layout and observations do not go together.
    """
    q: QFunction
    shape, num_categories = spec.inner_shape, spec.num_categories
    features: nn.Module | None = None
    per_action = config.kind.outputs(config.settings, config.layout)
    num_outputs = spec.num_actions * per_action
    if num_categories is not None and config.layout != "table":
        features, shape = OneHot(num_categories), (num_categories,)
    elif (spec.inner_dtype or spec.dtype) == np.uint8:
        scaling = spec.frame_scaling
        features = Pixels(1.0) if scaling is None else Pixels(scaling.divisor, scaling.origin)
    if config.layout == "table":
        if num_categories is None:
            raise ValueError("a table needs finitely many states; choose another layout")
        q = TableQ(num_categories, num_outputs)
    elif config.layout == "linear":
        flat = features
        if len(shape) > 1:
            flat = nn.Sequential(*([] if features is None else [features]), nn.Flatten(-len(shape)))
        # One-hot features already span the constant; a bias would make the weights redundant.
        q = LinearQ(int(np.prod(shape)), num_outputs, bias=num_categories is None, features=flat)
    else:
        body = config.body or body_for(shape, is_frame=spec.dtype.kind in "bu")
        within = None if spec.memory_size else features
        shape = (math.prod(shape) + spec.memory_size,) if spec.memory_size else shape
        if config.dueling:
            q = DuelingQ(shape, spec.num_actions, body, within, rng, num_atoms=per_action)
        else:
            q = _NETWORKS[config.layout](shape, num_outputs, body, within, rng)
    if spec.memory_size:
        assert spec.inner_dtype is not None
        dtype = None if features is None else torch.from_numpy(np.zeros((), spec.inner_dtype)).dtype
        q = RecurrentQ(q, spec.inner_shape, features, dtype)
    q = config.kind.represent(q, config.settings, config.reward_scale, rng)
    if config.rules:
        q = insert_rules(q, cast("tuple[Rule, ...]", config.rules))
    inner_shape = (math.prod(spec.inner_shape) + spec.memory_size,) if spec.memory_size else spec.inner_shape
    return MaskedQ(q, inner_shape) if spec.masked else q


def normalisation_for(config: RunConfig, envs: VectorEnv[Any, Any, Any]) -> Normalisation | None:
    """The statistics through which the configured learner sees a stream; None for those that see it as it is.

    Raises:
        ValueError: where state indices would have to be normalised.
    """
    wanted, rewards = config.kind.normalises(config.settings)
    if wanted is False and not rewards:
        return None
    encoder = encoder_for(envs.single_observation_space, as_index=config.layout == "table")
    is_index = encoder.num_categories is not None
    if is_index and wanted:
        raise ValueError("state indices have no mean to subtract; leave normalise_observations out")
    observations = not is_index if wanted is None else wanted
    if not observations and not rewards:
        return None
    # Of as many environments as in training, also where one is made to play.
    return Normalisation(encoder.shape, config.gamma, _num_envs(config), observations, rewards)


def _num_envs(config: RunConfig) -> int:
    return getattr(config.settings, "num_envs", 1)


def build_session(config: RunConfig) -> Session:
    """Everything that trains, freshly made from the configuration's seed, with compiled kernels warm.

    Raises:
        ValueError: for environments and combinations that cannot be learned, with the way out.
    """
    _check_device(config.device)
    if config.kind.experience == "table":
        return _walking_session(config)
    offline = config.dataset is not None
    envs = make_envs(config, 1 if offline else _num_envs(config), training=not offline)
    try:
        return _with_data(config, _session(config, envs)) if offline else _session(config, envs)
    except BaseException:
        with contextlib.suppress(Exception):
            envs.close()
        raise


def _session(config: RunConfig, envs: VectorEnv[Any, Any, Any]) -> Session:
    settings = config.settings
    normalisation = normalisation_for(config, envs)
    stream = interaction(config, envs, seed_for(config.seed, 0), normalisation)
    generators = {name: np.random.default_rng(seed_for(config.seed, i)) for i, name in ((1, "policy"), (2, "samples"))}
    require_room(config, stream.spec)
    engine = make_engine(_q_on_device(config, stream.spec, 3), config.kind.loss(settings), config.engine)
    remembering(stream, engine.q)
    learner = _learner(config, engine, stream.spec, generators["samples"])
    experience = _SOURCES[config.kind.experience](settings, stream.spec, generators["samples"])
    epsilon = Linear(config.epsilon_start, config.epsilon_end, config.epsilon_decay_steps)
    values, arrays = (learner.values, None) if isinstance(learner, HasValues) else (engine.all, array_values(engine))
    policy = EpsilonGreedyPolicy(values, lambda: epsilon.value(stream.num_steps), generators["policy"], arrays)
    frozen = None if normalisation is None else normalisation.frozen()
    probe = (
        OFFLINE
        if config.dataset is not None
        else _probe(config, envs, lambda: make_envs(config, _num_envs(config), training=True))
    )
    _warm(config, engine, stream)
    cap = MOST_STEPS if config.evaluation_max_steps is None and has_time_limit(envs) else config.evaluation_max_steps
    return Session(
        stream, policy, experience, learner, generators, lambda: _evaluation(config, frozen, engine.q), probe,
        config.seed, config.evaluation_episodes, cap, config.evaluate_every, config.reward_scale,
        _value_range(config.settings), Beside.of(envs, stream.spec, config.gamma, config.exact),
    )  # fmt: skip


def _with_data(config: RunConfig, session: Session) -> Session:
    """The session with recorded experience in place of what it would have met."""
    assert config.dataset is not None and isinstance(session.stream, Interaction)
    settings, data, stream = config.settings, read_recorded(config.dataset), session.stream
    if stream.spec.masked:
        raise ValueError("a data set says nothing of illegal actions, and this environment masks some; train in it")
    if settings.rule.behaviour and data.probabilities is None:
        raise ValueError(
            f"target_rule={settings.target_rule!r} needs the probabilities with which actions were taken, and the data "
            "set has none; neuralq record leaves them, or use tree_backup"
        )
    _, first_action = discrete_actions(stream.envs.single_action_space)
    rows = rows_of(data, stream.encoder, first_action, stream.num_actions, config.gamma)
    drawing = ReplayExperience(
        whole_buffer(rows, settings), session.generators["samples"], settings.batch_size, settings.block_length,
        settings.train_period, settings.train_period, settings.updates_per_period, importance=settings.importance,
    )  # fmt: skip
    session.stream, session.experience = (
        Playback(stream, data, config.dataset),
        OfflineExperience(drawing, data, config.dataset),
    )
    session._early = None
    if session.beside is not None:
        session.beside.see(rows[0], rows[1])
    return session


def _walking_session(config: RunConfig) -> Session:
    """Of a learner that acts by itself, in one environment or its model."""
    envs: Any = make_one(config)
    try:
        simulate = config.settings.simulate
        stream = TableWalk(envs, config.gamma, seed_for(config.seed, 0), simulate, config.reward_scale)
        rng = np.random.default_rng(seed_for(config.seed, 2))
        require_room(config, stream.spec)
        engine = make_engine(_q_on_device(config, stream.spec, 3), config.kind.loss(config.settings), config.engine)
        learner = _learner(config, engine, stream.spec, rng)
        stream.begin(learner)
        cap = MOST_STEPS if config.evaluation_max_steps is None and stream.time_limit else config.evaluation_max_steps
        return Session(
            stream, None, None, learner, {"samples": rng}, lambda: _evaluation(config, None, engine.q),
            SIMULATED if stream.simulated else _probe(config, envs, lambda: make_one(config)),
            config.seed, config.evaluation_episodes, cap, config.evaluate_every, config.reward_scale,
            beside=_beside_a_walk(config, envs, stream),
        )  # fmt: skip
    except BaseException:
        with contextlib.suppress(Exception):
            envs.close()
        raise


def _beside_a_walk(config: RunConfig, env: gym.Env[Any, Any], stream: TableWalk) -> Beside | None:
    """The exact answer beside action values; what else is learned on a table aims at something else."""
    algorithm = config.settings.algorithm
    if config.settings.discounts:
        return Beside.of(make_vector_env(lambda: env, 1), stream.spec, config.gamma, config.exact)
    if config.exact:
        raise ValueError(f"exact=True compares discounted values of actions, and {algorithm} learns none; leave it out")
    return None


def _evaluation(config: RunConfig, frozen: Normalisation | None, q: QFunction) -> Interaction:
    envs = make_evaluation_envs(config, config.evaluation_episodes)
    try:
        return remembering(interaction(config, envs, seed_for(config.seed, 4), frozen), q)
    except BaseException:
        envs.close()
        raise


def _probe(config: RunConfig, envs: Any, make: Callable[[], Any]) -> Resumability:
    if not config.resume_probe or isinstance(envs, WorkerVectorEnv):  # whose state is out of reach
        return untried(envs)
    return is_resumable(
        make,
        seed_for(config.seed, 5),
        np.random.default_rng(seed_for(config.seed, 6)),
        PROBE_SECONDS,
    )


def _value_range(settings: Any) -> tuple[float, float] | None:
    low, high = getattr(settings, "value_min", None), getattr(settings, "value_max", None)
    return None if low is None or high is None else (low, high)


def engine_name(learner: Learner) -> str:
    """What computes for a learner: "compiled" kernels, "torch", or "compiled and torch", each what it can.

    Kernels know tables, linear functions and convolutions only in part; where they know nothing torch steps in, and a
    run should be able to say so.
    """
    if isinstance(learner, HasEngineName):
        return learner.engine_name
    return "compiled" if isinstance(learner.engine, MlpEngine) else "torch"


def _check_device(device: str) -> None:
    try:
        usable = torch.zeros(1, device=device).add(1).item() == 1  # a device may be known and still not there
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).strip().split("\n")[0]
        raise ValueError(
            f"cannot compute on device {device!r}: {reason}; device='cpu' always works (--device cpu)"
        ) from error
    if not usable:
        raise ValueError(f"device {device!r} computes wrongly; device='cpu' always works (--device cpu)")


def _q_on_device(config: RunConfig, spec: ObservationSpec, purpose: int) -> QFunction:
    q = build_q(config, spec, np.random.default_rng(seed_for(config.seed, purpose)))
    if isinstance(q, nn.Module):
        q.to(config.device)
    return q


def _learner(config: RunConfig, engine: Engine, spec: ObservationSpec, rng: np.random.Generator) -> Learner:
    parts = Parts(
        engine, config.settings, rng, config.gamma, config.reward_scale, config.total_steps, config.engine,
        another=lambda: _q_on_device(config, spec, 11),
        exploration=(config.epsilon_start, config.epsilon_end, config.epsilon_decay_steps),
    )  # fmt: skip
    return config.kind.build(parts)


def _rollouts(settings: Any, spec: ObservationSpec, rng: np.random.Generator) -> ExperienceSource:
    return RolloutExperience(settings.num_steps, settings.num_envs, spec)


def _replay(settings: Any, spec: ObservationSpec, rng: np.random.Generator) -> ExperienceSource:
    buffer = _buffer(settings, spec, settings.capacity)
    if settings.burn_in + settings.block_length > max(1, buffer.least_steps):
        raise ValueError(
            f"capacity={settings.capacity} may hold no block of block_length={settings.block_length}: observations of "
            "this size are stored once where streams go on, and short episodes take twice the room; take at least "
            f"{2 * (settings.burn_in + settings.block_length) * settings.num_envs}"
        )
    return ReplayExperience(
        buffer, rng, settings.batch_size, settings.block_length,
        settings.learning_starts, settings.train_period, settings.updates_per_period, settings.burn_in,
        settings.importance,
    )  # fmt: skip


def _steps(settings: Any, spec: ObservationSpec, rng: np.random.Generator) -> ExperienceSource:
    return RolloutExperience(None, getattr(settings, "num_envs", 1), spec)


_SOURCES = {"rollouts": _rollouts, "replay": _replay, "steps": _steps}


def _buffer(settings: Any, spec: ObservationSpec, capacity: int) -> ReplayBuffer:
    return ReplayBuffer(
        capacity, spec.shape, spec.dtype, num_envs=settings.num_envs, num_steps=settings.num_steps,
        prioritised=settings.priorities,
    )  # fmt: skip


def _warm(config: RunConfig, engine: Engine, stream: Interaction) -> None:
    """Compile, or load from the cache, every kernel the run will call, so that its clock measures training.

    A learner like the run's, on a copy of the representation, learns once from a made-up step and is thrown away.
    """
    settings, experience = config.settings, config.kind.experience
    s = torch.from_numpy(stream.state_dict()["s"])
    a, _ = choose_greedy(engine.all(s))
    one = torch.ones(len(s))
    step = Transition(s, a, one, one, one, s, one > 0).map(lambda x: x.to(config.device))
    twin = make_engine(copy.deepcopy(engine.q), config.kind.loss(settings), config.engine)
    learner = _learner(config, twin, stream.spec, np.random.default_rng(0))
    if isinstance(learner, HasValues):
        learner.values(step.s_tm1)
    time_major = experience == "rollouts" or getattr(settings, "block_length", 1) > 1
    rows = 1 + getattr(settings, "burn_in", 0)
    learner.update(step.map(lambda x: torch.stack([x] * rows)) if time_major else step)
    if experience == "replay":
        _warm_buffer(_buffer(settings, stream.spec, 8 * settings.num_envs), stream, settings)
    if stream.normalisation is not None:
        Normalisation((2,), 0.5, 1).reward(np.ones(1), np.zeros(1, bool), np.ones(1, bool))


def _warm_buffer(buffer: ReplayBuffer, stream: Interaction, settings: Any) -> None:
    s = stream.state_dict()["s"]
    rng = np.random.default_rng(0)
    env_indices = range(settings.num_envs)
    one = np.ones(len(s), np.float32)
    fields: tuple[Any, ...] = (s, np.zeros(len(s), np.int64), one, one, one, s, np.zeros(len(s), bool))
    for _ in range(4):
        if len(s) == 1:
            buffer.add_step(0, s[0], 0, 1.0, 1.0, 1.0, s[0], False)
        else:
            buffer.add(Transition(*(torch.from_numpy(x) for x in fields)), np.array(env_indices, np.int64))
    if settings.block_length > 1:
        buffer.sample_blocks(1, 2, rng)
    else:
        batch = buffer.sample(2, rng)
        if settings.prioritised:
            buffer.update_priorities(batch.indices, np.ones(2))


def plan_of(config: RunConfig) -> Plan:
    """When this run evaluates, saves and stops."""
    return Plan(
        unit="env_steps",
        budget=config.total_steps,
        evaluate_every=config.evaluate_every,
        checkpoint_every=config.checkpoint_every,
        log_every=config.log_every,
        seed=config.seed,
        stop_at_return=config.stop_at_return,
    )
