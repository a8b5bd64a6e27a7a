"""ONNX files: what the environment hands out in, action values and the greedy action out, in batches of any size."""

from __future__ import annotations

import importlib.metadata
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuralq.checks import MissingExtra
from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.exporting.network import ExportedNetwork, input_names, output_names, raw_inputs
from neuralq.runs.exporting.played import Played
from neuralq.runs.folder.files import replacing
from neuralq.types import Array

__all__ = ["described", "write_onnx"]

_TOLERANCE = 1e-5
_OPSET = 17


def described(agent: Agent, inputs: Sequence[Array]) -> list[dict[str, Any]]:
    """Name, dtype and shape of each input of the file."""
    return [
        {"name": name, "dtype": str(x.dtype), "shape": ["n", *x.shape[1:]]}
        for name, x in zip(input_names(agent), inputs, strict=True)
    ]


def write_onnx(agent: Agent, config: RunConfig, out: Path, played: Played) -> tuple[float, float]:
    """Write the file if its values are the agent's; how far they differ, and how far they may.

    Raises:
        MissingExtra: if the package that writes or the one that runs such files is not installed.
        ValueError: if the values differ by more; then there is no file.
    """
    inputs = raw_inputs(agent, played.observations, played.masks, played.memories)
    with replacing(out) as partial:
        _write(agent, inputs, partial, config)
        difference, bound = _difference(partial, inputs, played, agent)
        if not difference <= bound:
            raise ValueError(
                f"the exported network differs from the run's by {difference:.2g}, and {bound:.2g} is allowed; "
                "nothing was written"
            )
    return difference, bound


def _write(agent: Agent, inputs: Sequence[Array], path: Path, config: RunConfig) -> None:
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra(f'ONNX is not installed ({error}); install it with: pip install "neuralq[onnx]"') from error
    network = ExportedNetwork(agent).cpu().eval()
    given = input_names(agent)
    names = [*given, *output_names(agent)]
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
    facts |= {"inputs": described(agent, inputs)}
    facts |= {"neuralq": importlib.metadata.version("neuralq"), "masked": agent.spec.masked}
    for name, value in facts.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = name, value if isinstance(value, str) else json.dumps(value)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def _difference(path: Path, inputs: Sequence[Array], played: Played, agent: Agent) -> tuple[float, float]:
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
    found, actions, *after = session.run(None, dict(zip(names, inputs, strict=True)))
    alone, *_ = session.run(None, {name: x[:1] for name, x in zip(names, inputs, strict=True)})
    expected = played.values
    if after and not _goes_on(after[0], played.memories):
        return np.inf, _TOLERANCE
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


def _goes_on(after: Array, memories: Array) -> bool:
    """Whether the memories after each step are those before the next, where it is not an episode's first."""
    within = np.flatnonzero(memories[1:].any(-1))
    return bool(np.allclose(after[:-1][within], memories[1:][within], rtol=0, atol=_TOLERANCE))
