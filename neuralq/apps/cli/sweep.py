"""``neuralq sweep``: combinations of options times seeds, here, on a cluster, or share by share."""

from __future__ import annotations

import argparse
import re
from collections import Counter
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.numbers import any_number
from neuralq.apps.cli.yaml_text import read_text
from neuralq.runs.folder.run_folder import RunFolderError
from neuralq.runs.sweep.asked import Asked, read_asked
from neuralq.runs.sweep.folder import Member, Sweep, ask, is_sweep_folder, open_sweep
from neuralq.runs.sweep.scripts import kubernetes_job, num_shares, slurm_script
from neuralq.runs.sweep.states import RunState

__all__ = ["add_cluster", "sweep"]

_MOST_REASONS = 20


def sweep(argv: list[str]) -> int:
    """Make the runs that a file asks for, or go on with them; or tell how far they are."""
    options = _parser().parse_args(argv)
    *file, folder = options.what
    if len(file) > 1:
        raise Failure(f"a file and a folder, two words at most, got {' '.join(options.what)}", 2)
    if options.of is not None and options.index is None and not (options.slurm_script or options.kubernetes_job):
        raise Failure("--of says how many shares there are; add --index, which one to make", 2)
    if options.image is not None and not options.kubernetes_job:
        raise Failure("--image is for --kubernetes-job; add that, or leave it out", 2)
    found = _asked_for(file[0], folder, options) if file else _there(folder)
    if options.status:
        return _status(found, options.json)
    if options.slurm_script or options.kubernetes_job:
        print(_script(found, options), end="")
        return 0
    from neuralq.apps.cli.sweeps import make_runs  # brings PyTorch, which telling how far it is does not need

    return make_runs(found, options)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "sweep",
        "Make a run for every combination of options and seed that a file asks for, in a folder of its own. What is "
        "in the file: keywords of neuralq.train, each a value, a list or a range; and seeds. The same command goes on "
        "with what was stopped or killed, and repeats nothing (docs/scale.md).",
        "neuralq sweep rates.yaml runs/rates",
        "neuralq sweep runs/rates --status",
        "neuralq sweep runs/rates --index 3 --of 20",
        "neuralq compare runs/rates --by learning_rate --out rates.svg",
    )
    parser.usage = "neuralq sweep FILE.yaml DIR [options], or neuralq sweep DIR [options] to go on"
    parser.add_argument("what", nargs="+", metavar="FILE.yaml DIR", help="what is asked for, and where the runs go")
    parser.add_argument("--workers", type=int, metavar="N", help="runs at a time (default: as many as there are cores)")
    add_cluster(parser)
    parser.add_argument("--status", action="store_true", help="tell how far each run is, and make none")
    parser.add_argument("--retry-failed", action="store_true", help="begin runs again that have failed")
    parser.add_argument("--index", type=int, metavar="I", help="make one share of the runs, counted from 0")
    parser.add_argument("--of", type=int, metavar="N", help="how many shares there are (default: one for each run)")
    script = parser.add_mutually_exclusive_group()
    script.add_argument(
        "--slurm-script", action="store_true",
        help="print a script for sbatch, a task for each share, which queues again when its time was up; make no run",
    )  # fmt: skip
    script.add_argument(
        "--kubernetes-job", action="store_true",
        help="print an Indexed Job for kubectl create, a pod for each share; make no run",
    )  # fmt: skip
    parser.add_argument("--image", metavar="NAME", help="container image for --kubernetes-job")
    parser.add_argument(
        "--claim", default="neuralq-sweeps", metavar="NAME",
        help="PersistentVolumeClaim of --kubernetes-job, with DIR at its root (default: neuralq-sweeps)",
    )  # fmt: skip
    parser.add_argument(
        "--hook", action="append", default=[], metavar="module:name", help="watches each run, as for neuralq train"
    )
    parser.add_argument("--tensorboard", action="store_true", help="write TensorBoard event files (extra tensorboard)")
    parser.add_argument("--wandb", action="store_true", help="log to Weights & Biases (extra wandb)")
    return parser


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Adds what says where on a cluster runs are made."""
    parser.add_argument(
        "--ray", metavar="ADDRESS",
        help="make the runs on a Ray cluster that this machine belongs to: HOST:PORT of its head, or auto (extra ray)",
    )  # fmt: skip
    parser.add_argument(
        "--storage", choices=("shared", "none"), default="shared",
        help="whether all nodes of the cluster see DIR by its name, or the runs are sent home (default: shared)",
    )  # fmt: skip
    parser.add_argument("--cpus", type=float, default=1.0, metavar="X", help="CPUs that Ray gives a run (default: 1)")
    parser.add_argument("--gpus", type=float, default=0.0, metavar="X", help="GPUs that Ray gives a run (default: 0)")


def _asked_for(file: str, folder: str, options: argparse.Namespace) -> Sweep:
    words = [f"--{name}" for name in ("tensorboard", "wandb") if getattr(options, name)]
    for hook in options.hook:
        from neuralq.runs.hooks import own_hook

        own_hook(hook)  # a name that is wrong is one error, not one for each run
        words += ["--hook", hook]
    asked = _read(file)
    try:
        return ask(folder, asked, words)
    except ValueError as error:
        raise Failure(f"{file}: {error}", 2) from error


def _read(file: str) -> Asked:
    try:
        content = read_text(Path(file).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise Failure(f"cannot read {file}: {' '.join(str(error).split())}", 2) from error
    if not isinstance(content, dict):
        raise Failure(f"{file} must hold a mapping of options, got {type(content).__name__}", 2)
    try:
        return read_asked(_numbers(content))
    except ValueError as error:
        raise Failure(f"{file}: {error}", 2) from error


def _numbers(value: Any) -> Any:
    """With 100k and 2.5M, which YAML has no word for, as numbers."""
    if isinstance(value, dict):
        return {name: _widths(inner) if name == "hidden" else _numbers(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    is_written = isinstance(value, str) and re.fullmatch(r"[\d._]*\d[\d._]*[kKMG]", value, re.ASCII)
    return any_number(value) if is_written else value


def _widths(value: Any) -> Any:
    """Of hidden layers, which may be written as on the command line, 64,64; a list of such is several networks."""
    if isinstance(value, list) and any(isinstance(one, str) for one in value):
        return [_widths(one) for one in value]
    is_written = isinstance(value, str) and re.fullmatch(r"[\d,\s]*\d[\d,\s]*", value, re.ASCII)
    return [int(width) for width in re.findall(r"\d+", value)] if is_written else value


def _script(found: Sweep, options: argparse.Namespace) -> str:
    """What a scheduler is to be given; its shares are as many as are asked for, or as there are runs."""
    config = found.configuration(next(found.members()))
    threads = max(int(config.get("threads", 1)), *(found.axes or {}).get("threads", [1]))
    gpus = int(str(config.get("device", "cpu")).startswith("cuda"))
    try:
        shares = num_shares(len(found), options.of)
        if options.slurm_script:
            return slurm_script(found.path, shares, threads, gpus)
        return kubernetes_job(found.path, shares, options.image or "", options.claim, threads, gpus)
    except ValueError as error:
        raise Failure(str(error), 2) from error


def _there(folder: str) -> Sweep:
    if Path(folder).is_file():
        raise Failure(f"{folder} says what to run; say where to, too: neuralq sweep {folder} DIR", 2)
    if not is_sweep_folder(folder):
        raise RunFolderError(f"there is no sweep in {folder}; start one with: neuralq sweep FILE.yaml {folder}")
    return open_sweep(folder)


def _status(found: Sweep, as_json: bool) -> int:
    """How far each run is; the exit status is 0 whatever that is."""
    states = [(member, found.state(member)) for member in found.members()]
    counted = Counter(state.state for _, state in states)
    told = [f"{counted[name]:,} {name}" for name in ("finished", "running", "stopped", "failed", "not begun")]
    failed = [(member, state) for member, state in states if state.state == "failed"]
    lines = [f"{len(states):,} runs: {', '.join(told)}"]
    lines += [f"{member.name}: {state.reason}" for member, state in failed[:_MOST_REASONS]]
    if len(failed) > _MOST_REASONS:
        lines.append(f"and {len(failed) - _MOST_REASONS:,} more (--json has them all)")
    runs = [_plain(found, member, state) for member, state in states]
    print_result({"sweep_dir": str(found.path), "counts": dict(counted), "runs": runs}, as_json, lines)
    return 0


def _plain(found: Sweep, member: Member, state: RunState) -> dict[str, Any]:
    return {
        "seed": member.seed,
        "options": dict(member.options),
        "state": state.state,
        "reason": state.reason or None,
        "run_dir": str(found.path / member.name),
        "parameters_sha256": state.summary.get("parameters_sha256"),
    }
