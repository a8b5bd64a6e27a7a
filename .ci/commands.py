"""Every command of neuralq once, small, under the Python that runs this: ``python commands.py`` is silent if all ran.

Commands run in this process, in a folder that is removed; those that open a window or a page show their help only.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import sys
import tempfile
from collections.abc import Iterator

SMALL = ["--total-steps", "256", "--evaluate-every", "128", "--evaluation-episodes", "2"]
LEARNERS = ("gradient", "online", "replay", "rollout", "streaming")


def words() -> Iterator[list[str]]:
    """The command lines, in an order in which each finds what it needs."""
    from neuralq.apps.cli import COMMANDS

    for command in COMMANDS:
        yield [command, "--help"]
    for learner in LEARNERS:
        yield ["train", "--learner", learner, "--help"]
        yield ["train", "CartPole-v1", "--learner", learner, *SMALL, "--run-dir", learner, "--json"]
    yield ["train", "FrozenLake-v1", "--layout", "table", *SMALL, "--run-dir", "table", "--json"]
    yield ["train", "td-gammon", "--games", "4", "--hidden", "4", "--run-dir", "gammon", "--json"]
    yield ["resume", "rollout", "--total-steps", "384", "--json"]
    yield ["evaluate", "replay", "--episodes", "2", "--json"]
    if importlib.util.find_spec("matplotlib"):
        yield ["report", "rollout", "--json"]
    yield ["compare", "rollout", "replay", "--json"]
    yield ["presets", "--json"]
    if importlib.util.find_spec("onnxruntime"):
        yield ["export", "rollout", "--onnx", "policy.onnx", "--json"]
    yield ["lab", "list", "--json"]
    yield ["lab", "diagnose", "baird", "--json"]
    yield ["baird", "--num-steps", "50", "--json"]
    yield ["solve", "neuralq/MitchellGrid-v0", "--gamma", "0.9", "--json"]
    yield ["chapter", "fig-13.2", "--json"]
    yield ["completion", "bash"]


def main() -> int:
    """0 if every command ends with 0; else says which did not, and what it printed."""
    from neuralq.apps.cli import main as neuralq

    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for argv in words():
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                try:
                    status: object = neuralq(argv)
                except SystemExit as end:
                    status = end.code or 0
                except Exception as error:  # which no command may let through
                    status = repr(error)
            if status != 0:
                failed += 1
                sys.stderr.write(f"neuralq {' '.join(argv)}: {status}\n{said.getvalue()}\n")
        os.chdir("/")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
