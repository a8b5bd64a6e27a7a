"""Checks an installed neuralq from outside the checkout: ``python installed.py WHEEL`` is silent if all is well."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

STATIC = ("index.html", "style.css", "icon.svg", "lab.js", "charts.js", "numbers.js", "sliders.js", "words.js")


def main(wheel: str) -> None:
    """Raises AssertionError for what does not belong into the wheel, or does not work once it is installed."""
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"neuralq", "neuralq_envs"}, f"unexpected top-level names: {sorted(tops)}"
    assert {"neuralq/py.typed", "neuralq_envs/py.typed"} <= set(names), "a py.typed is missing"
    page = {f"neuralq/apps/web/static/{name}" for name in (*STATIC, "play/backgammon.html", "play/tictactoe.html")}
    page.add("neuralq/systems/backgammon/weights.safetensors")
    assert page <= set(names), f"the pages are incomplete: {sorted(page - set(names))} are missing"
    strays = [name for name in names if name.endswith((".pyc", ".nbi", ".nbc"))]
    assert not strays, f"caches in the wheel: {strays}"

    import gymnasium

    environment = gymnasium.make("neuralq_envs:neuralq/MitchellGrid-v0")  # before any import of neuralq
    observation, _ = environment.reset(seed=0)
    assert environment.observation_space.contains(observation)

    import neuralq
    import neuralq_envs

    for module in (neuralq, neuralq_envs):
        assert Path(sys.prefix) in Path(str(module.__file__)).parents, f"{module.__file__} is not the installed one"
    for name in neuralq.__all__:
        assert getattr(neuralq, name) is not None, name

    from neuralq.backgammon import load_agent
    from neuralq_envs.backgammon import Position

    start = Position.initial()
    five_point = load_agent().best_move(start, (3, 1))
    assert five_point.gnubg_id == "sGfwATDgc/ABMA", "a trained network makes its five point with 3-1"


if __name__ == "__main__":
    main(sys.argv[1])
