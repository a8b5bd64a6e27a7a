"""``neuralq export``: a run's network as an ONNX file, checked against the values that the run itself computes."""

from __future__ import annotations

import importlib.metadata
import json
import os
import secrets
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.sweeps import add_trust, single_run
from neuralq.checks import MissingExtra
from neuralq.runs import RunConfig, load
from neuralq.runs.agent import Agent
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.recipe.games import make_single
from neuralq.runs.stream import legal_actions
from neuralq.types import Array

__all__ = ["export"]

_TOLERANCE = 1e-5
_OPSET = 17
_NUM_OBSERVATIONS = 256


def export(argv: list[str]) -> int:
    """Write the ONNX file; exit status 1, and no file, if its values are not the run's."""
    parser = command_parser(
        "export",
        "Write a run's network as ONNX: observations in, action values in units of the environment's return and the "
        "greedy action out, in batches of any size. The file is run beside the original before it is kept.",
        "neuralq export RUN --onnx policy.onnx",
    )
    parser.add_argument("run", help="run folder")
    parser.add_argument("--onnx", required=True, metavar="FILE", help="the file to write")
    parser.add_argument("--best", action="store_true", help="take the best parameters of the run, not the last")
    add_trust(parser)
    options = parser.parse_args(argv)
    path, out = single_run(options.run, options.trust), Path(options.onnx)
    if not out.absolute().parent.is_dir():
        raise Failure(f"there is no folder {out.parent}; make it first")
    config = config_from_dict(read_config(path))
    agent = load(path, options.best)
    observations, expected = _played(config, agent)
    difference, bound = _write_checked(agent, config, out, observations, expected)
    plain = {
        "onnx": str(out),
        "run_dir": str(path),
        "bytes": out.stat().st_size,
        "max_abs_difference": difference,
        "allowed": bound,
        "num_observations": len(observations),
        "input": {"name": "observation", "dtype": str(observations.dtype), "shape": ["n", *agent.spec.shape]},
        "outputs": ["values", "action"],
    }
    lines = [
        f"{out}: {out.stat().st_size:,} bytes; in: observation {observations.dtype} [n, "
        f"{', '.join(map(str, agent.spec.shape))}]".replace(", ]", "]") + "; out: values, action",
        f"largest difference from the run's own values over {len(observations)} observations: {difference:.2g}",
    ]  # fmt: skip
    print_result(plain, options.json, lines)
    return 0


def _write_checked(
    agent: Agent, config: RunConfig, out: Path, observations: Array, expected: Array
) -> tuple[float, float]:
    """Write the file if its values are those expected; how far they differ, and how far they may."""
    partial = out.with_name(f".partial-{secrets.token_hex(8)}")  # a name that nobody can foresee
    try:
        _write(agent, observations, partial, config)
        difference, bound = _difference(partial, observations, expected, agent)
        if not difference <= bound:
            raise Failure(
                f"the exported network differs from the run's by {difference:.2g}, and {bound:.2g} is allowed; "
                "nothing was written"
            )
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)
    return difference, bound


class _Exported(nn.Module):
    """Encoded observations ``[n, *obs]`` to action values ``[n, A]`` in the environment's units, and greedy actions."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.q = agent.q
        self.scale = agent.reward_scale
        self.first_action = agent.first_action
        scaling = None if agent.normalisation is None else agent.normalisation.scaling()
        self.is_normalised = scaling is not None
        if scaling is not None:
            mean, inverse = scaling
            self.register_buffer("mean", torch.as_tensor(mean))
            self.register_buffer("inverse", torch.as_tensor(inverse))

    def forward(self, s: Tensor) -> tuple[Tensor, Tensor]:
        if self.is_normalised:
            mean, inverse = self.get_buffer("mean"), self.get_buffer("inverse")
            flat = s.flatten(1)
            width = mean.shape[0]  # what follows is the action mask
            rows = ((flat[:, :width].double() - mean) * inverse).float()
            s = torch.cat([rows, flat[:, width:]], 1).reshape(s.shape)
        values = self.q.all(s) / self.scale
        return values, values.argmax(-1) + self.first_action


def _played(config: RunConfig, agent: Agent) -> tuple[Array, Array]:
    """Encoded observations of random play ``[n, *obs]``, and the agent's values of them ``[n, A]`` float64."""
    env = make_single(config.env, config.env_kwargs)
    rng = np.random.default_rng(0)
    rows, values = [], []
    try:
        observation, info = env.reset(seed=0)
        for _ in range(_NUM_OBSERVATIONS):
            mask = legal_actions(env, info)
            rows.append(_encoded(agent, observation, mask))
            values.append(agent.values(observation, mask))
            legal = np.flatnonzero(np.isfinite(values[-1]))
            action = int(rng.choice(legal)) + agent.first_action
            observation, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                observation, info = env.reset()
    finally:
        env.close()
    return np.stack(rows), np.stack(values)


def _encoded(agent: Agent, observation: Any, mask: Any) -> Array:
    encoded = np.asarray(agent.encoder.encode_single(observation))
    if agent.spec.masked:
        legal = np.ones(agent.spec.num_actions) if mask is None else np.asarray(mask) != 0
        encoded = np.concatenate([encoded.reshape(-1), legal])
    return encoded.astype(agent.spec.dtype)


def _write(agent: Agent, observations: Array, path: Path, config: RunConfig) -> None:
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra(f'ONNX is not installed ({error}); install it with: pip install "neuralq[onnx]"') from error
    network = _Exported(agent).cpu().eval()
    names = ["observation", "values", "action"]
    with warnings.catch_warnings():
        # The exporter that traces: it needs the package onnx alone. What it warns of (values read while tracing) is
        # what the comparison afterwards, with other batch sizes, would show.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (torch.from_numpy(observations[:2]),),
            str(path),
            input_names=names[:1],
            output_names=names[1:],
            dynamic_axes={name: {0: "n"} for name in names},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    facts = {"env": config.env, "layout": config.layout, "gamma": config.gamma, "first_action": agent.first_action}
    facts |= {"neuralq": importlib.metadata.version("neuralq"), "masked": agent.spec.masked}
    for name, value in facts.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = name, value if isinstance(value, str) else json.dumps(value)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def _difference(path: Path, observations: Array, expected: Array, agent: Agent) -> tuple[float, float]:
    """Largest difference of values, ∞ where illegal or greedy actions differ, and what float32 is allowed.

    Values of some hundreds are known to float32 no better than 1e-5, so the bound is relative above 1.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingExtra(
            f'onnxruntime is not installed ({error}); install it with: pip install "neuralq[onnx]"'
        ) from error
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found, actions = session.run(None, {"observation": observations})
    alone, _ = session.run(None, {"observation": observations[:1]})
    found = np.concatenate([found, alone]).astype(np.float64)
    expected = np.concatenate([expected, expected[:1]])
    finite = np.isfinite(expected)
    bound = _TOLERANCE * max(1.0, float(np.max(np.abs(expected[finite]))))
    if not np.array_equal(finite, np.isfinite(found)):
        return np.inf, bound
    chosen = np.take_along_axis(expected[:-1], (actions - agent.first_action)[:, None], axis=-1)[:, 0]
    if np.any(expected[:-1].max(-1) - chosen > 2 * bound):  # ties may fall either way within the bound
        return np.inf, bound
    return float(np.max(np.abs(found[finite] - expected[finite]))), bound
