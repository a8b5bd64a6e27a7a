"""What all tests share: one thread per process, and property tests that draw the same examples every time."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Iterator
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

gc.disable()  # until everything is collected: half of that time went into looking for garbage among what stays

# The tests of a checkout test that checkout, whatever else is installed, and so do the processes that they start.
ROOT = Path(__file__).resolve().parents[1]
for name in ("neuralq", "neuralq_envs"):
    spec = find_spec(name)
    assert spec is not None and spec.origin is not None and ROOT in Path(spec.origin).resolve().parents, (
        f"{name} comes from {spec and spec.origin}, not from {ROOT}; run pytest from the root of its own checkout"
    )
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(ROOT), str(ROOT / "envs"), *filter(None, [os.environ.get("PYTHONPATH")])]
)

# The same examples in every run: a failure is the change's fault, never the day's. No deadline: kernels compile once.
settings.register_profile("house", derandomize=True, max_examples=25, deadline=None, database=None)
settings.load_profile("house")

# Shapes: annotations of jaxtyping are checked by beartype in tests only. The hook has to be installed before the first
# import of a module that it is to check, so it belongs here, above every import of neuralq:
#     jaxtyping.install_import_hook(["neuralq.rules"], "beartype.beartype")


def pytest_collection_finish() -> None:
    """From here on garbage is looked for, but not among what was collected."""
    gc.freeze()
    gc.enable()


LOOKED_AT = ("test_cli_compare", "test_figures", "test_report", "test_scripts")


@pytest.fixture(scope="module", autouse=True)
def unpainted(request: pytest.FixtureRequest) -> Iterator[None]:
    """Reports have frames in the place of pictures where no test looks at one: a short run spends most time on them."""
    if request.path.parent.name != "tests" or request.path.stem.startswith(LOOKED_AT):
        yield
        return

    def frame(name: str, title: str, description: str, *_: object) -> str:
        return f'<svg id="{name}" role="img"><title>{escape(title)}</title><desc>{escape(description)}</desc></svg>'

    with pytest.MonkeyPatch.context() as patch:
        for module in ("comparison", "curves", "grid"):
            patch.setattr(f"neuralq.runs.report.{module}.draw_svg", frame)
        yield


WELL_KNOWN = ("CartPole-v1", "FrozenLake-v1", "Taxi-v4", "CliffWalking-v1", "neuralq/")


@pytest.fixture(scope="session", autouse=True)
def probed_once() -> Iterator[None]:
    """A run begins by trying whether its environment can be put back: here once for all that are made alike.

    That was half of what a short run cost.
    """
    from neuralq.runs.folder.env_probe import is_resumable
    from neuralq.runs.recipe import build, environments

    found: dict[tuple[Any, ...], Any] = {}
    probe = build._probe

    def remembered(config: Any, envs: Any, make: Any) -> Any:
        plain = not config.wrappers and config.frame_stack == 1 and environments.stand_in() is None
        if not (plain and config.env.startswith(WELL_KNOWN) and build.is_resumable is is_resumable):
            return probe(config, envs, make)
        key = (config.env, repr(config.env_kwargs), config.resume_probe, type(envs), getattr(envs, "num_envs", 1))
        if key not in found:
            found[key] = probe(config, envs, make)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "_probe", remembered)
        yield


# While one process compiles the networks' kernels the other has work that needs none; then one compiles those of single
# rows and of tables, beside what needs the networks' only. Whoever comes later finds all of them compiled.
FIRST = (
    *("test_engine", "test_contract_lab_methods", "test_lab_critic", "test_lab_critical", "test_lab_prescribe"),
    *("test_counterexamples", "test_lab_methods_gradient", "test_corners", "test_contract_target_rules", "test_masks"),
)


def place(item: pytest.Item, sizes: Counter[Path]) -> tuple[int, int, str]:
    """Files in the order in which processes take them: those that compile much, then the large ones."""
    stem = item.path.stem
    return (FIRST.index(stem) if stem in FIRST else len(FIRST), -sizes[item.path], str(item.path))


# What is tried whole takes long: systems whose loops have to be compiled, processes that are started, ended and killed,
# pages in a browser, pictures, and what holds every environment, every update on an accelerator and every case of the
# doctor. `make whole` runs these, and single tests that are marked `whole`; CI does so too.
WHOLE = (
    *("test_advice", "test_backgammon", "test_backgammon_expert", "test_backgammon_fuzz", "test_backgammon_learning"),
    *("test_backgammon_match", "test_backgammon_oracles", "test_backgammon_play", "test_backgammon_run"),
    *("test_bucket_brigade", "test_checkers", "test_checkers_learning", "test_child", "test_elevators"),
    *("test_figure_13_2", "test_hierarchies", "test_job_shop", "test_lin", "test_mccallum", "test_obelix"),
    *("test_thrun_robot_learning",),
    *("test_checkpoint_kill", "test_children", "test_processes_of_others", "test_signals"),
    *("test_processors", "test_sweep", "test_sweep_attempts", "test_sweep_scripts", "test_tune"),
    *("test_cli_export", "test_docs", "test_export_torch", "test_lab_registry", "test_modules", "test_registry"),
    *("test_figures", "test_play", "test_play_checkers", "test_play_page", "test_play_turns", "test_report"),
    *("test_scripts", "test_turned", "test_web", "test_web_page"),
    *("test_contract_env_models", "test_envs", "test_envs_tictactoe", "test_fitted", "test_fitted_laws"),
    *("test_doctor_exam", "test_doctor_twins", "test_no_round_trips"),
)
FOLDERS = {
    *(ROOT / "neuralq" / room for room in ("systems", "apps/web")),
    *(ROOT / "envs" / "neuralq_envs" / game for game in ("backgammon", "checkers", "job_shop", "lin_world")),
}
EXAMPLES = {
    *(ROOT / "neuralq" / "tabular" / "kernels" / name for name in ("bits.py", "compositional.py", "zcs.py")),
    ROOT / "neuralq" / "tabular" / "kernels" / "transition_hierarchy.py",
    *(ROOT / "neuralq" / "learners" / name for name in ("lessons.py", "turned.py")),
    ROOT / "envs" / "neuralq_envs" / "obelix_kernels.py",
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The lanes and the order of files; tests marked ``gpu`` are skipped where torch finds no accelerator."""
    for item in items:
        is_whole = item.path.stem in WHOLE or item.path in EXAMPLES or not FOLDERS.isdisjoint(item.path.parents)
        if item.get_closest_marker("whole") is not None:
            item.add_marker("slow")
        elif is_whole and item.get_closest_marker("slow") is None:
            item.add_marker("slow")
            item.add_marker("whole")
    sizes = Counter(item.path for item in items)
    items.sort(key=lambda item: place(item, sizes))  # stable: the order within a file stays
    import torch  # not above: with xdist, the process that hands out the tests needs none

    torch.set_num_threads(1)  # processes share few cores, and single-threaded sums are the same bits on every machine
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu") is not None:
                item.add_marker(pytest.mark.skip(reason="no accelerator that torch can use"))
