"""Watching and filming: what is played, what is drawn, how fast, and what is said where nothing can be drawn.

Mutants that must die here: a random policy filmed · the return of another episode in the caption · frames left out
without keeping the pace · an odd side in a film · a grid blurred · a window opened where nobody can see it · a file
left after a failure · an episode that never ends.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from neuralq.apps.cli import film, main, media
from neuralq.apps.cli.film import GifWriter, Moment, caption, frame_rate, picture, play
from neuralq.runs import load
from neuralq.runs.loop import seed_for
from neuralq.runs.sweep import create_sweep

Image = pytest.importorskip("PIL.Image")

Capture = pytest.CaptureFixture[str]
SMALL = ["--preset", "false", "--total-steps", "64", "--evaluation-episodes", "1", "--evaluation-max-steps", "30"]
SMALL += ["--rollout.num-envs", "2", "--rollout.num-steps", "16"]


class Strip(gym.Env[Any, Any]):
    """A dot that moves to the right at action 1; draws itself as pixels alone, or, told so, not at all."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012
    observation_space = spaces.Discrete(5)
    action_space = spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None, is_shy: bool = False) -> None:
        self.render_mode, self.place = render_mode, 0
        if is_shy:
            self.metadata = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = 0
        return 0, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = min(4, self.place + int(action))
        return self.place, float(action), self.place == 4, False, {}

    def render(self) -> Any:
        pixels = np.zeros((3, 5, 3), np.uint8)
        pixels[:, self.place] = 255
        return pixels


class Unfinished(gym.Env[Any, Any]):
    """Draws with what is not installed."""

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012
    observation_space, action_space = Strip.observation_space, Strip.action_space

    def __init__(self, render_mode: str | None = None) -> None:
        if render_mode is not None:
            raise gym.error.DependencyNotInstalled("pygame is not installed")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return 0, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return 0, 0.0, True, False, {}


gym.register("test/Strip-v0", Strip)
gym.register("test/Unfinished-v0", Unfinished)


def trained(path: Path, env: str, *words: str) -> str:
    assert main(["train", env, *SMALL, *words, "--run-dir", str(path)]) == 0
    return str(path)


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> str:
    words = ["--layout", "table", "--gamma", "0.9", "--total-steps", "640", "--rollout.learning-rate", "0.1"]
    return trained(tmp_path_factory.mktemp("strip") / "run", "test/Strip-v0", *words)


def test_play_is_greedy_and_tells_every_moment(strip: str) -> None:
    agent, env = load(strip), gym.make("test/Strip-v0")
    moments = list(play(env, agent, 2, 0, 30))
    assert [agent.predict(s) for s in range(4)] == [1] * 4, "it has learned to go right"
    assert [(m.episode, m.step, m.episode_return, m.over) for m in moments] == [
        (episode, step, float(step), step == 4) for episode in (1, 2) for step in range(5)
    ]
    assert moments[0].value == agent.values(0).max() and math.isnan(moments[4].value)


def test_an_endless_episode_is_cut(strip: str) -> None:
    agent = load(strip)
    agent.predict = lambda *_: 0  # type: ignore[method-assign]  # stays where it is
    moments = list(play(gym.make("test/Strip-v0"), agent, 2, 0, 7))
    assert [(m.episode, m.step, m.over) for m in moments if m.over] == [(1, 7, True), (2, 7, True)]
    assert len(moments) == 16


def test_episodes_begin_as_the_seed_says(strip: str) -> None:
    class Told(Strip):
        seeds: list[int | None] = []  # noqa: RUF012

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            self.seeds.append(seed)
            return super().reset(seed=seed)

    list(play(Told(), load(strip), 2, 3, 30))
    assert Told.seeds == [seed_for(3, 10, 1), seed_for(3, 10, 2)] and Told.seeds[0] != Told.seeds[1]


def test_captions() -> None:
    assert (
        caption(Moment(2, 57, 1234567.5, -3.14159, False)) == "episode 2 · step 57 · return 1.23457e+06 · max Q -3.14"
    )
    assert caption(Moment(1, 9, -0.25, math.nan, True)) == "episode 1 · step 9 · return -0.25 · the end"


def test_small_pictures_grow_by_whole_factors_and_large_ones_shrink() -> None:
    pixels = np.zeros((3, 5, 3), np.uint8)
    pixels[:, 2] = (255, 0, 0)
    image = picture(pixels, "text", 104)
    assert image.size[0] == 100 and image.size[1] % 2 == 0  # 5 squares of 20 pixels
    colours = set(image.crop((0, 0, 100, 60)).get_flattened_data())
    assert colours == {(0, 0, 0), (255, 0, 0)}, "squares stay sharp"
    below = np.asarray(image)[60:]
    assert below.max() == 255 and below.min() < 60, "dark text on white"
    large = picture(np.zeros((401, 601, 3), np.uint8), "text", 480)
    assert large.size == (480, 350)  # 401 · 480/601 rounds to 320, and 30 for the text
    assert all(side % 2 == 0 for side in picture(np.zeros((7, 33, 3), np.uint8), "", 33).size)
    for wrong in (np.zeros((3, 5), np.uint8), np.zeros((3, 5, 3)), None):
        with pytest.raises(ValueError, match="a frame must be"):
            picture(wrong, "", 100)


@pytest.mark.parametrize(
    ("rate", "num_frames", "milliseconds"),
    [(4.0, 50, 250), (25.0, 50, 40), (50.0, 25, 40), (30.0, 25, 70), (100.0, 13, 40)],
)
def test_a_gif_keeps_the_pace(rate: float, num_frames: int, milliseconds: int, tmp_path: Path) -> None:
    writer = GifWriter(tmp_path / "x.gif", rate)
    for shade in range(50):
        writer.add(Image.fromarray(np.full((8, 8, 3), 5 * shade, np.uint8)))
    writer.close()
    with Image.open(tmp_path / "x.gif") as gif:
        # Every second frame at 30 a second: 66.7 ms, which GIF's hundredths round to 60 or 70.
        assert gif.n_frames == num_frames and abs(gif.info["duration"] - milliseconds) <= 10
        assert gif.info["loop"] == 0


def test_a_film_holds_every_step(strip: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "run.gif"
    argv = ["record", strip, "--gif", str(path), "--fps", "5", "--episodes", "2", "--width", "100", "--json"]
    assert main(argv) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["returns"] == [4.0, 4.0] and result["frames_per_second"] == 5.0
    assert result["files"] == {str(path): path.stat().st_size}
    lit = []
    with Image.open(path) as gif:
        for number in range(gif.n_frames):
            gif.seek(number)
            row = np.asarray(gif.convert("RGB"))[5, :, 0]
            lit += [int(np.flatnonzero(row > 127)[0] // 20)]
    assert lit == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4], "the end stays for a second, as one long frame"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.gif"]


def test_an_mp4_holds_every_step(strip: str, tmp_path: Path, capsys: Capture) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert main(["record", strip, "--mp4", str(tmp_path / "run.mp4"), "--fps", "10"]) == 0
    assert "returns 4\n" in capsys.readouterr().out
    num_frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "run.mp4"))
    assert num_frames == 4 + 10 and seconds == pytest.approx(1.4, abs=0.11)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mp4"]


def test_an_environment_of_gymnasiums_is_filmed(tmp_path: Path, capsys: Capture) -> None:
    pytest.importorskip("pygame")
    run = trained(tmp_path / "run", "FrozenLake-v1", "--layout", "table")
    argv = ["record", run, "--gif", str(tmp_path / "x.gif"), "--max-steps", "3", "--best", "--json"]
    capsys.readouterr()
    assert main(argv) == 0
    assert json.loads(capsys.readouterr().out)["frames_per_second"] == 4.0


def test_a_film_that_fails_leaves_no_file(strip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def render(self: Strip) -> Any:
        return np.zeros((3, 5, 3), np.uint8) if self.place < 2 else None

    monkeypatch.setattr(Strip, "render", render)
    files = ["--gif", str(tmp_path / "x.gif"), "--mp4", str(tmp_path / "x.mp4")]
    assert main(["record", strip, *files]) == 1
    assert list(tmp_path.iterdir()) == []


def test_without_a_display_text_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run = trained(tmp_path / "run", "neuralq/MitchellGrid-v0", "--layout", "table")
    monkeypatch.setattr(media, "frame_rate", lambda env: 1e6)
    capsys.readouterr()
    assert main(["watch", run, "--episodes", "2", "--max-steps", "4", "--json"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert result["mode"] == "ansi" and len(result["returns"]) == 2
    assert "episode 2 · step 0 · return 0 · max Q" in captured.err and "G" in captured.err


def test_a_window_needs_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    pytest.importorskip("pygame")
    run = trained(tmp_path / "run", "CartPole-v1", "--hidden", "4")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    capsys.readouterr()
    assert main(["watch", run]) == 1
    said = f"there is no display to open a window on; film it instead: neuralq record {run} --gif run.gif"
    assert said in capsys.readouterr().err
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # a window that nobody sees
    assert main(["watch", run, "--episodes", "1", "--max-steps", "2", "--seed", "5"]) == 0
    assert "episode 1: return 2 in 2 steps" in capsys.readouterr().out


def test_what_cannot_be_drawn_is_one_error(
    strip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    out = ["--gif", str(tmp_path / "x.gif")]
    assert main(["watch", strip]) == 1
    assert "opens no window (it draws itself as: rgb_array); film it: neuralq record" in capsys.readouterr().err
    shy = trained(tmp_path / "shy", "test/Strip-v0", "--layout", "table", "--env-kwargs", '{"is_shy": true}')
    assert main(["record", shy, *out]) == 1
    assert "cannot draw itself as rgb_array, not at all" in capsys.readouterr().err
    unfinished = trained(tmp_path / "unfinished", "test/Unfinished-v0", "--layout", "table")
    assert main(["record", unfinished, *out]) == 1
    assert 'pygame is not installed); install it with: pip install "neuralq[video]"' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["record", strip, "--mp4", str(tmp_path / "x.mp4")]) == 1
    assert "or use --gif" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert main(["record", strip, *out]) == 1
    assert "films need Pillow" in capsys.readouterr().err
    assert not (tmp_path / "x.gif").exists() and not (tmp_path / "x.mp4").exists()


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        ([], 2, "name a file: --gif FILE, --mp4 FILE or both"),
        (["--gif", "/no/where/x.gif"], 1, "there is no folder /no/where"),
        (["--gif", "x.gif", "--episodes", "0"], 2, "--episodes must be a whole number of at least 1, got 0"),
        (["--gif", "x.gif", "--max-steps", "-1"], 2, "--max-steps must be a whole number of at least 1"),
        (["--gif", "x.gif", "--fps", "0"], 2, "--fps must lie above 0"),
        (["--gif", "x.gif", "--width", "5"], 2, "--width between 16 and 4096"),
    ],
)
def test_wrong_usage(words: list[str], status: int, said: str, strip: str, capsys: Capture) -> None:
    assert main(["record", strip, *words]) == status
    assert said in capsys.readouterr().err


def test_a_sweep_is_no_run(tmp_path: Path, capsys: Capture) -> None:
    create_sweep(tmp_path / "sweep", {"total_steps": 1}, [4])
    for command in (["watch"], ["record", "--gif", "x.gif"]):
        assert main([*command, str(tmp_path / "sweep")]) == 2
        assert f"name one of them, e.g. {tmp_path}/sweep/seed-4" in capsys.readouterr().err


def test_an_environment_that_does_not_say_its_pace_gets_thirty() -> None:
    env = Strip()
    assert frame_rate(env) == 100.0
    for wrong in (None, "fast", 0, -3):
        env.metadata = {"render_fps": wrong}
        assert frame_rate(env) == 30.0
    assert film.frame_rate(gym.make("neuralq/MitchellGrid-v0")) == 4.0
