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
from neuralq.runs.evaluation import MOST_STEPS, Evaluation, evaluate_greedy, shown
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.best import load_best
from neuralq.runs.folder.files import read_rows
from neuralq.runs.folder.origin import compared
from neuralq.runs.folder.run_folder import RunFolder, default_run_path, read_config
from neuralq.runs.kinds import Kind, limited_threads
from neuralq.runs.loop import NOT_EXACT, Progress, seed_for
from neuralq.runs.recipe.build import (
    build_q,
    build_session,
    engine_name,
    normalisation_for,
    plan_of,
)
from neuralq.runs.recipe.config import RunConfig, config_from_dict, config_to_dict
from neuralq.runs.recipe.environments import make_envs, make_evaluation_envs
from neuralq.runs.recipe.lookahead import warnings_ahead
from neuralq.runs.recipe.opening import opening_lines
from neuralq.runs.session import Session
from neuralq.runs.stream import Interaction
from neuralq.runs.stream.encoding import discrete_actions

__all__ = ["CONTROL", "Run", "evaluate_run", "last_cap"]


@dataclass(frozen=True)
class Run:
    """The result of a run on an environment.

    Args:
        run_dir: its folder.
        env_steps: environment steps.
        cpu_seconds: CPU time of training, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        greedy_return: mean return of the last greedy evaluation.
        parameters_sha256: of the flat parameter vector's bytes.
        reached: whether ``stop_at_return`` was met; None where none was asked for.
        interrupted_by: name of the signal that ended it early, or None.
        resumability: how exactly it can be resumed, in words.
        engine: what computed values and gradients: "compiled" kernels, "torch", or both, each what it can.
        stopped_by: which hook ended it before its budget was spent, and why; None if none did.
    """

    run_dir: Path
    env_steps: int
    cpu_seconds: float
    wall_seconds: float
    greedy_return: float | None
    parameters_sha256: str
    reached: bool | None
    interrupted_by: str | None
    resumability: str
    engine: str
    stopped_by: str | None = None

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return {**dataclasses.asdict(self), "run_dir": str(self.run_dir)}

    def lines(self) -> list[str]:
        """The same for people."""
        score = "not evaluated" if self.greedy_return is None else f"greedy return {shown(self.greedy_return)}"
        stopped = (
            [] if self.stopped_by is None else [f"stopped by {self.stopped_by}; go on: neuralq resume {self.run_dir}"]
        )
        return [
            f"{self.env_steps:,} environment steps, {self.cpu_seconds:.2f} CPU-seconds of training, "
            f"{self.wall_seconds:.2f} seconds in all; {score}",
            *stopped,
        ]


def _result(config: RunConfig, session: Session, progress: Progress, folder: RunFolder) -> Run:
    return Run(
        run_dir=folder.named,
        env_steps=session.env_steps,
        cpu_seconds=progress.cpu_seconds,
        wall_seconds=progress.wall_seconds,
        greedy_return=progress.greedy_return,
        parameters_sha256=session.learner.engine.flat.sha256(),
        reached=None if config.stop_at_return is None else progress.reached_at is not None,
        interrupted_by=progress.interrupted_by,
        resumability=session.resumability.reason if progress.moved is None else f"{NOT_EXACT}: {progress.moved}",
        engine=engine_name(session.learner),
        stopped_by=progress.stopped_by,
    )


def _load_agent(run_dir: str | Path, best: bool) -> Agent:
    config = config_from_dict(read_config(run_dir))
    parameters, statistics, scalings = _kept(Path(run_dir), best)
    envs = make_envs(config, 1)
    try:
        seen = normalisation_for(config, envs)
        if seen is not None:
            seen.load_state_dict(statistics)
            seen = seen.frozen()
        stream = Interaction(envs, config.gamma, 0, config.layout == "table", seen)
        stream.encoder.require_scalings(scalings)
        q = build_q(config, stream.spec, np.random.default_rng(0))
        FlatParameters(q).load(parameters)  # type: ignore[arg-type]
        _, first_action = discrete_actions(envs.single_action_space)
        scale = config.reward_scale * (1.0 if seen is None else seen.reward_scale)
        return Agent(q, stream.encoder, stream.spec, first_action, scale, seen, Path(run_dir))
    finally:
        envs.close()


def _kept(run_dir: Path, best: bool) -> tuple[Tensor, Any, Any]:
    """The flat parameters, and the statistics and the scales through which observations were seen."""
    if best:
        kept = load_best(run_dir)
        return kept.parameters, kept.normalisation, kept.scalings
    newest = checkpoint.load_newest(run_dir / "checkpoints")
    saved = newest.state
    compared(saved.get("origin"), read_config(run_dir), newest.path)
    state = saved["learner"]
    parameters = state["parameters"] if "parameters" in state else state["descent"]["parameters"]
    if state.get("average") is not None:
        parameters = state["average"]["values"]
    return torch.as_tensor(parameters), saved["stream"].get("normalisation"), saved["stream"].get("scalings")


def evaluate_run(run_dir: str | Path, num_episodes: int = 100, seed: int = 0, best: bool = False) -> Evaluation:
    """Greedy returns of a run's newest checkpoint, or of its best evaluation, on fresh episodes.

    Args:
        run_dir: folder of the run.
        num_episodes: how many episodes.
        seed: of the episodes; unrelated to those seen in training.
        best: play with the parameters whose greedy evaluation scored highest, in place of the newest.
    """
    check_whole("num_episodes", num_episodes)
    check_whole("seed", seed, 0)
    config = config_from_dict(read_config(run_dir))
    agent = _load_agent(run_dir, best)
    with limited_threads(config.threads):
        envs = make_evaluation_envs(config, min(num_episodes, 64))
        try:
            stream = Interaction(envs, config.gamma, 0, config.layout == "table", agent.normalisation)
            with torch.no_grad():
                most = config.evaluation_max_steps or last_cap(run_dir)
                return evaluate_greedy(agent.q.all, stream, num_episodes, seed_for(seed, 7), most)
        finally:
            envs.close()


def last_cap(run_dir: str | Path) -> int:
    """After how many steps the run's own evaluations were cut, where they learned that in training."""
    rows = read_rows(Path(run_dir) / "metrics.jsonl")
    caps = (row["max_steps"] for row in reversed(rows) if isinstance(row.get("max_steps"), int))
    return max(1, next(caps, MOST_STEPS))


def _opening(config: RunConfig, session: Session) -> list[str]:
    warned = [f"warning: {line}" for line in warnings_ahead(config, session.stream)]
    return [*opening_lines(session.stream), *warned]


def _notes(config: RunConfig, latest: Mapping[str, Any]) -> list[str]:
    exploration = Linear(config.epsilon_start, config.epsilon_end, config.epsilon_decay_steps)
    notes = [f"ε {exploration.value(latest['env_steps']):.3g}"]
    for name, label in (("abs_td_error", "|δ|"), ("max_q", "max Q")):
        if name in latest:
            notes.append(f"{label} {latest[name]:.3g}")
    if "episode_return" in latest:
        notes.append(f"return {shown(latest['episode_return'])}")
    if "greedy_return" in latest:
        goal = "" if config.stop_at_return is None else f" (target {config.stop_at_return:g})"
        notes.append(f"greedy {shown(latest['greedy_return'])}{goal}")
    if latest.get("num_cut"):
        notes.append(f"{latest['num_cut']} of {len(latest['returns'])} evaluation episodes cut")
    return notes


_CHANGEABLE = frozenset(
    "stop_at_return evaluate_every evaluation_episodes evaluation_max_steps checkpoint_every log_every "
    "resume_probe".split()
)
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
)
