"""Runs that learn to act in a Gymnasium environment: their result, the agent they leave, and how it is measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_whole
from neuralq.q.flat import FlatParameters
from neuralq.rules import Linear
from neuralq.runs.agent import Agent
from neuralq.runs.beside import Beside
from neuralq.runs.evaluation import MOST_STEPS, Evaluation, evaluate_greedy, shown
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.best import load_best
from neuralq.runs.folder.files import plain_values, read_rows, to_json, write_durably
from neuralq.runs.folder.origin import compared
from neuralq.runs.folder.run_folder import RunFolder, default_run_path, read_changes, read_config
from neuralq.runs.held import DRAWING_NAME, Comparison
from neuralq.runs.kinds import Kind, limited_threads
from neuralq.runs.loop import NOT_EXACT, Progress, seed_for
from neuralq.runs.offline.playback import Playback
from neuralq.runs.play_off import about, score_of, told_of
from neuralq.runs.recipe.build import (
    build_q,
    build_session,
    engine_name,
    normalisation_for,
    plan_of,
)
from neuralq.runs.recipe.config import LEARNERS, RunConfig, config_from_dict, config_to_dict
from neuralq.runs.recipe.environments import make_envs, make_evaluation_envs
from neuralq.runs.recipe.lookahead import warnings_ahead
from neuralq.runs.recipe.opening import opening_lines
from neuralq.runs.recipe.remembering import interaction, remembering
from neuralq.runs.session import Session
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.runs.warm_start import begun_from
from neuralq.runs.watchers import monitor_verdict, watchers

__all__ = ["CONTROL", "Run", "agent_of", "evaluate_run", "last_cap"]


@dataclass(frozen=True)
class Run:
    """The result of a run on an environment.

    Args:
        run_dir: its folder.
        env_steps: environment steps.
        cpu_seconds: CPU time of training, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        greedy_return: mean return of the last greedy evaluation.
        agent_return: mean return of the run's agent: of the play-off where there was one, else as `greedy_return`.
        agent_standard_error: its standard error; None where no or one episode was played.
        parameters_sha256: of the flat parameter vector's bytes.
        reached: whether ``stop_at_return`` was met; None where none was asked for.
        interrupted_by: name of the signal that ended it early, or None.
        resumability: how exactly it can be resumed, in words.
        engine: what computed values and gradients: "compiled" kernels, "torch", or both, each what it can.
        stopped_by: which hook ended it before its budget was spent, and why; None if none did.
        dataset: from which recorded experience it learned; its steps are then those of the budget.
        agent: which parameters `neuralq.load` takes where nothing is said: "final" or "best".
        play_off: of a run that ended below its best evaluation, what that was decided by
            (`neuralq.runs.play_off`); else None.
        exact: what its agent learned beside the exact answer (`neuralq.runs.held.Comparison`), where there is one.
        measured: what it learned that is no value of an action: of prediction the start's value and the distance from
            exact values, of R-learning the reward per step; empty for others.
        monitor: what the monitor of divergence says (`neuralq.lab.DivergenceMonitor.verdict`); None without it.
    """

    run_dir: Path
    env_steps: int
    cpu_seconds: float
    wall_seconds: float
    greedy_return: float | None
    agent_return: float | None
    agent_standard_error: float | None
    parameters_sha256: str
    reached: bool | None
    interrupted_by: str | None
    resumability: str
    engine: str
    stopped_by: str | None = None
    dataset: str | None = None
    agent: str = "final"
    play_off: dict[str, Any] | None = None
    exact: dict[str, Any] | None = None
    measured: dict[str, float] = dataclasses.field(default_factory=dict)
    monitor: dict[str, Any] | None = None

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return {**dataclasses.asdict(self), "run_dir": str(self.run_dir)}

    def lines(self) -> list[str]:
        """The same for people."""
        unplayed = "values of states, no policy" if "start_value" in self.measured else "not evaluated"
        score = unplayed if self.greedy_return is None else told_of(self.plain())
        counted = "environment steps" if self.dataset is None else f"steps of the budget on {self.dataset}"
        stopped = (
            [] if self.stopped_by is None else [f"stopped by {self.stopped_by}; go on: neuralq resume {self.run_dir}"]
        )
        lines = [
            f"{self.env_steps:,} {counted}, {self.cpu_seconds:.2f} CPU-seconds of training, "
            f"{self.wall_seconds:.2f} seconds in all; {score}",
            *(f"{name.replace('_', ' ')} {value:.4g}" for name, value in self.measured.items()),
            *stopped,
        ]
        if self.play_off is not None and (decided := about(self.play_off)) is not None:
            lines.append(decided)
        if self.exact is not None:
            lines += Comparison(**self.exact).lines()
        if self.monitor is not None and self.monitor["alarms"]:
            lines.append(f"it may have diverged ({', '.join(self.monitor['alarms'])}): {self.monitor['seen']}")
        return lines


def _result(config: RunConfig, session: Session, progress: Progress, folder: RunFolder) -> Run:
    play_off = progress.agent
    agent = "final" if play_off is None else str(play_off["agent"])
    told = {"greedy_return": progress.greedy_return, "agent_standard_error": _last_error(folder.metrics_path)}
    score = score_of({**told, "play_off": play_off})
    exact = _beside_exact(session, folder, agent)
    return Run(
        run_dir=folder.named,
        env_steps=session.env_steps,
        cpu_seconds=progress.cpu_seconds,
        wall_seconds=progress.wall_seconds,
        greedy_return=progress.greedy_return,
        agent_return=None if score is None else score.mean,
        agent_standard_error=None if score is None else score.standard_error,
        parameters_sha256=session.learner.engine.flat.sha256(),
        reached=None if config.stop_at_return is None else progress.reached_at is not None,
        interrupted_by=progress.interrupted_by,
        resumability=session.resumability.reason if progress.moved is None else f"{NOT_EXACT}: {progress.moved}",
        engine=engine_name(session.learner),
        stopped_by=progress.stopped_by,
        dataset=config.dataset,
        agent=agent,
        play_off=play_off,
        exact=exact,
        measured=session.measures(),
        monitor=monitor_verdict(progress.hook_states),
    )


def _last_error(metrics: Path) -> float | None:
    """Standard error of the last evaluation, by its row."""
    listed = [row.get("returns") for row in read_rows(metrics) if row.get("kind") == "evaluation"]
    return Evaluation(tuple(listed[-1]), (), 0).standard_error if listed and listed[-1] else None


def _beside_exact(session: Session, folder: RunFolder, agent: str) -> dict[str, Any] | None:
    """What the agent learned beside the exact answer; what a picture is drawn from is left in the folder."""
    beside = session.beside
    if beside is None:
        return None
    with session.playing_with(load_best(folder.path) if agent == "best" else None):
        held = beside.held(session.learner.engine.all, session.value_scale)
    if held is None:
        return None
    if (drawing := held.drawing()) is not None:
        write_durably(
            folder.path / DRAWING_NAME, to_json(plain_values(drawing, DRAWING_NAME), DRAWING_NAME, sealed=True)
        )
    return held.compared().plain()


def agent_of(run_dir: str | Path) -> str:
    """Which parameters are the agent of a run: "final", or "best" where the run ended with those.

    Raises:
        CheckpointError: if no checkpoint is intact.
    """
    return _agent_in(checkpoint.load_newest(Path(run_dir) / "checkpoints").state)


def _agent_in(state: Mapping[str, Any]) -> str:
    return str((state["progress"].get("agent") or {"agent": "final"})["agent"])


def _load_agent(run_dir: str | Path, best: bool | None) -> Agent:
    config = config_from_dict(read_config(run_dir))
    parameters, statistics, scalings = _kept(Path(run_dir), best)
    envs = make_envs(config, 1)
    try:
        seen = normalisation_for(config, envs)
        if seen is not None:
            seen.load_state_dict(statistics)
            seen = seen.frozen()
        stream = interaction(config, envs, 0, seen)
        stream.encoder.require_scalings(scalings)
        q = build_q(config, stream.spec, np.random.default_rng(0))
        FlatParameters(q).load(parameters)  # type: ignore[arg-type]
        _, first_action = discrete_actions(envs.single_action_space)
        scale = config.reward_scale * (1.0 if seen is None else seen.reward_scale)
        return Agent(q, stream.encoder, stream.spec, first_action, scale, seen, Path(run_dir))
    finally:
        envs.close()


def _kept(run_dir: Path, best: bool | None) -> tuple[Tensor, Any, Any]:
    """The flat parameters, and the statistics and the scales through which observations were seen."""
    newest = None if best else checkpoint.load_newest(run_dir / "checkpoints")
    if newest is None or (best is None and _agent_in(newest.state) == "best"):
        try:
            kept = load_best(run_dir)
        except checkpoint.CheckpointError as error:
            if best:
                raise
            raise checkpoint.CheckpointError(f"{error}; these are the run's agent, --final takes the last") from error
        return kept.parameters, kept.normalisation, kept.scalings
    saved = newest.state
    compared(saved.get("origin"), read_config(run_dir), newest.path, read_changes(run_dir))
    state = saved["learner"]
    parameters = state["parameters"] if "parameters" in state else state["descent"]["parameters"]
    if state.get("average") is not None:
        parameters = state["average"]["values"]
    return torch.as_tensor(parameters), saved["stream"].get("normalisation"), saved["stream"].get("scalings")


def _chosen(run_dir: Path) -> Agent:
    return _load_agent(run_dir, None)


def evaluate_run(run_dir: str | Path, num_episodes: int = 100, seed: int = 0, best: bool | None = None) -> Evaluation:
    """Greedy returns of a run's agent (`neuralq.load`), on fresh episodes.

    Args:
        run_dir: folder of the run.
        num_episodes: how many episodes.
        seed: of the episodes; unrelated to those seen in training.
        best: True to play with the parameters whose greedy evaluation scored highest, False with the last.

    Raises:
        ValueError: if the run has learned no policy.
    """
    check_whole("num_episodes", num_episodes)
    check_whole("seed", seed, 0)
    config = config_from_dict(read_config(run_dir))
    if not getattr(config.settings, "acts", True):
        raise ValueError(
            f"{run_dir} predicts and has no policy that could be played; its metrics have what it learned: "
            f"neuralq report {run_dir}"
        )
    agent = _load_agent(run_dir, best)
    with limited_threads(config.threads):
        envs = make_evaluation_envs(config, min(num_episodes, 64))
        try:
            stream = remembering(interaction(config, envs, 0, agent.normalisation), agent.q)
            with torch.no_grad():
                most = config.evaluation_max_steps or last_cap(run_dir)
                found = evaluate_greedy(agent.q.all, stream, num_episodes, seed_for(seed, 7), most)
            discounts = getattr(config.settings, "discounts", True)
            beside = Beside.of(envs, stream.spec, config.gamma, config.exact) if discounts else None
            if beside is None:
                return found
            beside.load_state_dict(checkpoint.load_newest(Path(run_dir) / "checkpoints").state.get("met"))
            return dataclasses.replace(
                found, about_exact=beside.look(), exact=beside.compare(agent.q.all, agent.reward_scale)
            )
        finally:
            envs.close()


def last_cap(run_dir: str | Path) -> int:
    """After how many steps the run's own evaluations were cut, where they learned that in training."""
    rows = read_rows(Path(run_dir) / "metrics.jsonl")
    caps = (row["max_steps"] for row in reversed(rows) if isinstance(row.get("max_steps"), int))
    return max(1, next(caps, MOST_STEPS))


def _opening(config: RunConfig, session: Session) -> list[str]:
    warned = [f"warning: {line}" for line in warnings_ahead(config, session.stream)]
    told = [session.stream.told] if isinstance(session.stream, Playback) else []
    return [*told, *opening_lines(session.stream), *warned]


def _notes(config: RunConfig, latest: Mapping[str, Any]) -> list[str]:
    exploration = Linear(config.epsilon_start, config.epsilon_end, config.epsilon_decay_steps)
    notes = [f"ε {exploration.value(latest['env_steps']):.3g}"]
    for name, label in (("abs_td_error", "|δ|"), ("max_q", "max Q")):
        if name in latest:
            notes.append(f"{label} {latest[name]:.3g}")
    if "episode_return" in latest:
        notes.append(f"return {shown(latest['episode_return'])}")
    if "alarm" in latest:
        notes.append(f"may diverge: {latest['alarm']}")
    if "q_error_mean" in latest:
        notes.append(f"|Q − Q*| {latest['q_error_mean']:.3g}, regret {latest['regret']:.3g}")
    if "greedy_return" in latest:
        goal = "" if config.stop_at_return is None else f" (target {config.stop_at_return:g})"
        notes.append(f"greedy {shown(latest['greedy_return'])}{goal}")
    notes += [f"{name.replace('_', ' ')} {latest[name]:.3g}" for name in _MEASURES if name in latest]
    if latest.get("num_cut"):
        notes.append(f"{latest['num_cut']} of {len(latest['returns'])} evaluation episodes cut")
    return notes


_MEASURES = ("value_error_rms", "average_reward")
_CHANGEABLE = frozenset(
    "stop_at_return evaluate_every evaluation_episodes evaluation_max_steps checkpoint_every log_every "
    "resume_probe exact monitor".split()
) | {f"{name}.{setting}" for name, kind in LEARNERS.items() for setting in kind.step_sizes}
CONTROL = Kind(
    name="control",
    title="a run on an environment",
    config=RunConfig,
    budget="total_steps",
    to_plain=config_to_dict,
    from_plain=config_from_dict,
    default_path=lambda config: default_run_path(config.env, config.layout, config.seed, datetime.now()),
    num_threads=lambda config: config.threads,
    build=lambda config: build_session(config),
    plan=plan_of,
    result=_result,
    load=_load_agent,
    notes=_notes,
    changeable=_CHANGEABLE,
    opening=_opening,
    start=lambda config, session: config if config.warm_start is None else begun_from(config, session, _chosen),
    watchers=watchers,
)
