"""Beginning with the weights of another run of the same shape, and with what it knew of its observations.

The configuration of the run that begins names the other one's folder and the SHA-256 of the weights it took. Its
optimiser, counters and random numbers begin anew.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from neuralq.q import Rule, insert_rules
from neuralq.runs.agent import Agent
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.loop import seed_for
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.session import Session
from neuralq.runs.stream import Normalisation

__all__ = ["begun_from"]

_SEAL = "@sha256:"


def begun_from(config: RunConfig, session: Session, load: Callable[[Path], Agent]) -> RunConfig:
    """Put the weights of the run that ``config.warm_start`` names into a session that has not begun.

    Args:
        config: of the run that begins; the folder may have the SHA-256 of its weights behind it, which must be theirs.
        session: as it was built; changed in place.
        load: the agent of a run folder.

    Returns:
        The configuration with the SHA-256 of the weights.

    Raises:
        ValueError: if the other run is of another shape, naming the layer; or has other weights than were named.
        RunFolderError: if there is no run in the folder.
    """
    assert config.warm_start is not None
    path, _, named = config.warm_start.partition(_SEAL)
    if (kind := read_config(path).get("kind", "control")) != "control":
        raise ValueError(f"cannot begin with the weights of {path}: it is a run of {kind}; name one on an environment")
    agent = load(Path(path))
    q = session.learner.engine.q
    assert isinstance(agent.q, nn.Module) and isinstance(q, nn.Module)
    found = _digest(_weights(agent.q))
    if config.rules:
        agent.q = insert_rules(agent.q, cast("tuple[Rule, ...]", config.rules))
    if (what := _mismatch(agent, read_config(path), q, config, session)) is not None:
        raise ValueError(f"cannot begin with the weights of {path}: {what}")
    if named and found != named:
        raise ValueError(
            f"{path} has other weights than those that the run was to begin with (sha256 {found[:12]}…, not "
            f"{named[:12]}…); to begin a run with them as they are now: --warm-start {path}"
        )
    _begin(session, _weights(agent.q), agent, seed_for(config.seed, 0))
    return dataclasses.replace(config, warm_start=f"{path}{_SEAL}{found}")


def _weights(q: Any) -> Tensor:
    return torch.cat([p.detach().reshape(-1) for p in q.parameters()])


def _digest(weights: Tensor) -> str:
    return hashlib.sha256(weights.cpu().contiguous().numpy().tobytes()).hexdigest()


def _mismatch(agent: Agent, there: Any, q: nn.Module, config: RunConfig, session: Session) -> str | None:
    """What keeps these weights from meaning here what they meant there, in words with the way out."""
    mine, parameters = q.state_dict(), dict(q.named_parameters())
    theirs = agent.q.state_dict()  # type: ignore[attr-defined]
    for name in dict.fromkeys([*theirs, *mine]):
        if name not in mine or name not in theirs:
            where = "there and not here" if name in theirs else "here and not there"
            return f"the layer {name} is {where}; take its body"
        if theirs[name].shape != mine[name].shape:
            shapes = f"{tuple(theirs[name].shape)} there and {tuple(mine[name].shape)} here"
            return f"the layer {name} has the shape {shapes}; take its body, layout and environment"
        if name not in parameters and not torch.equal(theirs[name].cpu(), mine[name].cpu()):
            return f"{name} has other values there than here; take the same settings"
    pairs = {name: (there.get(name), getattr(config, name)) for name in ("layout", "dueling", "reward_scale")}
    pairs["activation"] = _activation(agent.q), _activation(q)
    ways = [_normalised(agent.normalisation), _normalised(session.stream.normalisation)]
    pairs |= {name: (ways[0][name], ways[1][name]) for name in ways[0]}
    for name, (other, own) in pairs.items():
        if other != own:
            return f"{name} is {other} there and {own} here; take the same"
    try:
        session.stream.encoder.require_scalings(agent.encoder.scalings)
    except ValueError:
        return "its observations were scaled otherwise; take an environment with the same bounds"
    return None


def _normalised(seen: Normalisation | None) -> dict[str, bool]:
    on = (False, False) if seen is None else (seen.observations, seen.rewards)
    return dict(zip(("normalised observations", "normalised rewards"), on, strict=True))


def _activation(q: Any) -> Any:
    return next((m.activation for m in q.modules() if isinstance(getattr(m, "activation", None), str)), None)


def _begin(session: Session, weights: Tensor, agent: Agent, seed: int) -> None:
    learner, mine = session.learner, session.stream.normalisation
    state = learner.state_dict()
    place = state if "parameters" in state else state["descent"]
    place["parameters"] = weights
    if place.get("target") is not None:
        place["target"] = weights
    if state.get("average") is not None:
        state["average"] = {**state["average"], "values": weights}
    learner.load_state_dict(state)
    if mine is not None and agent.normalisation is not None:
        theirs = agent.normalisation.state_dict()
        mine.load_state_dict(
            {**theirs, "returns": mine.state_dict()["returns"]}
        )  # of episodes that nobody goes on with
        session.stream.restart(seed)  # its first observations were seen without
