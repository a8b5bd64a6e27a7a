"""Agents of Stable-Baselines3 (DQN) and sb3-contrib (QR-DQN): a zip of JSON and of weights.

The JSON holds some values as base64 of cloudpickle under ``":serialized:"``; those are programs and never decoded. What
they stand for is written beside them as text, and that is what is read.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.networks import ACTIVATIONS, FromFrames, stack, under
from neuralq.doctor.origins.record import Origin
from neuralq.doctor.subject import Settings, Subject, of_network, plain_outputs
from neuralq.doctor.weights import CannotLoad, plain_bytes, read_members, read_state
from neuralq.runs.folder.files import parse_json
from neuralq.types import Array

__all__ = ["STABLE_BASELINES"]

_READ = ("data", "policy.pth", "policy.optimizer.pth", "_stable_baselines3_version")
_HEADS = {"q_net": "q_net", "quantile_net": "quantile_net"}  # DQN's and QR-DQN's


def _recognises(path: Path) -> bool:
    if not (path.is_file() and zipfile.is_zipfile(path)):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {"data", "policy.pth"} <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def _load(path: Path, net: str | None, env: Any) -> Subject:
    if net is not None:
        raise CannotLoad(f"{path} says itself what its network is; leave --net out")
    members = read_members(plain_bytes(path), lambda name: name in _READ, str(path))
    told = _told(members["data"], path)
    state = read_state(members["policy.pth"], f"{path}: policy.pth")
    head = next((name for name in _HEADS if any(str(key).startswith(f"{name}.") for key in state)), None)
    if head is None:
        some = ", ".join(str(key) for key in list(state)[:3])
        raise CannotLoad(
            f"{path} holds no action values: its weights are {some}, …; the doctor takes DQN and sb3-contrib's QR-DQN"
        )
    foreign = [k for k in state if not str(k).startswith((f"{head}.", f"{head}_target."))]
    if foreign:
        raise CannotLoad(f"{path}: policy.pth has the key {foreign[0]!r}, which a policy of {head} lacks")
    network, target = (_network(under(state, f"{name}."), head, told, str(path)) for name in (head, f"{head}_target"))
    num_actions = _whole(_field(told, "action_space", "n"), "action_space.n", path)
    outputs = _mean_of_quantiles(num_actions) if head == "quantile_net" else plain_outputs
    version = members.get("_stable_baselines3_version", b"?").decode("utf-8", "replace")[:20].strip()
    kind = "QR-DQN of sb3-contrib" if head == "quantile_net" else f"DQN of Stable-Baselines3 {version}"
    return of_network(
        network, f"{kind} ({path.name})", encode=_encoder(told, path), outputs=outputs, target=target,
        settings=_settings(told, members.get("policy.optimizer.pth"), str(path)), num_actions=num_actions,
        first_action=_whole(_field(told, "action_space", "start", "0"), "action_space.start", path),
    )  # fmt: skip


def _told(raw: bytes, path: Path) -> dict[str, Any]:
    try:
        told = parse_json(raw)
    except ValueError as error:
        raise CannotLoad(f"{path}: its member 'data' is no JSON ({error}); save the agent again") from error
    if not isinstance(told, dict):
        raise CannotLoad(f"{path}: its member 'data' must be a JSON object, got {type(told).__name__}")
    return {key: _without_programs(value) for key, value in told.items()}


def _without_programs(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: inner for key, inner in value.items() if key != ":serialized:"}
    return value


def _field(told: Mapping[str, Any], name: str, key: str, default: Any = None) -> Any:
    value = told.get(name)
    return value.get(key, default) if isinstance(value, Mapping) else default


def _whole(value: Any, name: str, path: Path) -> int:
    if not re.fullmatch(r"-?\d{1,9}", str(value)):
        raise CannotLoad(
            f"{path}: {name} must be a whole number, got {str(value)[:40]!r}; the doctor takes Discrete actions"
        )
    return int(value)


def _network(state: dict[str, Tensor], head: str, told: Mapping[str, Any], what: str) -> nn.Module:
    written = str(_field(told, "policy_kwargs", "activation_fn", "ReLU"))
    named = re.search(r"\.(\w+)'>$", written)
    name = named[1] if named else written
    if name not in ACTIVATIONS:
        raise CannotLoad(f"{what}: the activation {name[:40]!r} is not known; export the state dict and pass --net")
    kept = {key: value for key, value in state.items() if key.startswith(f"{head}.")}
    dense = stack(under(kept, f"{head}."), f"{what}: {head}.{head}", ACTIVATIONS[name])
    rest = {key: value for key, value in state.items() if key not in kept}
    if not rest:
        return dense
    frames, flat = under(rest, "features_extractor.cnn."), under(rest, "features_extractor.linear.")
    if len(frames) + len(flat) < len(rest) or not frames or not flat:
        raise CannotLoad(
            f"{what} has the key {next(iter(rest))!r}, which is no NatureCNN; export the state dict and pass --net"
        )
    scaled = (
        told.get("policy_kwargs", {}).get("normalize_images", True)
        if isinstance(told.get("policy_kwargs"), dict)
        else True
    )
    convolutions = nn.Sequential(*stack(frames, f"{what}: cnn", nn.ReLU), nn.ReLU())
    return FromFrames(
        convolutions, nn.Sequential(*stack(flat, f"{what}: linear"), nn.ReLU()), dense, 255.0 if scaled else 1.0
    )


def _mean_of_quantiles(num_actions: int) -> Any:
    def outputs(network: nn.Module, x: Tensor) -> Tensor:
        """sb3-contrib lays quantiles out before actions: ``[N, K·A] -> [N, K, A]``."""
        return cast(Tensor, network(x)).reshape(len(x), -1, num_actions).mean(1)

    return outputs


def _encoder(told: Mapping[str, Any], path: Path) -> Any:
    """Discrete observations become one-hot, pictures come with their channels first, all else is float32."""
    kind = str(_field(told, "observation_space", ":type:", ""))
    if "Discrete" in kind:
        size = _whole(_field(told, "observation_space", "n"), "observation_space.n", path)
        first = _whole(_field(told, "observation_space", "start", "0"), "observation_space.start", path)
        return lambda s: torch.eye(size)[torch.as_tensor(np.asarray(s, np.int64).reshape(-1) - first)]
    shape = tuple(_field(told, "observation_space", "_shape", ()) or ())

    def encode(observations: Array) -> Tensor:
        x = np.asarray(observations)
        if len(shape) == 3 and x.shape[1:] != shape and (x.shape[3], *x.shape[1:3]) == shape:
            x = np.moveaxis(x, 3, 1)  # VecTransposeImage
        return torch.as_tensor(np.ascontiguousarray(x, np.float32))

    return encode


def _settings(told: Mapping[str, Any], optimiser: bytes | None, what: str) -> Settings:
    def number(name: str) -> float | None:
        value = told.get(name)
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None

    steps, updates, interval = number("num_timesteps"), number("_n_updates"), number("target_update_interval")
    starts, share = number("learning_starts") or 0.0, number("exploration_fraction")
    period = None
    if steps and updates and interval:  # counted in environment steps
        at_once = number("gradient_steps") or 1.0  # updates between which nothing is copied
        period = max(interval * updates / max(steps - starts, 1.0), at_once, 1e-9)
    return Settings(
        gamma=number("gamma"), learning_rate=_last_rate(optimiser, what) or number("learning_rate"), tau=number("tau"),
        num_steps=number("n_steps") or 1.0, lambda_=0.0, target_period_updates=period, updates=updates, env_steps=steps,
        batch_size=number("batch_size"), capacity=number("buffer_size"),
        epsilon_start=number("exploration_initial_eps"), epsilon_end=number("exploration_final_eps"),
        epsilon_decay_steps=share * steps if share and steps else None, learning_starts=number("learning_starts"),
    )  # fmt: skip


def _last_rate(raw: bytes | None, what: str) -> float | None:
    if raw is None:
        return None
    groups = read_state(raw, f"{what}: policy.optimizer.pth").get("param_groups")
    rate = groups[0].get("lr") if isinstance(groups, list) and groups and isinstance(groups[0], dict) else None
    return float(rate) if isinstance(rate, int | float) and rate > 0 else None


STABLE_BASELINES = Origin("a zip of Stable-Baselines3 or sb3-contrib", _recognises, _load, place=1)
