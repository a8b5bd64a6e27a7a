"""``neuralq export``: a run's network as an ONNX file, checked against the values that the run itself computes."""

from __future__ import annotations

import copy
import importlib.metadata
import json
import os
import secrets
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.export_network import ExportedNetwork, input_names, raw_inputs
from neuralq.apps.cli.sweeps import add_trust, add_which, single_run
from neuralq.checks import MissingExtra
from neuralq.runs import RunConfig, load
from neuralq.runs.agent import Agent
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.recipe.games import make_single
from neuralq.runs.stream import faults_of, legal_actions
from neuralq.types import Array

__all__ = ["export"]

_TOLERANCE = 1e-5
_OPSET = 17
_NUM_OBSERVATIONS = 256


def export(argv: list[str]) -> int:
    """Write the ONNX file; exit status 1, and no file, if its values are not the run's."""
    parser = command_parser(
        "export",
        "Write a run's network as ONNX: what the environment hands out in, an input for each part of it; action values "
        "in units of the environment's return and the greedy action out, in batches of any size. The file is run "
        "beside the original before it is kept.",
        "neuralq export RUN --onnx policy.onnx",
    )
    parser.add_argument("run", help="run folder")
    parser.add_argument("--onnx", required=True, metavar="FILE", help="the file to write")
    add_which(parser)
    add_trust(parser)
    options = parser.parse_args(argv)
    path, out = single_run(options.run, options.trust), Path(options.onnx)
    if not out.absolute().parent.is_dir():
        raise Failure(f"there is no folder {out.parent}; make it first")
    config = config_from_dict(read_config(path))
    agent = load(path, options.best)
    inputs, expected = _played(config, agent)
    difference, bound = _write_checked(agent, config, out, inputs, expected)
    plain = {
        "onnx": str(out),
        "run_dir": str(path),
        "bytes": out.stat().st_size,
        "max_abs_difference": difference,
        "allowed": bound,
        "num_observations": len(expected),
        "inputs": _described(agent, inputs),
        "outputs": ["values", "action"],
    }
    shown = ", ".join(
        f"{one['name']} {one['dtype']} [{', '.join(map(str, one['shape']))}]" for one in _described(agent, inputs)
    )
    lines = [
        f"{out}: {out.stat().st_size:,} bytes; in: {shown}, as the environment gives it; out: values, action",
        f"largest difference over {len(expected)} observations: {difference:.2g}",
    ]
    print_result(plain, options.json, lines)
    return 0


def _described(agent: Agent, inputs: Sequence[Array]) -> list[dict[str, Any]]:
    return [
        {"name": name, "dtype": str(x.dtype), "shape": ["n", *x.shape[1:]]}
        for name, x in zip(input_names(agent), inputs, strict=True)
    ]


def _write_checked(
    agent: Agent, config: RunConfig, out: Path, inputs: Sequence[Array], expected: Array
) -> tuple[float, float]:
    """Write the file if its values are those expected; how far they differ, and how far they may."""
    partial = out.with_name(f".partial-{secrets.token_hex(8)}")  # a name that nobody can foresee
    try:
        _write(agent, inputs, partial, config)
        difference, bound = _difference(partial, inputs, expected, agent)
        if not difference <= bound:
            raise Failure(
                f"the exported network differs from the run's by {difference:.2g}, and {bound:.2g} is allowed; "
                "nothing was written"
            )
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)
    return difference, bound


def _played(config: RunConfig, agent: Agent) -> tuple[list[Array], Array]:
    """What an environment hands out in random play, one array per input, and the agent's values of it ``[n, A]``."""
    env = make_single(config.env, config.env_kwargs)
    rng = np.random.default_rng(0)
    observations, masks, values = list[Any](), list[Any](), []
    try:
        with faults_of("at reset"):
            observation, info = env.reset(seed=0)
        for _ in range(_NUM_OBSERVATIONS):
            mask = legal_actions(env, info)
            observations.append(copy.deepcopy(observation))  # environments may reuse theirs
            masks.append(copy.deepcopy(mask))
            values.append(agent.values(observation, mask))
            legal = np.flatnonzero(np.isfinite(values[-1]))
            action = int(rng.choice(legal)) + agent.first_action
            with faults_of("in a step of random play"):
                observation, _, terminated, truncated, info = env.step(action)
                if terminated or truncated:
                    observation, info = env.reset()
    finally:
        env.close()
    return raw_inputs(agent, observations, masks), np.stack(values)


def _write(agent: Agent, inputs: Sequence[Array], path: Path, config: RunConfig) -> None:
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra(f'ONNX is not installed ({error}); install it with: pip install "neuralq[onnx]"') from error
    network = ExportedNetwork(agent).cpu().eval()
    given = input_names(agent)
    names = [*given, "values", "action"]
    with warnings.catch_warnings():
        # The exporter that traces: it needs the package onnx alone. What it warns of (values read while tracing) is
        # what the comparison afterwards, with other batch sizes, would show.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(torch.from_numpy(x[:2]) for x in inputs),
            str(path),
            input_names=given,
            output_names=names[len(given) :],
            dynamic_axes={name: {0: "n"} for name in names},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    facts = {"env": config.env, "layout": config.layout, "gamma": config.gamma, "first_action": agent.first_action}
    facts |= {"inputs": _described(agent, inputs)}
    facts |= {"neuralq": importlib.metadata.version("neuralq"), "masked": agent.spec.masked}
    for name, value in facts.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = name, value if isinstance(value, str) else json.dumps(value)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def _difference(path: Path, inputs: Sequence[Array], expected: Array, agent: Agent) -> tuple[float, float]:
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
    names = input_names(agent)
    found, actions = session.run(None, dict(zip(names, inputs, strict=True)))
    alone, _ = session.run(None, {name: x[:1] for name, x in zip(names, inputs, strict=True)})
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
