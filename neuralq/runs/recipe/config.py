"""The configuration of a run: one frozen dataclass that refuses contradictions and is stored beside the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from neuralq.checks import MOST_WHOLE, check_choice, check_discount, check_fraction, check_positive, check_whole
from neuralq.learners.kind import LearnerKind, learner_kinds
from neuralq.q import BODIES, GRU, MLP, NAMED_BODIES, Body, Custom, Rule
from neuralq.runs.recipe.games import is_screen
from neuralq.runs.recipe.remembering import check_memory
from neuralq.runs.recipe.wrapping import check_wrappers

__all__ = [
    "LAYOUTS",
    "LEARNERS",
    "RunConfig",
    "body_to_dict",
    "config_from_dict",
    "config_to_dict",
    "fitted_value",
    "layout_for",
]

LAYOUTS = ("table", "linear", "action-input", "separate", "action-output")
LEARNERS = learner_kinds()
NETWORKS = ("action-input", "separate", "action-output")
_COUNTS = (
    *("total_steps", "evaluate_every", "evaluation_episodes", "checkpoint_every", "log_every", "threads"),
    "epsilon_decay_steps",
)
_SINGLE = np.finfo(np.float32)
_MOST_THREADS = 4096
_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", dict: "a mapping"}
_MOST_SHOWN = 100
_Class = TypeVar("_Class")

if TYPE_CHECKING:
    from neuralq.learners import (
        GradientSettings,
        OnlineSettings,
        ReplaySettings,
        RolloutSettings,
        StreamingSettings,
        TabularSettings,
    )


def _with_learners(cls: type[_Class]) -> type[_Class]:
    """A field for the settings of every learner, where the class says ``learners``."""
    hints: dict[str, Any] = {}
    for name, hint in cls.__annotations__.items():
        hints |= {k: kind.settings | None for k, kind in LEARNERS.items()} if name == "learners" else {name: hint}
    for name in LEARNERS:
        setattr(cls, name, None)
    cls.__annotations__ = hints
    return cls


@dataclass(frozen=True)
@_with_learners
class RunConfig:
    """Everything that decides a run.

    Besides the arguments below there is one for every learner, of its name, which takes its settings:
    ``RunConfig(learner="replay", replay=ReplaySettings(num_steps=3))``. It goes with that learner only.

    Args:
        env: Gymnasium id, or "module:id" to import a module that registers it.
        env_kwargs: passed to `gymnasium.make`.
        wrappers: put around the environment, the first innermost: "module:Wrapper", or {"module:Wrapper": arguments}.
        frame_stack: how many of the last observations are seen together.
        vectorization: "sync", environments take turns; or "async", each has a process, for those that are slow.
        clip_rewards: whether training sees rewards clipped to between −1 and 1 (Mnih et al., 2015); Atari screens only.
        end_on_life_loss: whether in training a lost life ends the game and begins another; Atari screens only.
        learner: name of a learner; `neuralq.learners.learner_kinds` has them all.
        layout: "table", "linear", "action-input", "separate" or "action-output"; "auto" for what goes with the learner:
            a table with "tabular", else "action-output".
        seed: from which every generator is derived.
        total_steps: environment steps, summed over parallel environments.
        stop_at_return: stop once a greedy evaluation averages at least this.
        gamma: discount γ.
        reward_scale: rewards are multiplied by it for learning; reported returns and values are not.
        epsilon_start: exploration at the first step.
        epsilon_end: exploration after ``epsilon_decay_steps``, reached linearly.
        epsilon_decay_steps: environment steps.
        body: network body, MLP, Conv, GRU (which remembers) or Custom (a module of your own); networks only. None picks
            MLP, or Conv for images.
        rules: advice that begins as units of the network, one in each hidden layer for a rule, beside those of the body
            (`neuralq.q.Rule`, or a mapping of its fields); three layouts with an MLP, without layer normalisation.
        dueling: whether a value and an advantage stream make the outputs (Wang et al., 2016); action-output only.
        evaluate_every: environment steps between greedy evaluations.
        evaluation_episodes: episodes of each evaluation.
        evaluation_max_steps: steps after which an evaluation episode is cut; None for 10,000, and where the environment
            has no time limit for ten times the longest episode of training.
        resume_probe: whether it is tried, for a second at most, if the environment's state can be saved and put back.
        checkpoint_every: environment steps between checkpoints.
        log_every: environment steps between rows of training metrics.
        exact: whether the environment's model is solved and the exact answer shown beside what is learned; None for
            models that are solved within a second, true for any.
        monitor: whether the run is watched for divergence.
        engine: "auto", "torch" or "compiled".
        device: "cpu", "cuda", "cuda:1", ….
        threads: CPU threads for linear algebra; small networks are fastest on one.
        dataset: recorded experience to learn from in place of steps in the environment, "minari:ID" or a file.npz; with
            the replay learner. A step of the budget is then what updates would follow.
        warm_start: run folder with whose weights, and statistics of observations, the run begins; None for new ones.
    """

    env: str = "CartPole-v1"
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    wrappers: tuple[str | dict[str, Any], ...] = ()
    frame_stack: int = 1
    vectorization: str = "sync"
    clip_rewards: bool = False
    end_on_life_loss: bool = False
    learner: str = "rollout"
    layout: str = "auto"
    seed: int = 0
    total_steps: int = 100_000
    stop_at_return: float | None = None
    gamma: float = 0.99
    reward_scale: float = 1.0
    epsilon_start: float = 1.0
    epsilon_end: float = 0.05
    epsilon_decay_steps: int = 20_000
    body: Body | None = None
    rules: tuple[Rule | dict[str, Any], ...] = ()
    dueling: bool = False
    if TYPE_CHECKING:  # which learners there are is found out when the program runs; type checkers know ours
        gradient: GradientSettings | None = None
        online: OnlineSettings | None = None
        replay: ReplaySettings | None = None
        rollout: RolloutSettings | None = None
        streaming: StreamingSettings | None = None
        tabular: TabularSettings | None = None
    else:
        learners: None
    evaluate_every: int = 4096
    evaluation_episodes: int = 20
    evaluation_max_steps: int | None = None
    resume_probe: bool = True
    checkpoint_every: int = 50_000
    log_every: int = 1024
    exact: bool | None = None
    monitor: bool = True
    engine: str = "auto"
    device: str = "cpu"
    threads: int = 1
    dataset: str | None = None
    warm_start: str | None = None

    def __post_init__(self) -> None:
        """Refuse values outside their range and settings that would be ignored; fill in the learner's defaults."""
        if self.warm_start is not None:  # a run itself will do
            object.__setattr__(self, "warm_start", str(getattr(self.warm_start, "run_dir", self.warm_start)))
        for name, value in _fitted(
            "", {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}, RunConfig
        ).items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "rules", tuple(map(_rule_of, self.rules)))
        check_choice("learner", self.learner, LEARNERS)
        object.__setattr__(self, "layout", layout_for(self.learner, self.layout))
        check_choice("layout", self.layout, LAYOUTS)
        check_choice("engine", self.engine, ("auto", "torch", "compiled"))
        check_discount("gamma", self.gamma)
        check_positive("reward_scale", self.reward_scale)
        _check_single(self)
        check_fraction("epsilon_start", self.epsilon_start)
        check_fraction("epsilon_end", self.epsilon_end)
        check_whole("seed", self.seed, 0)
        for name in _COUNTS:
            check_whole(name, getattr(self, name))
        if self.threads > _MOST_THREADS:
            raise ValueError(f"threads must be at most {_MOST_THREADS:,}, got {self.threads:,}")
        if self.evaluation_max_steps is not None:
            check_whole("evaluation_max_steps", self.evaluation_max_steps)
        for name, kind in LEARNERS.items():
            given = getattr(self, name)
            if name == self.learner and given is None:
                object.__setattr__(self, name, kind.settings_for(self.layout, {}))
            elif name != self.learner and given is not None:
                raise ValueError(
                    f"settings for the {name} learner would be ignored with learner={self.learner!r}; "
                    f"use learner={name!r} or leave them out"
                )
        object.__setattr__(self, self.learner, _fitted_settings(self.learner, self.settings, self.kind.settings))
        _check_body(self)
        _check_outputs(self)
        self.kind.check(self.settings, self)
        _check_exploration(self)
        _check_environment(self)
        _check_dataset(self)

    @property
    def kind(self) -> LearnerKind:
        """The record of the learner that runs."""
        return LEARNERS[self.learner]

    @property
    def settings(self) -> Any:
        """The settings of the learner that runs."""
        return getattr(self, self.learner)


def layout_for(learner: str, layout: str = "auto") -> str:
    """The layout that is meant.

    Example:
        >>> layout_for("tabular"), layout_for("online"), layout_for("online", "linear")
        ('table', 'action-output', 'linear')
    """
    return LEARNERS[learner].layout if layout == "auto" and learner in LEARNERS else layout


def _check_body(config: RunConfig) -> None:
    """Networks have bodies, and kernels know some of them."""
    if config.body is not None and config.layout not in NETWORKS:
        what = "table" if config.layout == "table" else "linear function"
        raise ValueError(f"a {what} has no network body; leave body out or choose one of {', '.join(NETWORKS)}")
    check_memory(config)
    if config.rules and config.layout not in NETWORKS:
        what = "table" if config.layout == "table" else "linear function"
        raise ValueError(
            f"a {what} has no units that rules could be; leave rules out or choose one of {', '.join(NETWORKS)}"
        )
    if config.engine == "compiled" and (config.layout not in NETWORKS or not isinstance(config.body or MLP(), MLP)):
        raise ValueError("engine='compiled' has kernels for MLP networks only; use engine='auto'")


def _rule_of(given: Any) -> Rule:
    """A rule, or the fields of one."""
    if isinstance(given, Rule):
        return given
    _refuse_unknown("a rule", given, Rule)
    if not {"conditions", "action"} <= set(given):
        raise ValueError(f"a rule needs conditions and an action, got {given!r}")
    return Rule(**given)


def _check_single(config: RunConfig) -> None:
    """Networks and replay compute in float32, which must be able to tell γ from 1 and the scale from 0."""
    if config.layout not in NETWORKS and LEARNERS[config.learner].experience != "replay":
        return
    gamma, scale = float(np.float32(config.gamma)), config.reward_scale
    if gamma == 1 and config.gamma < 1:
        raise ValueError(f"gamma={config.gamma!r} is 1 in float32, which networks compute in; use 1, or 0.9999999")
    if not float(_SINGLE.tiny) <= scale <= float(_SINGLE.max):
        raise ValueError(f"reward_scale={scale!r} is beyond float32, which networks compute in; use one nearer 1")


def _check_outputs(config: RunConfig) -> None:
    """Dueling streams are made of the outputs of all actions, which not every layout has."""
    if config.dueling and config.layout != "action-output":
        why = {
            "action-input": "an action-input network sees one action at a time and has no average over them",
            "separate": "separate networks share nothing that a common value could be learned from",
        }.get(config.layout, f"in a {config.layout} function a value stream adds nothing to the action values")
        raise ValueError(f"dueling needs layout='action-output', got {config.layout!r}: {why}")
    if config.dueling and config.body is not None and not config.body.hidden:
        raise ValueError("dueling streams need a hidden layer, got a body with hidden=(); give it a width")
    if config.layout == "action-input" and isinstance(config.body, Custom | GRU) and not config.body.hidden:
        raise ValueError(
            "without a layer after it the action would be added to what the body says of the state, and one action be "
            "best everywhere; give the body hidden=(width,), or use another layout"
        )
    if config.engine == "compiled" and config.dueling:
        raise ValueError("engine='compiled' has no kernels for dueling streams or distributions; use engine='auto'")


def _check_exploration(config: RunConfig) -> None:
    """A learner that acts by itself may have another policy than ε-greedy."""
    plan = getattr(config.settings, "plan", {})
    if plan.get("policy", "epsilon-greedy") == "epsilon-greedy":
        return
    for name in ("epsilon_start", "epsilon_end"):  # how fast ε falls is also said by the budget
        if getattr(config, name) != getattr(RunConfig, name):
            raise ValueError(
                f"{name} would be ignored with the policy {plan['policy']!r}; leave it out, or act ε-greedily"
            )


def _check_dataset(config: RunConfig) -> None:
    if config.dataset is None:
        return
    if config.kind.experience != "replay":
        raise ValueError(f"the {config.learner} learner takes no recorded experience; use learner='replay'")
    if config.clip_rewards or config.end_on_life_loss:
        raise ValueError(
            "recorded rewards and episodes are taken as they are; leave clip_rewards and end_on_life_loss out"
        )


def _check_environment(config: RunConfig) -> None:
    check_choice("vectorization", config.vectorization, ("sync", "async"))
    check_whole("frame_stack", config.frame_stack)
    check_wrappers(config.wrappers)
    for name, way_out in (("clip_rewards", "use reward_scale"), ("end_on_life_loss", "leave it out")):
        if getattr(config, name) and not is_screen(config.env, config.env_kwargs):
            raise ValueError(f"{name} is for the screens of Atari games (ALE/...), got {config.env!r}; {way_out}")


def body_to_dict(body: Body) -> dict[str, Any]:
    """A body as configurations write it: its class and its settings.

    Example:
        >>> body_to_dict(MLP((8,)))["class"]
        'MLP'
    """
    return {"class": type(body).__name__, **dataclasses.asdict(body)}


def config_to_dict(config: RunConfig) -> dict[str, Any]:
    """Plain values, for JSON; the body is named by its class.

    Example:
        >>> config_to_dict(RunConfig(seed=3))["rollout"]["returns"]
        'peng'
    """
    plain = dataclasses.asdict(config)
    if config.body is not None:
        plain["body"] = body_to_dict(config.body)
    return {name: value for name, value in plain.items() if name not in LEARNERS or name == config.learner}


def config_from_dict(plain: Mapping[str, Any]) -> RunConfig:
    """The configuration that `config_to_dict` wrote.

    Raises:
        ValueError: for keys that this version does not know, values of the wrong kind and contradictions.

    Example:
        >>> config_from_dict(config_to_dict(RunConfig(seed=3))) == RunConfig(seed=3)
        True
    """
    values = dict(plain)
    if "kind" in values:
        raise ValueError(f"this configures a run of the kind {values['kind']!r}, and not one on an environment")
    _refuse_unknown("the configuration", values, RunConfig)
    for name, kind in LEARNERS.items():
        if values.get(name) is not None:
            layout = layout_for(name, values.get("layout", RunConfig.layout))
            values[name] = kind.settings_for(layout, _fitted(name, values[name], kind.settings))
    if values.get("body") is not None:
        body = _body_of(values["body"])
        check_choice("class of the body", body.get("class"), BODIES)
        body_class = BODIES[body.pop("class")]
        values["body"] = body_class(**_fitted("body", body, body_class))
    return RunConfig(**values)


def _body_of(given: Any) -> dict[str, Any]:
    """A body as a mapping, by whatever it was named."""
    if isinstance(given, str) and given in NAMED_BODIES:
        return body_to_dict(NAMED_BODIES[given])
    if isinstance(given, str) and ":" in given:
        return {"class": "Custom", "module": given}
    if not isinstance(given, Mapping):
        known = ", ".join(NAMED_BODIES)
        raise ValueError(
            f"body must be a mapping with a class, one of {known}, or 'module:Class' of your own, got {given!r}"
        )
    return dict(given)


def _fitted_settings(place: str, settings: Any, known: type) -> Any:
    """``settings`` with every value of its field's kind: 1.0 is a whole number too, but no length of an array."""
    if not isinstance(settings, known):
        raise ValueError(f"{place} must be {known.__name__}, got {settings!r}")
    given = {one.name: getattr(settings, one.name) for one in dataclasses.fields(cast(Any, known))}
    fitted = _fitted(place, given, known)
    same = all(type(fitted[name]) is type(value) for name, value in given.items())
    return settings if same else dataclasses.replace(cast(Any, settings), **fitted)


def _fitted(place: str, given: Any, known: type) -> dict[str, Any]:
    """``given`` with every value of the kind that its field has in the dataclass ``known``."""
    if not isinstance(given, Mapping):
        raise ValueError(f"{place} must be a mapping, got {given!r}")
    _refuse_unknown(place, given, known)
    hints = get_type_hints(known)
    return {name: fitted_value(f"{place}.{name}".lstrip("."), value, hints[name]) for name, value in given.items()}


def fitted_value(name: str, value: Any, hint: Any, given: str | None = None) -> Any:
    """``value`` as the kind that ``hint`` asks for: whole numbers become floats where those are wanted, lists tuples.

    Args:
        name: how the value is called.
        value: what it is.
        hint: the type of its field.
        given: how it was written, where that is not how Python writes it.

    Raises:
        ValueError: it is of another kind.

    Example:
        >>> fitted_value("gamma", 1, float), fitted_value("num_atoms", 8.0, int | None)
        (1.0, 8)
    """
    kinds = [get_origin(kind) or kind for kind in (get_args(hint) if isinstance(hint, UnionType) else (hint,))]
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if is_number and isinstance(value, int) and abs(value) >= MOST_WHOLE:
        raise ValueError(f"{name} must be a number below 2^128, got one of {value.bit_length():,} bits".lstrip())
    for kind in kinds:
        if kind is float and is_number and _is_float(value):
            return float(value)
        if kind is int and is_number and (isinstance(value, int) or float(value).is_integer()):
            return int(value)
        if kind is tuple and isinstance(value, list | tuple):
            return tuple(fitted_value(f"{name}[{i}]", entry, get_args(hint)[0]) for i, entry in enumerate(value))
        if kind not in (int, float, tuple) and isinstance(value, kind):
            return value
    words = [_WORDS.get(kind, f"a {kind.__name__}") for kind in kinds if kind is not NoneType]
    words = ["a list" if word == "a tuple" else word for word in words]
    raise ValueError(f"{name} must be {' or '.join(words)}, got {_short(given or repr(value))}".lstrip())


def _short(text: str) -> str:
    return text if len(text) <= _MOST_SHOWN else text[: _MOST_SHOWN - 3] + "..."


def _is_float(value: Real) -> bool:
    try:
        float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return False
    return True


def _refuse_unknown(where: str, given: Mapping[str, Any], known: type) -> None:
    names = {f.name for f in dataclasses.fields(known)}
    unknown = sorted(map(str, set(given) - names))
    if unknown:
        raise ValueError(f"{where} has unknown keys {', '.join(unknown)}; known are {', '.join(sorted(names))}")
