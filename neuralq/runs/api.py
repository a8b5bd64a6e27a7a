"""Training, resuming and loading runs: what `neuralq.train`, `neuralq.resume` and `neuralq.load` are."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from neuralq.runs.control import CONTROL, Run, evaluate_run
from neuralq.runs.evaluation import Evaluation
from neuralq.runs.kinds import kind_of
from neuralq.runs.loop import Hook, Listener
from neuralq.runs.recipe.config import RunConfig, config_from_dict
from neuralq.runs.recipe.games import make_single
from neuralq.runs.recipe.handed import Handed, handed_over
from neuralq.runs.recipe.keywords import nested, with_body
from neuralq.runs.recipe.presets import of_agent, started, with_preset
from neuralq.runs.recipe.stand_in import Maker, standing_in
from neuralq.runs.stop_request import pass_on

__all__ = ["environment_of", "evaluate", "folder_of", "load", "resume", "train"]

_makers: dict[Path, Maker] = {}
"""What makes the environments of this process's runs that no name leads to, by run folder."""


def train(
    env: Any,
    run_dir: str | Path | None = None,
    hooks: Sequence[Hook] = (),
    *,
    preset: bool | str = True,
    **settings: Any,
) -> Run:
    """Train, and leave a run folder: configuration, versions, metrics and checkpoints.

    As from the shell, what is not given is the preset's of the environment and learner, where there is one, and else
    the default; which preset it was is said to hooks that listen and to the log ``neuralq``. A `RunConfig` says
    everything already and has no preset put under it.

    Args:
        env: a Gymnasium id, or "module:id"; an environment, or a class or function that makes one; a mapping of
            settings with one of these as ``env``; or a whole `RunConfig`. An environment is copied and not touched.
        run_dir: folder for the run; by default one under ``runs/``, named after environment, layout, seed and time.
        hooks: called with every row of metrics, and shown the session where they ask for it (docs/hooks.md).
        preset: whether to start from the environment's preset; or the name of a whole agent, such as "rainbow".
        settings: fields of `RunConfig`; settings of the learner by their own names (``lambda_=0.8``); and ``hidden``,
            ``layer_norm`` and ``activation`` of the network.

    Raises:
        ValueError: for environments and settings that do not go together, and names that are none of a setting.
        RunFolderError: if the folder already holds a run.
        EnvironmentFault: if the environment breaks its contract while training.
        Diverged: if the parameters stop being finite.
        KeyboardInterrupt: at Ctrl-C, once the run is saved; another signal has its effect then, too.

    Example:
        >>> import tempfile
        >>> run = train("CartPole-v1", tempfile.mkdtemp() + "/run", total_steps=64, evaluation_episodes=1,
        ...             num_envs=2, num_steps=16, hidden=(8,))
        >>> run.env_steps >= 64
        True
    """
    config, handed = _asked(env, settings, preset)
    begun = started(config.env, config.learner, preset if isinstance(preset, str) else None)
    if preset and not isinstance(env, RunConfig) and begun:
        _tell(hooks, f"{begun} (preset=False leaves it out)")
    with standing_in(handed.make):
        run: Run = CONTROL.train(config, run_dir, hooks)
    if handed.make is not None:
        _makers[Path(run.run_dir).resolve()] = handed.make
    _passed_on(run)
    return run


def _asked(env: Any, settings: Mapping[str, Any], preset: bool | str) -> tuple[RunConfig, Handed]:
    """The configuration that arguments of `train` come to, and its environment."""
    if isinstance(env, RunConfig):
        plain = nested(env, settings)
        preset = False
    else:
        plain = nested(of_agent(env if isinstance(env, Mapping) else {"env": env}, preset, settings), settings)
    handed = handed_over(plain.get("env", RunConfig.env))
    plain["env"] = handed.env
    if handed.env_kwargs:
        plain["env_kwargs"] = {**handed.env_kwargs, **(plain.get("env_kwargs") or {})}
    if handed.make is not None and plain.get("env_kwargs"):
        raise ValueError(
            f"env_kwargs are for environments that a name leads to, and {handed.env} is made by what was handed over; "
            "give it its arguments there"
        )
    if not preset:
        return config_from_dict(with_body(plain)), handed
    return with_preset(plain, preset=preset if isinstance(preset, str) else None), handed


def _tell(hooks: Sequence[Hook], line: str) -> None:
    for hook in hooks:
        if isinstance(hook, Listener):
            hook.say(line)
    logging.getLogger("neuralq").info(line)


@contextlib.contextmanager
def environment_of(run: Path, env: Any = None) -> Iterator[None]:
    """Within the block environments of a run that no name leads to are found.

    Args:
        run: its folder.
        env: what is handed over now, as for `train`; None for what was when the run began in this process.
    """
    make = _makers.get(run.resolve())
    if env is not None:
        handed = handed_over(env)
        make = handed.make or functools.partial(_by_name, handed.env, handed.env_kwargs)
    with standing_in(make):
        yield


def _by_name(env: str, env_kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    with standing_in(None):  # which this stands in for
        return make_single(env, env_kwargs)


def folder_of(run: Any) -> Path:
    """The folder of a run, by its path, by what training returned or by an agent.

    Raises:
        ValueError: for anything else.

    Example:
        >>> folder_of("runs/demo").name
        'demo'
    """
    found = getattr(run, "run_dir", run)
    if not isinstance(found, str | Path):
        raise ValueError(f"a run is named by its folder, what training returned or a loaded agent, got {run!r}")
    return Path(found)


def resume(
    run_dir: str | Path | Run,
    total_steps: int | None = None,
    hooks: Sequence[Hook] = (),
    *,
    env: Any = None,
    **changes: Any,
) -> Any:
    """Go on with a run from its newest valid checkpoint, or from the start if it was stopped before the first.

    On a CPU the continued run ends with the same bits as one that was never stopped, where the environment's state can
    be saved; otherwise every environment starts a new episode.

    Args:
        run_dir: folder of the run, or the run itself.
        total_steps: a new budget, which becomes part of the run's configuration; a finished run goes on only with a
            larger one.
        hooks: called with every row of metrics, and shown the session where they ask for it (docs/hooks.md).
        env: the environment, as `train` takes it, of a run in whose folder it has no name that could be followed.
        changes: other settings that do not decide what is learned, which become part of the configuration, too:
            ``device="cpu"``, ``stop_at_return=None``, ``evaluate_every=10_000``, ….

    Returns:
        A `Run`; of a system's run the result that the system has for it.

    Raises:
        RunFolderError: if there is no run, or another process is writing it.
        CheckpointError: if no checkpoint is intact, or the newest belongs to another configuration.
        ValueError: for a new budget of a run that does not count environment steps, one that is spent already, and for
            changes that would make another run of it.
    """
    path = folder_of(run_dir)
    kind = kind_of(path)
    if total_steps is not None and kind.budget != "total_steps":
        raise ValueError(
            f"{path} is {kind.title}, whose budget is {kind.budget} and not total_steps; leave it out here, or "
            "resume the run as its system does"
        )
    with environment_of(path, env):
        run = kind.resume(path, total_steps, hooks, changes)
    return _passed_on(run)


def _passed_on(run: Any) -> Any:
    """The run, unless a signal has ended it: what it was meant to end is the whole program."""
    pass_on(
        run.interrupted_by, f"the run was saved at {run.env_steps:,} steps; go on with: neuralq resume {run.run_dir}"
    )
    return run


def load(run_dir: str | Path | Run, best: bool | None = None, *, env: Any = None) -> Any:
    """The agent of a run: its last parameters, or its best where those are what the run ended with.

    A run that ends below its best evaluation plays both on fresh episodes and keeps the last, unless the best is better
    by more than the standard error of the difference.

    Args:
        run_dir: folder of the run, or the run itself.
        best: True for the parameters whose greedy evaluation scored highest, False for the last.
        env: the environment, as `train` takes it, of a run in whose folder it has no name that could be followed.

    Returns:
        A `neuralq.runs.agent.Agent`; of a TD-Gammon run a `neuralq.systems.backgammon.BackgammonAgent`.

    Raises:
        RunFolderError: if there is no run in the folder.
        CheckpointError: if no checkpoint is intact.
        ValueError: if the best is asked for of a run that keeps its newest only.
    """
    path = folder_of(run_dir)
    with environment_of(path, env):
        return kind_of(path).load(path, best)


def evaluate(
    run: Any, num_episodes: int = 100, seed: int = 0, best: bool | None = None, *, env: Any = None
) -> Evaluation:
    """Returns of greedy episodes, played by the agent of a run in environments of their own.

    Args:
        run: a run, its folder, or an agent that was loaded from it.
        num_episodes: how many episodes.
        seed: of the episodes; unrelated to those seen in training.
        best: which parameters, as for `load`.
        env: as for `load`.

    Raises:
        ValueError: if ``run`` is none of these, or has learned no policy.
        RunFolderError: if there is no run in the folder.

    Example:
        >>> import tempfile
        >>> run = train("CartPole-v1", tempfile.mkdtemp() + "/run", total_steps=64, evaluation_episodes=1,
        ...             num_envs=2, num_steps=16, hidden=(8,))
        >>> len(evaluate(run, 5).returns)
        5
    """
    if isinstance(num_episodes, bool) or not isinstance(num_episodes, int):
        raise ValueError(
            f"the second argument is how many episodes, got {num_episodes!r}; write neuralq.evaluate(run), or "
            "neuralq.evaluate(run, env=...) for an environment that has no name"
        )
    path = folder_of(run)
    with environment_of(path, env):
        return evaluate_run(path, num_episodes, seed, best)
