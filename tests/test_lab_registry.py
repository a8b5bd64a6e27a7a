"""A new method of the lab is one new file: it is found by the list, the page's catalogue, the matrix and the options.

Mutants that die here: a list of methods written out; a module's records read by name; an option that only one of the
command line and the page knows.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import neuralq
from neuralq.lab import METHODS

ORDER = (
    *("td", "residual", "residual-adaptive", "naive-residual", "gtd", "gtd2", "gtd2-mp", "tdc", "tdrc", "htd", "gq"),
    *("greedy-gq", "etd", "n-step", "v-trace", "hard-target", "polyak-target", "projected-target", "lstd", "brm"),
    *("fitted", "fitted-q", "lspi", "expected-sarsa", "tree-backup", "retrace", "naive-q", "q-learning", "sarsa"),
)

MINE = '''"""TD(0) with a step that is a share of the usual one."""

from neuralq.lab.methods.record import Method, Option, flow
from neuralq.lab.methods.operators import td
from neuralq.lab.methods.td import TD

__all__ = ["CAUTIOUS"]


def expected(process, options):
    A, b = td(process)
    return flow(options["share"] * A, options["share"] * b)


def learner(process, w0, options):
    one = TD.learner(process, w0, TD.defaults)
    whole = one.update
    one.update = lambda sample, step_size: whole(sample, options["share"] * step_size)
    return one


OWN = {"share": Option(0.5, 0.0, 1.0, "ς, share of the step")}
CAUTIOUS = Method("cautious-td", "cautious TD", "nobody yet", OWN, expected, learner)
'''

ASKED = """
import json, neuralq.lab.methods
from neuralq.apps.cli import main
from neuralq.apps.web.catalogue import catalogue
from neuralq.apps.web.requests import read_request
from neuralq.lab import diagnose, matrix, problem

main(["lab", "list", "--json"])
main(["lab", "diagnose", "w2w", "--method", "cautious-td", "--share", "0.25", "--json"])
print(json.dumps(catalogue()["methods"]))
print(json.dumps(matrix(["w2w"]).plain()))
place = {"problem": "w2w", "gamma": 0.9, "step_size": 0.1, "method": "cautious-td", "sampling": "expected"}
print(json.dumps(read_request("diagnose", {**place, "options": {"share": 0.1}})))
try:
    read_request("diagnose", {**place, "options": {"share": 2}})
except ValueError as error:
    print(json.dumps(str(error)))
"""


def test_the_order_is_that_of_the_families() -> None:
    assert tuple(one.name for one in METHODS) == ORDER


def test_a_method_in_a_file_of_its_own_is_everywhere(tmp_path: Path) -> None:
    """The package with one more file, as a tree of links."""
    package, inside = Path(neuralq.__file__).parent, Path("neuralq", "lab", "methods")
    for folder in (*reversed(inside.parents[:-1]), inside):
        (tmp_path / folder).mkdir()
        for entry in (package.parent / folder).iterdir():
            if entry.relative_to(package.parent) not in (inside, *inside.parents) and entry.name != "__pycache__":
                (tmp_path / folder / entry.name).symlink_to(entry)
    (tmp_path / inside / "cautious.py").write_text(MINE, encoding="utf-8")
    places = os.pathsep.join([str(tmp_path), *(place for place in sys.path if Path(place) != package.parent)])
    command = [sys.executable, "-P", "-c", ASKED]
    asked = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "PYTHONPATH": places}
    )  # fmt: skip
    assert asked.returncode == 0, asked.stderr
    listed, diagnosed, offered, cells, read, refused = map(json.loads, asked.stdout.splitlines())
    assert [one["name"] for one in listed["methods"]] == [*ORDER, "cautious-td"]
    assert listed["methods"][-1]["options"] == {"share": 0.5}
    assert diagnosed["options"] == {"share": 0.25} and diagnosed["method"] == "cautious TD"
    assert offered[-1]["name"] == "cautious-td" and offered[-1]["sampled"]
    assert offered[-1]["options"][0]["label"] == "ς, share of the step"
    assert cells["methods"] == [*ORDER, "cautious-td"]
    own = cells["cells"][-1]
    assert (own["predicted"], own["measured"], own["agree"]) == ("diverges", "grows", True)  # γ = .99 > 1/1.12
    assert read["options"] == {"share": 0.1}
    assert refused == "share must be a number from 0 to 1, got 2"
