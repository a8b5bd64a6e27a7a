"""A run's network as the state dict of a plain `nn.Sequential`, and the lines of Python that load and ask it.

The file is safetensors, which runs no code and which any torch reads; the lines stand in its header as well. Before it
is kept the lines are run: every tensor is the run's bit for bit, and so are the values of a few hundred observations
in double precision, rounded to single. In single precision they agree but for the last digits, for a BLAS library adds
in an order of its own.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces.utils import flatten
from safetensors.torch import load_file, save_file
from torch import Tensor

from neuralq.q import MaskedQ
from neuralq.q.inputs import Pixels
from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.exporting.plain import Plain, plain_network
from neuralq.runs.exporting.played import Played
from neuralq.runs.folder.files import replacing
from neuralq.runs.stream.normalisation import CLIP
from neuralq.types import Array

__all__ = ["write_torch"]

_TOLERANCE = 1e-5
_LINES = '''import json
import numpy as np
import torch
from torch import nn
from safetensors import safe_open
from safetensors.torch import load_file

network = {build}
network.load_state_dict(load_file(FILE))
with safe_open(FILE, "pt") as file:
    facts = json.loads(file.metadata()["facts"])

def values(observations):
    """{what} -> action values [n, A], in units of the environment's return."""
    {body}
    with torch.no_grad():
        return {values}.double() / facts["reward_scale"]
'''


def write_torch(agent: Agent, config: RunConfig, out: Path, played: Played) -> tuple[str, float]:
    """Write the file if its values are the agent's; the lines that load it, and how far float32 is from the agent.

    Raises:
        ValueError: if the representation is no chain of layers, or the values differ; then there is no file.
    """
    with torch.random.fork_rng(devices=[]):  # layers draw weights when they are made
        plain = plain_network(agent.q)
    facts, lines = _facts(agent, config), _lines(agent, plain)
    tensors = {name: one.detach().cpu().contiguous() for name, one in plain.network.state_dict().items()}
    with replacing(out) as partial:
        told = {"facts": json.dumps(facts), "python": f"FILE = {out.name!r}\n{lines}"}
        save_file(tensors, str(partial), metadata=told)
        difference = _difference(agent, plain, lines, partial, played)
    return f"FILE = {str(out)!r}\n{lines}", difference


def _facts(agent: Agent, config: RunConfig) -> dict[str, Any]:
    """What the lines need, and what a reader should know."""
    facts: dict[str, Any] = {
        "env": config.env, "layout": config.layout, "gamma": config.gamma, "first_action": agent.first_action,
        "num_actions": agent.spec.num_actions, "reward_scale": agent.reward_scale, "masked": agent.spec.masked,
    }  # fmt: skip
    origin, divisor = _affine(agent)
    if divisor is not None:
        facts |= {"origin": origin, "divisor": divisor}
    scaling = None if agent.normalisation is None else agent.normalisation.scaling()
    if scaling is not None:
        facts |= {"mean": scaling[0].tolist(), "inverse": scaling[1].tolist()}
    inner: Any = agent.q.inner if isinstance(agent.q, MaskedQ) else agent.q
    for one in inner.modules():
        if isinstance(one, Pixels):
            facts |= {f"pixel_{name}": one.get_buffer(name).tolist() for name in ("origin", "divisor")}
    return facts


def _affine(agent: Agent) -> tuple[Any, Any]:
    """How numbers are scaled before the network sees them, for the whole observation; None where they are not."""
    parts, layout = agent.encoder.parts, agent.encoder.layout
    if layout in ("image", "index") or all(part.scaling is None for part in parts):
        return None, None
    if layout == "array" and parts[0].scaling is not None:
        return parts[0].scaling.origin.tolist(), parts[0].scaling.divisor.tolist()
    origins, divisors = list[Array](), list[Array]()
    for part in parts:
        there = (np.zeros(1), np.ones(1)) if part.scaling is None else (part.scaling.origin, part.scaling.divisor)
        shape = part.shape if part.scaling is not None else (part.width,)
        for kept, one in zip((origins, divisors), there, strict=True):
            kept.append(np.broadcast_to(one, shape).ravel())
    return np.concatenate(origins).tolist(), np.concatenate(divisors).tolist()


def _lines(agent: Agent, plain: Plain) -> str:
    layout, parts = agent.encoder.layout, agent.encoder.parts
    what = "Observations [n, ...] as the environment gives them"
    body = ["x = torch.as_tensor(np.asarray(observations))"]
    if layout == "index" and (len(parts) > 1 or parts[0].shape):
        raise ValueError("a state that is made of several numbers leaves no chain of layers; --to onnx takes it")
    if layout == "vector":
        what = "Observations [n, d], each flattened by gymnasium.spaces.utils.flatten"
    if layout == "index":
        start = int(parts[0].starts[0])
        body.append("x = x.long()" if start == 0 else f"x = x.long() - ({start})")
    numbers = "float64" if agent.encoder.dtype == np.float64 else "float32"
    if _affine(agent)[1] is not None:
        body.append('x = (x.double() - torch.tensor(facts["origin"], dtype=torch.float64)) / '
                    'torch.tensor(facts["divisor"], dtype=torch.float64)')  # fmt: skip
    if layout in ("array", "vector"):
        body.append(f"x = x.to(torch.{numbers})")
    if agent.normalisation is not None and agent.normalisation.scaling() is not None:
        body.append('mean, inverse = (torch.tensor(facts[one], dtype=torch.float64) for one in ("mean", "inverse"))')
        body.append(f"x = ((x.double().flatten(1) - mean) * inverse).clamp(-{CLIP}, {CLIP}).float().reshape(x.shape)")
    body += plain.before
    if agent.spec.masked:
        body.append("# illegal actions have values, too: whoever chooses leaves them out")
    # The last step turns x into what the layers have, so that they may be asked in double precision as well.
    body.append("x = x if x.dtype == torch.int64 else x.to(next(network.parameters()).dtype)")
    return _LINES.format(build=plain.build, what=what, body="\n    ".join(body), values=plain.values)


def _given(agent: Agent, played: Played) -> Array:
    """Observations as the lines take them."""
    if agent.encoder.layout != "vector":
        return np.stack([np.asarray(one) for one in played.observations])
    return np.stack([np.asarray(flatten(played.space, one)) for one in played.observations])


def _in_double(agent: Agent, played: Played) -> Tensor:
    """What the run's representation makes of the observations in double precision, rounded: ``[n, A]`` float32."""
    rows = [agent.inputs(*one) for one in zip(played.observations, played.masks, strict=True)]
    x, q = torch.from_numpy(np.concatenate(rows)), agent.q
    if isinstance(q, MaskedQ):
        x, q = q.observation(x), q.inner
    twin: Any = copy.deepcopy(q)
    twin.double()
    for one in twin.modules():
        if isinstance(one, Pixels):  # brightness is single precision either way
            one.float()
        elif hasattr(one, "input_shape"):
            one.dtype = torch.float64
    with torch.no_grad():
        values: Tensor = twin.all(x)
    return values.float()


def _difference(agent: Agent, plain: Plain, lines: str, path: Path, played: Played) -> float:
    """Run the lines beside the agent.

    Raises:
        ValueError: if a tensor or a value is not the agent's.
    """
    kept = load_file(str(path))
    for name, one in plain.network.state_dict().items():
        if not torch.equal(kept[name], one.detach().cpu()):
            raise ValueError(f"the tensor {name} came out different; nothing was written")
    names: dict[str, Any] = {"FILE": str(path)}
    with torch.random.fork_rng(devices=[]):
        exec(compile(lines, "<how the file is loaded>", "exec"), names)
    given, finite = _given(agent, played), np.isfinite(played.values)
    difference = float(np.max(np.abs(names["values"](given).numpy() - played.values)[finite]))
    bound = _TOLERANCE * max(1.0, float(np.max(np.abs(played.values[finite]))))
    single = _in_double(agent, played)
    names["network"].double()
    same = torch.equal((names["values"](given) * agent.reward_scale).float(), single)
    if not (same and difference <= bound):
        raise ValueError(
            f"the exported network differs from the run's by {difference:.2g}, and {bound:.2g} is allowed; nothing was "
            "written"
        )
    return difference
