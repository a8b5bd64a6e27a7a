"""Every command on every odd space, broken environment and missing extra: it works, or says in a line why not."""

from __future__ import annotations

import builtins
import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.figures import draw_svg
from neuralq.runs import RunConfig
from neuralq.runs.faults import explained, own_frame
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.recipe import build
from neuralq.systems.backgammon.opponents import IllegalTurn

Capture = pytest.CaptureFixture[str]
TINY = ["--total-steps", "8", "--evaluate-every", "8", "--evaluation-episodes", "1", "--rollout.num-envs", "1"]
TINY += ["--rollout.num-steps", "4", "--rollout.num-minibatches", "1"]

ACCEPTED: dict[str, gym.Space[Any]] = {
    "scalar": spaces.Box(-1, 1, ()),
    "stack": spaces.Box(0, 255, (2, 4, 5, 3), np.uint8),
    "five axes": spaces.Box(0, 1, (1, 2, 2, 2, 2)),
    "one state": spaces.Discrete(1),
    "start": spaces.Discrete(4, start=-2),
    "bits": spaces.MultiBinary(3),
    "digits": spaces.MultiDiscrete([2, 3]),
    "tuple": spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (0,))]),
    "dict": spaces.Dict(a=spaces.Discrete(2), b=spaces.Box(0, 255, (2, 2), np.uint8)),
    "half": spaces.Box(-1, 1, (2,), np.float16),
    "no bounds": spaces.Box(-np.inf, np.inf, (2,)),
}
REFUSED: dict[str, gym.Space[Any]] = {
    "length 0": spaces.Box(-1, 1, (0,)),
    "no channel": spaces.Box(0, 255, (4, 4, 0), np.uint8),
    "no part": spaces.Dict({}),
    "text": spaces.Text(5),
    "graph": spaces.Graph(spaces.Box(-1, 1, (2,)), None),
    "sequence": spaces.Sequence(spaces.Discrete(2)),
    "one of": spaces.OneOf([spaces.Discrete(2), spaces.Discrete(3)]),
    "text inside": spaces.Dict(a=spaces.Text(5)),
    "a cube": spaces.Box(0, 255, (5, 5, 5), np.uint8),
}
ACTIONS: dict[str, gym.Space[Any]] = {
    "box": spaces.Box(-1, 1, (1,)),
    "digits": spaces.MultiDiscrete([2, 2]),
    "bits": spaces.MultiBinary(2),
    "dict": spaces.Dict(a=spaces.Discrete(2)),
    "text": spaces.Text(3),
}


class Odd(gym.Env[Any, Any]):
    """Knows no render_mode, and breaks where it is told to."""

    def __init__(self, space: str = "no bounds", action: str | None = None, fault: str = "") -> None:
        self.observation_space = {**ACCEPTED, **REFUSED}[space]
        self.action_space = spaces.Discrete(2, start=-3) if action is None else ACTIONS[action]
        self.fault = fault
        self.t = 0
        self._break("init", RuntimeError("cannot begin"))

    def _break(self, place: str, error: Exception) -> None:
        if self.fault == place:
            raise error

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._break("reset", KeyError("speed"))
        self.observation_space.seed(seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        self._break("step", ZeroDivisionError("no mass"))
        seen: Any = None if self.fault == "observation" else self.observation_space.sample()
        if self.fault == "four values":
            return seen, 1.0, False, {}
        return seen, "one" if self.fault == "reward" else 1.0, self.t >= 3, False, {}


class Drawn(Odd):
    """Draws what nobody can film."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, draws: str = "nothing") -> None:
        super().__init__()
        self.render_mode, self.draws = render_mode, draws

    def render(self) -> Any:
        if self.draws == "error":
            raise AttributeError("no window")
        if self.draws == "missing":
            raise gym.error.DependencyNotInstalled("pygame is not installed")
        return {"nothing": None, "list": [np.zeros((4, 4, 3), np.uint8)]}[self.draws]


class Boast(Odd):
    """Says that it can be drawn, and takes no render_mode."""

    metadata = {"render_modes": ["rgb_array", "human", "ansi"], "render_fps": 10}  # noqa: RUF012


for made in (Odd, Drawn, Boast):
    gym.register(f"odd/{made.__name__}-v0", made, disable_env_checker=True)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(build, "is_resumable", lambda *_: Resumability(False, "not asked"))  # has tests of its own


def train(env: str, *words: str, **kwargs: Any) -> int:
    return main(["train", env, "--env-kwargs", json.dumps(kwargs), *TINY, "--run-dir", "run", *words])


def refusal(capsys: Capture) -> str:
    """The error, which is one line, with where in the environment's code it arose below it."""
    lines = capsys.readouterr().err.splitlines()
    at = max(i for i, line in enumerate(lines) if line.startswith("neuralq: "))
    assert "Traceback (most" not in "".join(lines) and len(lines) - at <= 2, lines
    return "\n".join(lines[at:])


@pytest.mark.parametrize("space", ACCEPTED)
def test_every_command_works_on_every_space_that_can_be_learned_from(space: str, capsys: Capture) -> None:
    assert train("odd/Odd-v0", space=space) == 0
    assert main(["evaluate", "run", "--episodes", "2"]) == 0
    capsys.readouterr()
    for command in (["record", "run", "--gif", "x.gif"], ["watch", "run"]):
        assert main(command) == 1
        assert "draw" in refusal(capsys)


@pytest.mark.parametrize("space", REFUSED)
def test_a_space_that_cannot_be_learned_from_is_one_line(space: str, capsys: Capture) -> None:
    assert train("odd/Odd-v0", space=space) == 1
    said = refusal(capsys)
    assert any(
        way_out in said for way_out in ("turn it into a Box", "give it at least one", "not allowed", "channel_order")
    )


@pytest.mark.parametrize("action", ACTIONS)
def test_actions_that_cannot_be_chosen_among_are_one_line(action: str, capsys: Capture) -> None:
    assert train("odd/Odd-v0", action=action) == 1
    assert "the action space must be Discrete" in refusal(capsys)


@pytest.mark.parametrize(
    ("fault", "wanted"),
    [
        ("init", "RuntimeError: cannot begin"), ("reset", "raised KeyError: 'speed'"),
        ("step", "raised ZeroDivisionError: no mass"), ("observation", "must have shape"),
        ("four values", "expected 5, got 4"), ("reward", "reward must be a number, got 'one'"),
    ],
)  # fmt: skip
def test_a_fault_of_an_environment_is_told_with_its_file_and_line(fault: str, wanted: str, capsys: Capture) -> None:
    assert train("odd/Odd-v0", fault=fault) == 1
    said = refusal(capsys)
    assert wanted in said
    if fault in ("init", "reset", "step"):  # the others did not raise
        assert f"in {__file__}, line " in said and "raise error" in said and "--debug" in said


def test_debug_shows_the_whole_traceback(capsys: Capture) -> None:
    assert train("odd/Odd-v0", "--debug", fault="step") == 1
    said = capsys.readouterr().err
    assert (
        "Traceback" in said
        and "ZeroDivisionError: no mass" in said
        and said.splitlines()[-2].startswith("neuralq: error")
    )


@pytest.mark.parametrize(
    ("draws", "wanted"),
    [
        ("nothing", "a frame must be"), ("list", "a frame must be"), ("error", "AttributeError: no window"),
        ("missing", 'pip install "neuralq[video]"'),
    ],
)  # fmt: skip
def test_what_cannot_be_filmed_is_one_line(draws: str, wanted: str, capsys: Capture) -> None:
    assert train("odd/Drawn-v0", draws=draws) == 0
    capsys.readouterr()
    assert main(["record", "run", "--gif", "x.gif"]) == 1
    assert wanted in refusal(capsys) and not Path("x.gif").exists()


def test_an_environment_that_takes_no_render_mode_is_one_line(capsys: Capture) -> None:
    assert train("odd/Boast-v0") == 0
    capsys.readouterr()
    for command in (["record", "run", "--gif", "x.gif"], ["watch", "run"]):
        assert main(command) == 1
        assert "unexpected keyword argument 'render_mode'" in refusal(capsys)


@pytest.mark.parametrize("name", ["./my_env.py", "..", "", "a b", "a:b"])
def test_a_file_is_not_the_name_of_a_module(name: str, capsys: Capture) -> None:
    for words in (["train", f"{name}:X-v0"], ["solve", f"{name}:X-v0"]):
        assert main([*words]) == 1
        assert "must name a module before the colon, as in '" in refusal(capsys)
    if ":" not in name:
        assert train("odd/Odd-v0", "--hook", f"{name}:f") in (1, 2)
        assert "module" in refusal(capsys)


HOOKS = """
class Ordinary:
    def __init__(self, number): ...

class Monitor:
    @classmethod
    def of(cls, config):
        return lambda row: print("seed", config.seed)

raising = 1 / 0
"""


def test_hooks_are_made_of_the_configuration_where_they_can_be(capsys: Capture) -> None:
    Path("odd_hooks.py").write_text(HOOKS.replace("raising = 1 / 0", ""))
    Path("odd_raising.py").write_text(HOOKS)
    try:
        assert train("odd/Odd-v0", "--hook", "odd_hooks:Monitor", "--seed", "3") == 0
        assert "seed 3" in capsys.readouterr().out
        assert train("odd/Odd-v0", "--hook", "odd_hooks:Ordinary", "--run-dir", "other") == 1
        assert "missing 1 required positional argument: 'number'" in refusal(capsys)
        assert train("odd/Odd-v0", "--hook", "odd_raising:Monitor", "--run-dir", "third") == 1
        assert "division by zero" in (said := refusal(capsys)) and "odd_raising.py, line 10" in said
    finally:
        for name in ("odd_hooks", "odd_raising"):
            sys.modules.pop(name, None)
    assert train("odd/Odd-v0", "--hook", "neuralq.lab:DivergenceMonitor", "--run-dir", "fourth") == 0


@pytest.mark.parametrize(
    "missing", ["matplotlib", "onnxruntime", "onnx", "PIL", "tensorboard", "wandb", "Box2D", "ale_py"]
)
def test_a_missing_extra_is_named(missing: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    words = {
        "matplotlib": ["report", "run"], "onnxruntime": ["export", "run", "--onnx", "x.onnx"],
        "onnx": ["export", "run", "--onnx", "x.onnx"], "PIL": ["record", "run", "--gif", "x.gif"],
        "tensorboard": ["train", "CartPole-v1", "--tensorboard"], "wandb": ["train", "CartPole-v1", "--wandb"],
        "Box2D": ["train", "LunarLander-v3"], "ale_py": ["train", "ALE/Pong-v5"],
    }[missing]  # fmt: skip
    if "run" in words:
        assert train("CartPole-v1") == 0
    capsys.readouterr()
    monkeypatch.setattr("neuralq.runs.report.curves.draw_svg", draw_svg)
    imported = builtins.__import__

    def without(name: str, *given: Any, **more: Any) -> Any:
        if name.split(".")[0] == missing or (missing == "tensorboard" and name.startswith("torch.utils.tensorboard")):
            raise ImportError(f"No module named {missing!r}")
        return imported(name, *given, **more)

    for name in [name for name in sys.modules if name.split(".")[0] == missing]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr(builtins, "__import__", without)
    status = main(words)
    monkeypatch.undo()
    assert status == 1 and "pip install" in refusal(capsys)


def test_a_fault_of_ours_is_no_answer() -> None:
    def ours() -> None:
        RunConfig(seed=object())  # type: ignore[arg-type]

    assert explained(TypeError("ours")) is None
    assert explained(IllegalTurn("gnubg went 3/7")) == ["gnubg went 3/7"]
    assert explained(MemoryError()) == ["MemoryError"]
    with pytest.raises(ValueError, match="seed") as caught:
        ours()
    frame = own_frame(caught.value)
    assert frame is not None and frame.filename == __file__ and "RunConfig" in (frame.line or "")
