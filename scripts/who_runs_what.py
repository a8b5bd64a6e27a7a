"""Runs tests and writes down which lines of the library each of them runs, and for how long.

    python scripts/who_runs_what.py FOLDER -q -m "not slow" tests/test_rules_returns.py

What comes after the folder goes to pytest. Each of its processes writes one JSON file into the folder:
test -> {"seconds": ..., "lines": {file: [line, ...]}}. What runs while modules are imported, in compiled kernels or in
processes that a test starts is not seen. `scripts/mutants.py` lets a mutant meet the tests that run its line.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

if find_spec("coverage") is not None:  # `--help` answers without the extra
    from coverage import Coverage

ROOT = Path(__file__).resolve().parents[1]
Seen = dict[str, dict[str, Any]]  # by test: seconds, and lines by file

_seconds: dict[str, float] = {}
_lines: list[Coverage] = []


def pytest_configure() -> None:
    """Begins before anything imports the library."""
    _lines.append(Coverage(data_file=None, config_file=False, include=["neuralq/*"], messages=False))
    _lines[0].start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """The lines from here on are this test's."""
    begun = time.perf_counter()
    _lines[0].switch_context(item.nodeid)
    result = yield
    _lines[0].switch_context("")
    _seconds[item.nodeid] = time.perf_counter() - begun
    return result


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """Writes what was seen."""
    _lines[0].stop()
    if not _seconds:
        return  # the process that hands tests to others runs none, and coverage warns of that
    data = _lines[0].get_data()
    lines: dict[str, dict[str, list[int]]] = defaultdict(dict)
    for file in data.measured_files():
        for line, tests in data.contexts_by_lineno(file).items():
            for test in tests:
                lines[test].setdefault(os.path.relpath(file), []).append(line)
    written = {test: {"seconds": seconds, "lines": lines[test]} for test, seconds in _seconds.items()}
    Path(os.environ["WHO_RUNS_WHAT"], f"{os.getpid()}.json").write_text(json.dumps(written), encoding="utf-8")


@cache
def importers(file: str) -> tuple[str, ...]:
    """The library's files that import a file."""
    module = file.removesuffix(".py").replace("/", ".")
    package, _, name = map(re.escape, module.rpartition("."))
    both = rf"from {package} import (?:[^(\n]*|\([^)]*)\b{name}\b"
    wanted = re.compile(rf"^\s*(?:from {re.escape(module)} import|import {re.escape(module)}\b|{both})", re.MULTILINE)
    files = (str(p.relative_to(ROOT)) for p in sorted((ROOT / "neuralq").rglob("*.py")))
    return tuple(file for file in files if wanted.search((ROOT / file).read_text(encoding="utf-8")))


def statement_at(file: str, line: int) -> range | None:
    """The lines of the innermost statement around a line, without its body; None in what is compiled."""
    lines = range(line, line + 1)
    for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
        if not isinstance(node, ast.stmt) or not node.lineno <= line <= (node.end_lineno or node.lineno):
            continue
        if isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list):
            return None
        body = getattr(node, "body", None)
        end = (body[0].lineno - 1 if isinstance(body, list) else node.end_lineno) or line
        if line <= end:  # of nested statements the inner one comes last
            lines = range(node.lineno, end + 1)
    return lines


def tests_of(file: str, line: int, seen: Seen, most_seconds: float) -> list[str]:
    """The tests that run a line, file by file, quick files first, as many as the seconds allow.

    A line that only imports or kernels run has the tests of its file and of those that import it.
    """
    lines = set(statement_at(file, line) or ())
    chosen = {test for test, ran in seen.items() if not lines.isdisjoint(ran["lines"].get(file, ()))}
    if not chosen:
        near = {file, *importers(file)}
        chosen = {test for test, ran in seen.items() if not near.isdisjoint(ran["lines"])}
    by_file: dict[str, list[str]] = defaultdict(list)
    for test in chosen:
        by_file[test.split("::")[0]].append(test)
    times = {name: sum(seen[test]["seconds"] for test in tests) for name, tests in by_file.items()}
    result: list[str] = []
    spent = 0.0
    for name in sorted(by_file, key=lambda name: times[name]):
        if spent and spent + times[name] > most_seconds:
            break
        spent += times[name]
        result += by_file[name]
    return result


def main() -> int:
    """Runs pytest with this file as a plugin."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write what was seen")
    arguments, of_pytest = parser.parse_known_args()
    if not arguments.folder.is_dir():
        parser.error(f"no such folder: {arguments.folder}")
    if find_spec("coverage") is None:
        parser.error("needs coverage: pip install 'neuralq[mutants]', or `make mutants`")
    os.environ["WHO_RUNS_WHAT"] = str(arguments.folder.resolve())
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(ROOT / "scripts"))))
    return int(pytest.main(["-p", "who_runs_what", *of_pytest]))


if __name__ == "__main__":
    sys.exit(main())
