"""Training, resuming and loading runs: what `neuralq.train`, `neuralq.resume` and `neuralq.load` are."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuralq.runs.control import CONTROL, Run
from neuralq.runs.kinds import kind_of
from neuralq.runs.loop import Hook, Listener
from neuralq.runs.recipe.config import RunConfig, config_from_dict
from neuralq.runs.recipe.games import make_single
from neuralq.runs.recipe.handed import Handed, handed_over
from neuralq.runs.recipe.keywords import nested, with_body
from neuralq.runs.recipe.presets import of_agent, started, with_preset
from neuralq.runs.recipe.stand_in import Maker, standing_in
from neuralq.runs.stop_request import pass_on

__all__ = ["load", "resume", "train"]

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


def _maker(run: Path, env: Any) -> Maker | None:
    """What makes the environments of a run: what is handed over now, or was when it began in this process."""
    if env is None:
        return _makers.get(run.resolve())
    handed = handed_over(env)
    if handed.make is None:
        config = RunConfig(env=handed.env, env_kwargs=handed.env_kwargs)
        return lambda: make_single(config.env, config.env_kwargs)
    return handed.make


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
    path = _folder(run_dir)
    kind = kind_of(path)
    if total_steps is not None and kind.budget != "total_steps":
        raise ValueError(
            f"{path} is {kind.title}, whose budget is {kind.budget} and not total_steps; leave it out here, or "
            "resume the run as its system does"
        )
    with standing_in(_maker(path, env)):
        run = kind.resume(path, total_steps, hooks, changes)
    return _passed_on(run)


def _folder(run: Any) -> Path:
    """The folder of a run, by its path or by what training returned."""
    return Path(getattr(run, "run_dir", run))


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
    path = _folder(run_dir)
    with standing_in(_maker(path, env)):
        return kind_of(path).load(path, best)
