"""``neuralq export``: a run's network as a file of torch or ONNX, checked against the values that the run computes."""

from __future__ import annotations

from pathlib import Path

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.sweeps import add_trust, add_which, single_run
from neuralq.runs import export as export_run
from neuralq.runs.exporting.export import FORMATS, Exported

__all__ = ["export"]


def export(argv: list[str]) -> int:
    """Write the file; exit status 1, and no file, if its values are not the run's."""
    parser = command_parser(
        "export",
        "Write a run's network for other programs. torch: the state dict of a plain nn.Sequential, as safetensors, and "
        "the lines of Python that load it. onnx: what the environment hands out in, an input for each part of it; "
        "action values in units of the environment's return and the greedy action out, in batches of any size. The "
        "file is asked beside the original before it is kept.",
        "neuralq export RUN --to torch",
        "neuralq export RUN --onnx policy.onnx",
    )
    parser.add_argument("run", help="run folder")
    parser.add_argument("--to", choices=FORMATS, help="which file (default: what the name of --out says, else torch)")
    parser.add_argument("--out", metavar="FILE", help="the file to write (default: network.safetensors or .onnx)")
    parser.add_argument("--onnx", metavar="FILE", help="the same as --to onnx --out FILE")
    add_which(parser)
    add_trust(parser)
    options = parser.parse_args(argv)
    to, out = options.to, options.out
    if options.onnx is not None:
        if out is not None or to == "torch":
            raise Failure("--onnx names the file and its format; leave --out and --to out", 2)
        to, out = "onnx", options.onnx
    path = single_run(options.run, options.trust)
    exported = export_run(path, out or f"network{FORMATS[to or 'torch']}", to, options.best)
    size = Path(exported.path).stat().st_size
    plain = {**exported.plain(), exported.to: str(exported.path), "bytes": size}
    print_result(plain, options.json, _lines(exported, size))
    return 0


def _lines(exported: Exported, size: int) -> list[str]:
    difference = f"largest difference over {exported.num_observations} observations: {exported.max_abs_difference:.2g}"
    if exported.python is not None:
        same = "in double precision and rounded none, bit for bit"
        return [f"{exported.path}: {size:,} bytes; {difference}, {same}. It is loaded by:", "", exported.python]
    shown = ", ".join(
        f"{one['name']} {one['dtype']} [{', '.join(map(str, one['shape']))}]" for one in exported.inputs or ()
    )
    names = ", ".join(exported.outputs or ())
    return [
        f"{exported.path}: {size:,} bytes; in: {shown}, as the environment gives it; out: {names}",
        difference,
    ]
