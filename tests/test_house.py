"""The rules of the house that no linter knows: sizes, names, end facts, randomness, documentation, lazy imports.

Each rule is a function from a parsed file to its offences, so that the rules themselves are tested on planted offences
(`test_each_rule_finds_a_planted_offence`).
"""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import pytest

from neuralq import RunConfig
from neuralq.runs.recipe.environments import make_envs

ROOT = Path(__file__).parents[1]
LIBRARY = sorted([*(ROOT / "neuralq").rglob("*.py"), *(ROOT / "envs").rglob("*.py")])
SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))
README = ROOT / "README.md"

MAX_FILE_LINES = 450
MAX_FUNCTION_LINES = 40
VAGUE_NAMES = {"utils", "common", "base", "manager", "data", "info"}
KERNEL_DECORATORS = {
    *("kernel", "lean_kernel", "lean_reassociating_kernel", "reassociating_kernel"),
    *("jit", "njit", "vectorize", "guvectorize"),
}
# Functions that draw from, or seed, a generator that the whole process shares.
TORCH_GLOBAL_DRAWS = {
    *("manual_seed", "seed", "rand", "randn", "randint", "randperm", "normal", "bernoulli", "multinomial", "poisson"),
    *("rand_like", "randn_like", "randint_like"),
}
NUMPY_GENERATORS = {
    "default_rng",
    "Generator",
    "SeedSequence",
    "BitGenerator",
    "PCG64",
    "PCG64DXSM",
    "Philox",
    "SFC64",
    "MT19937",
}
# Objects with a state of their own: needed to restore an environment that holds one.
OWN_GENERATORS = {"Random", "RandomState"}

Offence = tuple[int, str]
Rule = Callable[[ast.Module], Iterator[Offence]]


def dotted(node: ast.AST) -> str:
    """``a.b.c`` of a name or an attribute; "" of anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        inner = dotted(node.value)
        return f"{inner}.{node.attr}" if inner else node.attr
    return ""


@lru_cache(maxsize=1)
def nodes(tree: ast.Module) -> list[ast.AST]:
    """All of them, walked once for all rules."""
    return list(ast.walk(tree))


def calls(tree: ast.Module) -> Iterator[tuple[ast.Call, str]]:
    """Every call with the dotted name of what is called."""
    return ((node, dotted(node.func)) for node in nodes(tree) if isinstance(node, ast.Call))


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """The lines from ``def`` to the end; the docstring is documentation and does not count."""
    assert function.end_lineno is not None
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        docstring = function.body[0]
        assert docstring.end_lineno is not None
        lines -= docstring.end_lineno - docstring.lineno + 1
    return lines


def long_functions(tree: ast.Module) -> Iterator[Offence]:
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = {dotted(d.func if isinstance(d, ast.Call) else d).split(".")[-1] for d in node.decorator_list}
            if not decorators & KERNEL_DECORATORS and code_lines(node) > MAX_FUNCTION_LINES:
                yield node.lineno, f"{node.name} has {code_lines(node)} lines, at most {MAX_FUNCTION_LINES}"


def merged_end_facts(tree: ast.Module) -> Iterator[Offence]:
    for node in nodes(tree):
        names = [getattr(node, field, None) for field in ("id", "arg", "attr", "name")]
        if any(
            isinstance(name, str) and "done" in name and re.fullmatch(r"_*dones?_*|dones?_.*|.*_dones?", name)
            for name in names
        ):
            yield getattr(node, "lineno", 0), "named `done`; say whether the world ended or the stream breaks"


def vague_classes(tree: ast.Module) -> Iterator[Offence]:
    for node in nodes(tree):
        if isinstance(node, ast.ClassDef):
            words = {word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+", node.name)}
            if words & {"manager", "utils"} or node.name.lower() in VAGUE_NAMES:
                yield node.lineno, f"class {node.name} has a name that says nothing"


def squeezes_without_axis(tree: ast.Module) -> Iterator[Offence]:
    for node, name in calls(tree):
        arguments = len(node.args) + len(node.keywords)
        expected = 2 if name in {"torch.squeeze", "np.squeeze", "numpy.squeeze"} else 1
        if name.split(".")[-1] == "squeeze" and arguments < expected:
            yield node.lineno, "squeeze without an axis drops a batch of one as well"


def pickles(tree: ast.Module) -> Iterator[Offence]:
    for node in nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            if {module.split(".")[0] for module in modules} & {"pickle", "cloudpickle", "dill", "shelve", "marshal"}:
                yield node.lineno, "pickle runs code from the file that it reads"
        elif isinstance(node, ast.keyword) and isinstance(node.value, ast.Constant):
            if (node.arg, node.value.value) in {("allow_pickle", True), ("weights_only", False)}:
                yield node.value.lineno, f"{node.arg}={node.value.value} reads pickles"
    yield from ((node.lineno, name) for node, name in calls(tree) if name in {"torch.load", "torch.save"})


def global_draws(tree: ast.Module) -> Iterator[Offence]:
    for node, name in calls(tree):
        module, _, function = name.rpartition(".")
        given = {keyword.arg for keyword in node.keywords}
        from_torch = module == "torch" and function in TORCH_GLOBAL_DRAWS and "generator" not in given
        from_numpy = module in {"np.random", "numpy.random"} and function not in NUMPY_GENERATORS | OWN_GENERATORS
        from_python = module == "random" and function not in OWN_GENERATORS
        if from_torch or from_numpy or from_python:
            yield node.lineno, f"{name} uses the generator that the whole process shares"


def implementation_bases(tree: ast.Module) -> Iterator[Offence]:
    own = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    for node in own.values():
        for base in map(dotted, node.bases):
            if base in own and not is_interface(own[base]):
                yield node.lineno, f"{node.name} inherits the implementation of {base}"


def is_interface(node: ast.ClassDef) -> bool:
    """Protocols, enumerations, named tuples and exceptions may be built upon."""
    bases = {dotted(base.value if isinstance(base, ast.Subscript) else base).split(".")[-1] for base in node.bases}
    return bool(bases & {"Protocol", "ABC", "Enum", "NamedTuple"}) or any(b.endswith(("Error", "tion")) for b in bases)


AUDITED = ("neuralq/doctor/weights.py", "torch.load")
"""The one place that may read a ``.pth``, with weights_only=True: `test_doctor_loading` attacks it."""

RULES: list[Rule] = [
    *(long_functions, merged_end_facts, vague_classes, squeezes_without_axis),
    *(pickles, global_draws, implementation_bases),
]

PLANTED = {
    "long_functions": "def f():\n" + "    x = 1\n" * 40,
    "merged_end_facts": "def f(done):\n    return 1",
    "vague_classes": "class RunManager: ...",
    "squeezes_without_axis": "y = x.squeeze()",
    "pickles": "np.load(path, allow_pickle=True)",
    "global_draws": "x = torch.randn(3)",
    "implementation_bases": "class A:\n    x = 1\nclass B(A): ...",
}
INNOCENT = """
@kernel
def f():
    return x.squeeze(-1) + torch.randn(3, generator=g) + np.random.default_rng(0).random()
class Shape(Protocol): ...
class Circle(Shape): ...
np.load(path, allow_pickle=False)
abandoned = terminated
"""


def test_the_library_keeps_the_rules() -> None:
    offences = [
        f"{path.relative_to(ROOT)}:{line}: {message}"
        for path in LIBRARY
        for tree in [ast.parse(path.read_text(encoding="utf-8"))]
        for rule in RULES
        for line, message in rule(tree)
        if (path.relative_to(ROOT).as_posix(), message) != AUDITED
    ]
    assert not offences, "\n" + "\n".join(offences)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_each_rule_finds_a_planted_offence(rule: Rule) -> None:
    assert list(rule(ast.parse(PLANTED[rule.__name__])))
    assert not list(rule(ast.parse(INNOCENT)))


def test_files_are_short_and_their_names_say_something() -> None:
    lengths = {path.relative_to(ROOT): len(path.read_text(encoding="utf-8").splitlines()) for path in LIBRARY}
    assert not {str(path): lines for path, lines in lengths.items() if lines > MAX_FILE_LINES}
    names = {part for path in lengths for part in (*path.parts[:-1], path.stem)}
    assert not names & VAGUE_NAMES


LOOSE_FILES = {
    *("__init__.py", "__main__.py", "py.typed"),
    *("types.py", "checks.py", "jit.py", "figures.py"),
    "backgammon.py",
    "dqn.py",  # a public name: what it re-exports lives in systems/
}
ROOMS = {"apps", "doctor", "lab", "systems", "runs", "learners", "q", "tabular", "exact", "rules", "mdp"}


def test_the_top_of_the_package_shows_the_rooms_and_little_else() -> None:
    top = {path for path in (ROOT / "neuralq").iterdir() if path.name != "__pycache__"}
    assert {path.name for path in top if path.is_file()} <= LOOSE_FILES
    assert {path.name for path in top if any(path.rglob("*.py"))} == ROOMS


def test_every_folder_with_code_is_a_package() -> None:
    assert not {str(path.parent) for path in LIBRARY if not (path.parent / "__init__.py").exists()}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT / "envs" if ROOT / "envs" in path.parents else ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_every_module_names_its_public_names_and_documents_them() -> None:
    offences = []
    for path in LIBRARY:
        if path.name == "__main__.py":
            continue
        module = importlib.import_module(module_name(path))
        if not hasattr(module, "__all__"):
            # A package without code has nothing to name.
            if len(ast.parse(path.read_text(encoding="utf-8")).body) > 2 or path.name != "__init__.py":
                offences.append(f"{module.__name__} has no __all__")
            continue
        for name in module.__all__:
            value = getattr(module, name, None)
            if value is None:
                offences.append(f"{module.__name__}.__all__ names {name}, which is not there")
            elif (
                callable(value)
                and getattr(value, "__module__", "typing") != "typing"
                and not (value.__doc__ or "").strip()
            ):
                offences.append(f"{module.__name__}.{name} has no docstring")
        if not (module.__doc__ or "").strip():
            offences.append(f"{module.__name__} has no docstring")
    assert not offences, "\n" + "\n".join(offences)


def test_importing_neuralq_imports_neither_torch_nor_numpy() -> None:
    program = "import sys, neuralq; print(sorted({'torch', 'numpy', 'gymnasium', 'scipy'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.whole
def test_public_names_load_on_demand_and_survive_the_import_of_every_module() -> None:
    program = (
        "import sys; sys.path[:0] = ['envs', '.']; import importlib, pkgutil, neuralq\n"
        "names = [m.name for m in pkgutil.iter_modules(neuralq.__path__) if m.name != '__main__']\n"
        "for name in names: importlib.import_module('neuralq.' + name)\n"
        "functions = [neuralq.train, neuralq.resume, neuralq.load]\n"
        "assert all(callable(function) for function in functions), functions\n"
        "assert not set(names) & set(neuralq._HOMES), 'a module would rebind a public name'\n"
        "assert all(getattr(neuralq, name) is not None for name in neuralq.__all__)\n"
    )
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_an_unknown_name_lists_the_known_ones() -> None:
    import neuralq

    with pytest.raises(AttributeError, match="FiniteMDP"):
        _ = neuralq.FiniteMdp  # type: ignore[attr-defined]


def in_a_fresh_process(program: str) -> str:
    run = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0 and not run.stderr, run.stderr
    return run.stdout


@pytest.mark.whole
@pytest.mark.parametrize(
    "program",
    [
        "import gymnasium; gymnasium.make('neuralq_envs:neuralq/MitchellGrid-v0').reset(seed=0)",
        "import neuralq_envs, gymnasium; neuralq_envs.register(); gymnasium.make('neuralq/MitchellGrid-v0').reset()",
        "import gymnasium, neuralq_envs; gymnasium.make_vec('neuralq/MitchellGrid-v0', num_envs=2).reset(seed=0)",
        # Two forks of one process, which has loaded what is large and nothing of ours.
        "import os, torch, gymnasium; first = os.fork()\n"
        "assert not {name for name in sys.modules if name.startswith('neuralq')}\n"
        "if first:\n"
        "  import neuralq.apps.cli as cli; assert cli.main(['solve', 'neuralq/MitchellGrid-v0', '--json']) == 0\n"
        "  assert os.waitpid(first, 0)[1] == 0\n"
        "else:\n"
        "  from neuralq.runs.recipe.environments import make_envs; import neuralq\n"
        "  make_envs(neuralq.RunConfig(env='neuralq/MitchellGrid-v0'), 2).close()\n",
    ],
)
def test_environments_are_found_by_an_import_and_by_what_neuralq_does(program: str) -> None:
    in_a_fresh_process(f"import sys; {program}")


def test_nothing_runs_at_the_start_of_an_interpreter() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert not [*(ROOT / "neuralq").rglob("*.pth"), *(ROOT / "envs").rglob("*.pth")]
    assert "force-include" not in str(project["tool"]["hatch"]) and "entry-points" not in project["project"]


def test_an_unknown_environment_of_ours_is_answered_with_the_known_ones_and_the_line_that_works() -> None:
    with pytest.raises(ValueError, match="Did you mean: `MitchellGrid`") as refused:
        make_envs(RunConfig(env="neuralq/MitchelGrid-v0"), 1)
    line = re.search(r"'(neuralq_envs:[\w/-]+)'", str(refused.value))
    assert line is not None and "\n" not in str(refused.value)
    assert (
        in_a_fresh_process(f"import gymnasium; print(gymnasium.make({line[1]!r}).observation_space)") == "Discrete(6)\n"
    )


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_says_how_to_run_it(script: Path) -> None:
    docstring = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    assert f"python scripts/{script.name}" in docstring


def test_the_readme_is_short_and_names_both_commands() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 200
    assert "make demo" in text
    assert "make test" in text


def test_no_two_test_files_register_one_environment() -> None:
    """Files share a process, and Gymnasium warns of the second, which is an error here."""
    files = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("*.py")}
    found = [name for text in files.values() for name in set(re.findall(r"\bregister\(\s*f?\"([^\"]+)\"", text))]
    assert len(found) > 20 and sorted(found) == sorted(set(found))
