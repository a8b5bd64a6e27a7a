"""Exporting a run: what `neuralq.export` is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuralq.checks import check_choice
from neuralq.runs.api import environment_of, folder_of, load
from neuralq.runs.exporting.network import output_names, raw_inputs
from neuralq.runs.exporting.onnx_file import described, write_onnx
from neuralq.runs.exporting.played import played
from neuralq.runs.exporting.torch_file import write_torch
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.recipe.config import config_from_dict

__all__ = ["FORMATS", "Exported", "export"]

FORMATS = {"torch": ".safetensors", "onnx": ".onnx"}
"""The files that there are, and how their names end."""


@dataclass(frozen=True)
class Exported:
    """A file that was written and checked.

    Args:
        path: the file.
        to: its format.
        run_dir: folder of the run.
        max_abs_difference: of values from the agent's, over ``num_observations``, in the environment's units.
        num_observations: of random play, on which it was checked.
        python: lines that load it, without neuralq; of a torch file.
        inputs: name, dtype and shape of each input; of an ONNX file.
        outputs: their names; of an ONNX file.
        allowed: largest difference that would have been allowed; of an ONNX file.
    """

    path: Path
    to: str
    run_dir: Path
    max_abs_difference: float
    num_observations: int
    python: str | None = None
    inputs: list[dict[str, Any]] | None = None
    allowed: float | None = None
    outputs: list[str] | None = None

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return {**dataclasses.asdict(self), "path": str(self.path), "run_dir": str(self.run_dir)}


def export(run: Any, path: str | Path, to: str | None = None, best: bool | None = None, *, env: Any = None) -> Exported:
    """Write a run's network for other programs; the file is asked beside the original before it is kept.

    Args:
        run: a run, its folder, or an agent that was loaded.
        path: the file to write.
        to: "torch", the state dict of a plain `nn.Sequential` as safetensors, with the lines that load it; or "onnx".
            By default what the file's name ends in says.
        best: which parameters, as for `neuralq.load`.
        env: as for `neuralq.load`.

    Raises:
        ValueError: if there is no such format, the representation does not go into it, or the file's values are not
            the run's; then there is no file.
        MissingExtra: if packages are missing.

    Example:
        >>> import tempfile, torch, neuralq
        >>> folder = tempfile.mkdtemp()
        >>> run = neuralq.train("CartPole-v1", folder + "/run", total_steps=64, evaluation_episodes=1, hidden=(8,),
        ...                     num_envs=2, num_steps=16, num_minibatches=1)
        >>> file = export(run, folder + "/q.safetensors")
        >>> exec(file.python)
        >>> network[0], values([[0.0, 0.0, 0.0, 0.0]]).shape
        (Linear(in_features=4, out_features=8, bias=True), torch.Size([1, 2]))
    """
    out, folder = Path(path), folder_of(run)
    if to is None:
        to = next((name for name, ending in FORMATS.items() if out.suffix == ending), "torch")
    check_choice("to", to, FORMATS)
    if not out.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {out.parent}; make it first")
    config = config_from_dict(read_config(folder))
    with environment_of(folder, env):
        agent = run if hasattr(run, "encoder") else load(folder, best)
        seen = played(config, agent)
    if to == "torch":
        python, difference = write_torch(agent, config, out, seen)
        return Exported(out, to, folder, difference, len(seen.values), python=python)
    difference, allowed = write_onnx(agent, config, out, seen)
    inputs = described(agent, raw_inputs(agent, seen.observations, seen.masks, seen.memories))
    return Exported(
        out, to, folder, difference, len(seen.values), inputs=inputs, allowed=allowed, outputs=output_names(agent)
    )
