"""Breaks the library by one sign, comparison, constant or condition at a time, and counts the tests that notice.

    python scripts/mutants.py                        # the five rooms that numbers come from, 30 minutes on two cores
    python scripts/mutants.py --room exact --seed 3 --minutes 10
    python scripts/mutants.py --file neuralq/rules/returns.py --minutes 5

Mutants are made by cosmic-ray, in copies of the checkout; yours is not touched. First the tests have to pass on a copy
that nobody has broken; then mutants are drawn at random from a seed that is printed, in turn from each room, until the
time is up. Each meets the fast tests of its file: those that name the file or what it makes public, then those of the
files that import it. A survivor that computes the same is struck, with the reason, in
``scripts/equivalent_mutants.toml``. Exit status 1 when a room kills under 95 % of the others.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from rich.progress import Progress

if find_spec("cosmic_ray") is not None:  # `--help` answers without the extra
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import MutationVisitor, mutate_and_test
    from cosmic_ray.plugins import get_operator
    from cosmic_ray.work_item import MutationSpec, TestOutcome

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
TESTS_OF_A_FILE = 8
SHOWN = ("frozen", "slots", "repr", "eq", "compare")  # how a record is shown and kept, not what it computes
LIMIT = 240.0  # seconds for the tests of one mutant
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


@cache
def public_names(file: str) -> tuple[str, ...]:
    """What a file makes public: its ``__all__``, or its functions and classes."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return tuple(ast.literal_eval(node.value))
    return tuple(n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef))


@cache
def importers(module: str) -> tuple[str, ...]:
    """The library's files that import a module."""
    wanted = re.compile(rf"^\s*from {re.escape(module)} import|^\s*import {re.escape(module)}\b", re.MULTILINE)
    files = (str(p.relative_to(ROOT)) for p in sorted((ROOT / "neuralq").rglob("*.py")))
    return tuple(file for file in files if wanted.search((ROOT / file).read_text(encoding="utf-8")))


@cache
def tests_of(file: str) -> tuple[str, ...]:
    """The doctests of a file and the tests that name it, then those of the files that import it, nearest first."""
    room = ".".join(file.split("/")[:2])  # names such as `run` and `sweep` mean something else to tests of other rooms
    texts = {p.name: p.read_text(encoding="utf-8") for p in sorted((ROOT / "tests").glob("test_*.py"))}
    texts = {name: text for name, text in texts.items() if room in text}
    chosen: list[str] = []
    for near in (file, *importers(file.removesuffix(".py").replace("/", "."))):
        module = re.escape(near.removesuffix(".py").replace("/", "."))
        names = "|".join(map(re.escape, public_names(near))) or r"(?!)"
        hits = {
            name: 5 * len(re.findall(rf"\b{module}\b", text)) + len(re.findall(rf"\b(?:{names})\b", text))
            for name, text in texts.items()
        }
        chosen += [name for name in sorted(hits, key=lambda name: -hits[name]) if hits[name] and name not in chosen]
        if len(chosen) >= TESTS_OF_A_FILE:
            break
    return (file, *(f"tests/{test}" for test in chosen[:TESTS_OF_A_FILE]))


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
    """Gives this process a copy of its own to break."""
    copy = copied(parent)
    os.chdir(copy)
    os.environ["PYTHONPATH"] = os.pathsep.join((str(copy), str(copy / "envs")))
    os.environ["OMP_NUM_THREADS"] = "1"


def pytest_command(tests: Iterable[str], *options: str) -> list[str]:
    """Runs the fast ones among these tests."""
    return [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *options, *tests]


def control(parent: str, rooms: dict[str, list[Path]], workers: int) -> str:
    """What the tests say of a copy that nobody has broken; nothing where they pass."""
    paths = (path for room in rooms.values() for path in room)
    tests = sorted({test for path in paths for test in tests_of(str(path.relative_to(ROOT)))})
    copy = copied(parent)
    paths_of_copy = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(copy), str(copy / "envs"))),
        "OMP_NUM_THREADS": "1",
    }
    command = pytest_command(tests, "-n", str(workers), "--dist", "loadfile")
    result = subprocess.run(command, cwd=copy, env=paths_of_copy, capture_output=True, text=True, check=False)
    return "" if result.returncode == 0 else result.stdout[-3000:] + result.stderr[-1000:]


def outcome_of(mutant: Mutant) -> tuple[str, str]:
    """Whether the tests of the file noticed, and what they printed; run in a copy."""
    has_kernels = "neuralq.jit" in Path(mutant.file).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as kernels:
        # A kernel that calls a changed one in another file would come from the cache as it was before.
        os.environ.pop("NUMBA_CACHE_DIR", None)
        if has_kernels:
            os.environ["NUMBA_CACHE_DIR"] = kernels
        change = MutationSpec(Path(mutant.file), mutant.operator, mutant.occurrence, (mutant.line, 0), (mutant.line, 1))
        result = mutate_and_test([change], shlex.join(pytest_command(tests_of(mutant.file), "-x")), LIMIT)
    output = result.output or ""
    if output == "timeout":
        return "timed out", output
    return {TestOutcome.KILLED: "killed", TestOutcome.SURVIVED: "survived"}.get(result.test_outcome, "broken"), output


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


def run(parent: str, mutants: Iterator[Mutant], minutes: float, workers: int) -> list[tuple[Mutant, str, str]]:
    """What became of each mutant that began before the time was up."""
    begun = time.monotonic()
    results: list[tuple[Mutant, str, str]] = []
    pending: dict[Future[tuple[str, str]], Mutant] = {}
    with ProcessPoolExecutor(workers, initializer=enter_copy, initargs=(parent,)) as pool, Progress() as progress:
        bar = progress.add_task("mutants", total=60 * minutes)
        while True:
            while len(pending) < workers and time.monotonic() < begun + 60 * minutes:
                mutant = next(mutants, None)
                if mutant is None:
                    break
                pending[pool.submit(outcome_of, mutant)] = mutant
            if not pending:
                return results
            for future in wait(pending, timeout=5, return_when=FIRST_COMPLETED).done:
                mutant = pending.pop(future)
                results.append((mutant, *future.result()))
                if results[-1][1] != "killed":
                    progress.print(f"{results[-1][1]}: {mutant}", markup=False, highlight=False)
            killed = sum(outcome == "killed" for _, outcome, _ in results)
            description = f"{killed} of {len(results)} killed"
            progress.update(bar, completed=time.monotonic() - begun, description=description)


def main() -> int:
    """Draws, tries and counts mutants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", action="append", choices=ROOMS, help="only this room (may be given again)")
    parser.add_argument("--file", action="append", type=Path, help="only this file of the library (may be given again)")
    parser.add_argument("--seed", type=int, help="draws the mutants (default: a new one)")
    parser.add_argument("--minutes", type=float, default=25.0, help="no mutant begins later (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="mutants tried side by side (default: %(default)s)")
    arguments = parser.parse_args()

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
        if said := control(parent, rooms, arguments.workers):
            print(f"{said}\nThe tests fail on the code as it is; mend that first.")
            return 2
        results = run(parent, drawn(rooms, seed), arguments.minutes, arguments.workers)

    short = False
    for room in rooms:
        outcomes = [outcome for mutant, outcome, _ in results if mutant.room == room]
        # Tests that do not end notice as well as tests that fail: a loop whose exit is broken has no other sign.
        killed = sum(outcome in ("killed", "timed out") for outcome in outcomes)
        short |= killed < MARK * len(outcomes)
        print(f"{room}: {killed} of {len(outcomes)} killed, {outcomes.count('timed out')} of them by the clock")
    print(f"seed {seed}; {sum(known[0].startswith('neuralq') for known in struck())} mutants are struck as equivalent")
    return int(short)


if __name__ == "__main__":
    sys.exit(main())
