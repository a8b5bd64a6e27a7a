"""Breaks the library by one sign, comparison, constant or condition at a time, and counts the tests that notice.

    python scripts/mutants.py                        # the five rooms that numbers come from, 30 minutes on two cores
    python scripts/mutants.py --room exact --seed 3 --minutes 10
    python scripts/mutants.py --file neuralq/rules/returns.py --minutes 5

Mutants are made by cosmic-ray, in copies of the checkout; yours is not touched. First the fast tests have to pass on a
copy that nobody has broken, and each is asked which lines it runs; ``--seen FILE`` keeps that, so that the next time
only tests run again that changed, or whose lines did. Then mutants are drawn at random from a seed that is printed, in
turn from each room, until the time is up; the tests on sound code count towards it. Each mutant meets the tests that
run its line, quick files first, up to the first failure; a line that is only run by imports or compiled kernels meets
the tests of its file and of those that import it. A test that also fails alone on sound code kills nothing. A survivor
that computes the same is struck, with the reason, in ``scripts/equivalent_mutants.toml``. Exit status 1 when a room
kills under 95 % of the others.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.progress import Progress

if find_spec("cosmic_ray") is not None:  # `--help` answers without the extra
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import MutationVisitor
    from cosmic_ray.plugins import get_operator
if TYPE_CHECKING:
    from who_runs_what import Seen

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {
    "rules": "neuralq/rules",
    "exact": "neuralq/exact",
    "learners": "neuralq/learners",
    "verdicts": "neuralq/lab/verdicts",
    "stream": "neuralq/runs/stream",
}
EQUIVALENT = ROOT / "scripts" / "equivalent_mutants.toml"
MARK = 0.95  # of the mutants that compute something else
MOST_SECONDS = 120.0  # that the tests of one mutant may take
SHOWN = ("frozen", "slots", "repr", "eq", "compare", "place")  # how a record is shown and kept, not what it computes
LIMIT = 240.0  # seconds until they are stopped; a test alone: 20 and five times what it takes, more where it compiles
OPERATORS = [
    f"core/{operator}"
    for operator in (
        *(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul")),
        *(f"ReplaceBinaryOperator_{pair}" for pair in ("FloorDiv_Mul", "BitAnd_BitOr", "BitOr_BitAnd", "Mod_Add")),
        *(f"ReplaceComparisonOperator_{pair}" for pair in ("Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_Gt", "Gt_Lt")),
        *(f"ReplaceComparisonOperator_{pair}" for pair in ("Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is")),
        *("NumberReplacer", "AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr"),
        *("ReplaceOrWithAnd", "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not"),
        *("ReplaceBreakWithContinue", "ReplaceContinueWithBreak"),
    )
]


@dataclass(frozen=True)
class Mutant:
    """One change of one line."""

    room: str
    file: str
    operator: str
    occurrence: int
    line: int
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}\n    - {self.before}\n    + {self.after}"


def places_in(room: str, path: Path) -> Iterator[tuple[str, Path, str, int]]:
    """Room, file, operator and occurrence of every change that cosmic-ray can make in a file."""
    nodes = list(ast_nodes(get_ast(path.read_text(encoding="utf-8"))))
    for name in OPERATORS:
        operator = get_operator(name)()
        found = sum(1 for node in nodes for _ in operator.mutation_positions(node))
        yield from ((room, path, name, occurrence) for occurrence in range(found))


def mutant_at(room: str, path: Path, operator: str, occurrence: int) -> Mutant | None:
    """The mutant of a place, unless it runs as before or is no program."""
    source = path.read_text(encoding="utf-8")
    mutated = MutationVisitor.mutate_code(source, get_operator(operator)(), occurrence)
    try:
        if mutated is None or what_runs(mutated) == what_runs(source):
            return None
    except SyntaxError:  # a `*` that stood before arguments
        return None
    pairs = enumerate(zip(source.splitlines(), mutated.splitlines(), strict=False), 1)
    line, (before, after) = next((n, pair) for n, pair in pairs if pair[0] != pair[1])
    return Mutant(room, str(path.relative_to(ROOT)), operator, occurrence, line, before.strip(), after.strip())


class Stripped(ast.NodeTransformer):
    """Leaves out annotations, names of types and what errors say."""

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = None
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        node.returns = None
        self.generic_visit(node)
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:
        node.keywords = [word for word in node.keywords if word.arg not in SHOWN]
        self.generic_visit(node)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        self.generic_visit(node)
        return node

    def visit_Raise(self, node: ast.Raise) -> ast.Raise:
        if isinstance(node.exc, ast.Call):
            node.exc.args = []
        return node

    def visit_If(self, node: ast.If) -> ast.AST:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return ast.Pass()
        self.generic_visit(node)
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        types = isinstance(node.value, ast.BinOp) and isinstance(node.value.op, ast.BitOr)
        one = len(node.targets) == 1 and isinstance(node.targets[0], ast.Name) and node.targets[0].id[0].isupper()
        if types and one:  # the union of types has a name: Body = MLP | Conv
            return ast.Pass()
        self.generic_visit(node)
        return node


def what_runs(source: str) -> str:
    """A program's syntax without what does not run: two that are alike here are one program."""
    return ast.dump(Stripped().visit(ast.parse(source)))


def copied(parent: str) -> Path:
    """A copy of the checkout with its compiled kernels."""
    copy = Path(tempfile.mkdtemp(dir=parent))
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, check=True, text=True,
    )  # fmt: skip
    kernels = (str(p.relative_to(ROOT)) for room in ("neuralq", "envs") for p in (ROOT / room).rglob("*.nb[ic]"))
    for name in (*filter(None, listed.stdout.split("\0")), *kernels):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    return copy


def enter_copy(parent: str) -> None:
    """Gives this process a copy of its own to break, and what every test needs but the library."""
    copy = copied(parent)
    os.chdir(copy)
    os.environ["PYTHONPATH"] = os.pathsep.join((str(copy), str(copy / "envs")))
    os.environ.update(OMP_NUM_THREADS="1", PYTHONDONTWRITEBYTECODE="1")
    sys.dont_write_bytecode = True  # a file that is broken and mended within a second would be taken for the old one
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != ROOT / "scripts"]
    for name in ("torch", "scipy.optimize", "scipy.sparse.linalg", "numba", "gymnasium"):
        import_module(name)
    if "neuralq" in sys.modules:
        raise RuntimeError("the library was loaded before it was broken")


def sources() -> list[Path]:
    """The library's files, and the tests'."""
    return sorted((*(ROOT / "neuralq").rglob("*.py"), *(ROOT / "tests").glob("test_*.py")))


def is_tested(file: str) -> bool:
    """Whether a file has tests that may run a line of a room."""
    if not file.startswith("tests/"):
        return file.startswith(tuple(ROOMS.values()))
    names = "|".join(sorted({room.split("/")[1] for room in ROOMS.values()}))
    return bool(re.search(rf"neuralq\.(?:{names})|from neuralq import", (ROOT / file).read_text(encoding="utf-8")))


def to_run_again(seen: Seen, files: dict[str, str]) -> list[str]:
    """The files with tests of which nothing is known, or that changed, as may have the lines that they run."""
    by_file: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for test, ran in seen.items():
        by_file[test.split("::")[0]].append(ran)

    def stands(file: str) -> bool:
        known = by_file.get(file, ())
        return bool(known) and all(files.get(name) == text for ran in known for name, text in ran["files"].items())

    return [file for file in files if is_tested(file) and not stands(file)]


def control(parent: str, kept: Path | None, workers: int) -> tuple[Seen, str]:
    """Which lines each test runs on a copy that nobody has broken, and what the tests say if they do not pass."""
    copy, folder = copied(parent), tempfile.mkdtemp(dir=parent)
    files = {str(p.relative_to(ROOT)): sha256(p.read_bytes()).hexdigest()[:12] for p in sources()}
    seen: Seen = json.loads(kept.read_text(encoding="utf-8")) if kept and kept.is_file() else {}
    again = to_run_again(seen, files)
    stand = files.keys() - set(again)
    seen = {test: ran for test, ran in seen.items() if test.split("::")[0] in stand}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(copy), str(copy / "envs"))), "OMP_NUM_THREADS": "1"}
    options = ["-q", "-p", "no:cacheprovider", "-m", "not slow"]
    side_by_side = ["-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"] if workers > 1 else []
    command = [sys.executable, "scripts/who_runs_what.py", folder, *options, *side_by_side, *again]
    if again:
        result = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
        if result.returncode not in (0, 5):  # 5: there were none
            return seen, result.stdout[-3000:] + result.stderr[-1000:]
    for part in Path(folder).iterdir():
        for test, ran in json.loads(part.read_text(encoding="utf-8")).items():
            seen[test] = {**ran, "files": {name: files[name] for name in (test.split("::")[0], *ran["lines"])}}
    if kept:
        kept.write_text(json.dumps(seen), encoding="utf-8")
    return seen, ""


class Chosen:
    """A plugin of pytest: leaves out all tests but these, keeps what failed, and ends the process with one that hangs.

    Args:
        tests: each with the seconds that it may take.
    """

    def __init__(self, tests: dict[str, float]) -> None:
        self._tests, self.failed = tests, ""

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        signal.setitimer(signal.ITIMER_REAL, self._tests[nodeid])

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._tests]

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.failed = report.nodeid

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed = report.nodeid


def tried(tests: dict[str, float]) -> tuple[str, str]:
    """How a child of this process fares with the tests, and the first that failed.

    Args:
        tests: each with the seconds that it may take.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        nothing = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(nothing, descriptor)
        chosen = Chosen(tests)
        status = 3
        try:
            files = list(dict.fromkeys(test.split("::")[0] for test in tests))
            status = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *files], [chosen]))
        finally:
            os.write(writer, chosen.failed.encode())
            os._exit(status)
    os.close(writer)
    ended = end_of(child)
    os.set_blocking(reader, False)
    with open(reader, "rb", buffering=0) as said:
        failed = (said.read() or b"").decode()
    if ended in (None, -signal.SIGALRM):
        return "timed out", ""
    if ended == 0:
        return "survived", ""
    return ("killed" if failed or ended < 0 else "broken"), failed or f"pytest ended with {ended}"


def end_of(child: int) -> int | None:
    """The exit status of a child that leads its session, negative if a signal ended it; None where time was up."""
    deadline, ended = time.monotonic() + LIMIT, None
    while ended is None and time.monotonic() < deadline:
        found, status = os.waitpid(child, os.WNOHANG)
        ended = os.waitstatus_to_exitcode(status) if found else None
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):  # with what its tests started and left
        os.killpg(child, signal.SIGKILL)
    if ended is None:
        os.waitpid(child, 0)
    return ended


_SOUND: dict[str, str] = {}  # what became of a test alone, on sound code


def outcome_of(mutant: Mutant, tests: dict[str, float]) -> tuple[str, str]:
    """Whether these tests, given with the seconds that they take, noticed, and which; run in a copy."""
    path = Path(mutant.file)
    source = path.read_text(encoding="utf-8")
    mutated = MutationVisitor.mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
    with tempfile.TemporaryDirectory() as kernels:
        # A kernel that calls a changed one in another file would come from the cache as it was before.
        os.environ.pop("NUMBA_CACHE_DIR", None)
        compiles = "from neuralq.jit" in source
        if compiles:
            os.environ["NUMBA_CACHE_DIR"] = kernels
        path.write_text(mutated, encoding="utf-8")
        try:
            outcome, failed = tried({test: (80 if compiles else 20) + 5 * taken for test, taken in tests.items()})
        finally:
            path.write_text(source, encoding="utf-8")
            os.environ.pop("NUMBA_CACHE_DIR", None)
    if outcome == "killed" and "::" in failed:
        if failed not in _SOUND:
            _SOUND[failed] = tried({failed: LIMIT})[0]
        if _SOUND[failed] != "survived":
            return "broken", f"{failed} fails alone on sound code"
    return outcome, failed


def struck() -> dict[tuple[str, str, str], str]:
    """The reason by file, line before and line after, of the mutants that compute the same."""
    known = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).get("mutant", [])
    return {(m["file"], m["before"], m["after"]): m["because"] for m in known}


def drawn(rooms: dict[str, list[Path]], seed: int) -> Iterator[Mutant]:
    """Mutants without those that are struck, in turn from each room, each room's in an order of its own."""
    rng, known = np.random.default_rng(seed), struck()
    orders = {}
    for room, paths in rooms.items():
        places = [place for path in paths for place in places_in(room, path)]
        orders[room] = iter([places[i] for i in rng.permutation(len(places))])
    while orders:
        for room, order in list(orders.items()):
            mutants = (mutant_at(*place) for place in order)
            mutant = next((m for m in mutants if m and (m.file, m.before, m.after) not in known), None)
            if mutant is None:
                del orders[room]
            else:
                yield mutant


def run(
    parent: str, seen: Seen, mutants: Iterator[Mutant], deadline: float, workers: int
) -> list[tuple[Mutant, str, str]]:
    """What became of each mutant that began before the deadline."""
    from who_runs_what import tests_of  # a script beside this one

    begun = time.monotonic()
    results: list[tuple[Mutant, str, str]] = []
    pending: dict[Future[tuple[str, str]], Mutant] = {}
    with ProcessPoolExecutor(workers, initializer=enter_copy, initargs=(parent,)) as pool, Progress() as progress:
        bar = progress.add_task("mutants", total=max(deadline - begun, 0))
        while True:
            while len(pending) < workers and time.monotonic() < deadline:
                mutant = next(mutants, None)
                if mutant is None:
                    break
                tests = tests_of(mutant.file, mutant.line, seen, MOST_SECONDS)
                times = {test: seen[test]["seconds"] for test in tests}
                pending[pool.submit(outcome_of, mutant, times)] = mutant
            if not pending:
                return results
            for future in wait(pending, timeout=5, return_when=FIRST_COMPLETED).done:
                mutant = pending.pop(future)
                results.append((mutant, *future.result()))
                if results[-1][1] != "killed":
                    progress.print(f"{results[-1][1]}: {mutant} {results[-1][2]}", markup=False, highlight=False)
            killed = sum(outcome == "killed" for _, outcome, _ in results)
            description = f"{killed} of {len(results)} killed"
            progress.update(bar, completed=time.monotonic() - begun, description=description)


def main() -> int:
    """Draws, tries and counts mutants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", action="append", choices=ROOMS, help="only this room (may be given again)")
    parser.add_argument("--file", action="append", type=Path, help="only this file of the library (may be given again)")
    parser.add_argument("--seed", type=int, help="draws the mutants (default: a new one)")
    parser.add_argument("--minutes", type=float, default=26.0, help="no mutant begins later (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="mutants tried side by side (default: %(default)s)")
    parser.add_argument("--seen", type=Path, metavar="FILE", help="keeps which lines each test runs, for the next time")
    arguments = parser.parse_args()
    deadline = time.monotonic() + 60 * arguments.minutes

    if missing := [str(file) for file in arguments.file or () if not file.is_file()]:
        parser.error(f"no such file: {', '.join(missing)}")
    if find_spec("cosmic_ray") is None:
        parser.error("needs cosmic-ray: pip install 'neuralq[mutants]', or `make mutants`")
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if arguments.seed is None else arguments.seed
    if arguments.file:
        rooms = {str(file): [file.resolve()] for file in arguments.file}
    else:
        rooms = {room: sorted((ROOT / ROOMS[room]).rglob("*.py")) for room in arguments.room or ROOMS}
    print(f"seed {seed}", flush=True)
    with tempfile.TemporaryDirectory() as parent:
        seen, said = control(parent, arguments.seen, arguments.workers)
        if said:
            print(f"{said}\nThe tests fail on the code as it is; mend that first.")
            return 2
        results = run(parent, seen, drawn(rooms, seed), deadline, arguments.workers)

    short = False
    for room in rooms:
        outcomes = [outcome for mutant, outcome, _ in results if mutant.room == room and outcome != "broken"]
        # Tests that do not end notice as well as tests that fail: a loop whose exit is broken has no other sign.
        killed = sum(outcome in ("killed", "timed out") for outcome in outcomes)
        short |= killed < MARK * len(outcomes)
        print(f"{room}: {killed} of {len(outcomes)} killed, {outcomes.count('timed out')} of them by the clock")
    if broken := [f"{mutant}: {said}" for mutant, outcome, said in results if outcome == "broken"]:
        print(f"{len(broken)} could not be tried and count for nothing:", *broken, sep="\n")
    print(f"seed {seed}; {sum(known[0].startswith('neuralq') for known in struck())} mutants are struck as equivalent")
    return int(short)


if __name__ == "__main__":
    sys.exit(main())
