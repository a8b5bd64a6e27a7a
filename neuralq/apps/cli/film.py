"""A trained agent at play, step by step, and films of it: pictures with a caption, written as GIF or MP4."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from neuralq.apps.cli import Failure
from neuralq.checks import MissingExtra
from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.folder.files import replacing
from neuralq.runs.loop import seed_for
from neuralq.runs.recipe.environments import make_one
from neuralq.runs.stream import faults_of, legal_actions

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["GifWriter", "Moment", "Mp4Writer", "caption", "drawn", "frame_rate", "make_shown", "picture", "play"]

_INSTALL = 'install it with: pip install "neuralq[video]"'
_MOST_GIF_FRAMES_PER_SECOND = 25  # browsers slow down what claims to be faster than 50, and every frame costs bytes


@dataclass(frozen=True)
class Moment:
    """Where a game stands.

    Args:
        episode: from 1.
        step: of the episode; 0 before the first action.
        episode_return: sum of its rewards so far.
        value: largest action value of what the agent sees; NaN once the episode is over.
        over: whether the episode has ended here.
    """

    episode: int
    step: int
    episode_return: float
    value: float
    over: bool


def make_shown(config: RunConfig, mode: str) -> gym.Env[Any, Any]:
    """One environment that draws itself.

    Raises:
        MissingExtra: if what it draws with is not installed.
        ValueError: if it cannot be made.
    """
    try:
        return make_one(config, mode)
    except ValueError as error:
        missing = error.__cause__
        if not isinstance(missing, gym.error.DependencyNotInstalled):
            raise
    raise MissingExtra(f"{config.env} cannot be drawn ({missing}); {_INSTALL}") from missing


def play(env: gym.Env[Any, Any], agent: Agent, num_episodes: int, seed: int, max_steps: int) -> Iterator[Moment]:
    """Greedy episodes, a moment after each reset and each step; an episode is cut after ``max_steps``.

    Raises:
        MissingExtra: if what the environment draws with turns out missing at its first picture.
        EnvironmentFault: if its own code fails.
    """
    for episode in range(1, num_episodes + 1):
        with _drawing("at reset"):
            observation, info = env.reset(seed=seed_for(seed, 10, episode))
        total, over, memory = 0.0, False, agent.first_memory()
        for step in range(max_steps + 1):
            with _drawing("asked for its legal actions"):
                mask = None if over else legal_actions(env, info)
            value = math.nan if over else float(np.max(agent.values(observation, mask, memory)))
            over = over or step == max_steps
            yield Moment(episode, step, total, value, over)
            if over:
                break
            action = agent.predict(observation, mask, memory)
            memory = agent.next_memory(observation, memory)
            with _drawing(f"in step {step + 1} of episode {episode}"):
                observation, reward, terminated, truncated, info = env.step(action)
                total += float(reward)
            over = terminated or truncated


def drawn(env: gym.Env[Any, Any]) -> Any:
    """What an environment draws of itself.

    Raises:
        MissingExtra: if what it draws with is not installed.
        EnvironmentFault: if it cannot.
    """
    with _drawing("drawing itself"):
        return env.render()


@contextlib.contextmanager
def _drawing(doing: str) -> Iterator[None]:
    try:
        with faults_of(doing):
            yield
    except gym.error.DependencyNotInstalled as error:
        raise MissingExtra(f"the environment cannot be drawn ({error}); {_INSTALL}") from error


def frame_rate(env: gym.Env[Any, Any]) -> float:
    """Pictures per second that the environment asks for; 30 where it does not say."""
    rate = env.metadata.get("render_fps")
    return float(rate) if isinstance(rate, int | float) and rate > 0 else 30.0


def caption(moment: Moment) -> str:
    """What stands below the picture.

    Example:
        >>> caption(Moment(1, 12, 12.0, 48.25, False))
        'episode 1 · step 12 · return 12 · max Q 48.2'
    """
    parts = [f"episode {moment.episode}", f"step {moment.step}", f"return {moment.episode_return:.6g}"]
    return " · ".join([*parts, "the end" if moment.over else f"max Q {moment.value:.3g}"])


def picture(frame: Any, text: str | None, width: int) -> Image:
    """A frame ``[H, W, 3]`` at ``width`` pixels with a caption below; both sides are even, as video wants them.

    Without a text there is no caption.

    Small pictures are enlarged by whole factors, so that the squares of a grid stay square and sharp.

    Raises:
        MissingExtra: if Pillow is not installed.
        ValueError: if the frame is no picture.
    """
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise MissingExtra(f"films need Pillow ({error}); {_INSTALL}") from error
    pixels = np.asarray(frame)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        raise ValueError(f"a frame must be [height, width, 3] of bytes, got {pixels.dtype} of shape {pixels.shape}")
    image = Image.fromarray(pixels)
    if image.width < width:
        factor = max(1, width // image.width)
        image = image.resize((image.width * factor, image.height * factor), Image.Resampling.NEAREST)
    elif image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    if text is None:
        return image
    size = max(10, min(18, image.width // 26))
    font = ImageFont.load_default(size=size)
    strip = size + 12
    canvas = Image.new("RGB", (_even(image.width), _even(image.height + strip)), "white")
    canvas.paste(image, (0, 0))
    ImageDraw.Draw(canvas).text((8, image.height + strip // 2), text, fill="black", font=font, anchor="lm")
    return canvas


def _even(length: int) -> int:
    return length + length % 2


class GifWriter:
    """Writes an endless GIF; where pictures come faster than 25 a second, some are left out and the pace is kept.

    Args:
        path: the file.
        rate: pictures per second that will be added.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self._path = path
        self._stride = math.ceil(rate / _MOST_GIF_FRAMES_PER_SECOND)
        self._milliseconds = max(20, round(1000 * self._stride / rate))
        self._count = 0
        self._images: list[Image] = []

    def add(self, image: Image) -> None:
        """One picture more."""
        if self._count % self._stride == 0:
            from PIL.Image import Dither

            self._images.append(image.quantize(colors=64, dither=Dither.NONE))
        self._count += 1

    def close(self) -> None:
        """Write the file, in one move."""
        first, *others = self._images
        with replacing(self._path) as partial:
            first.save(
                partial, format="GIF", save_all=True, append_images=others, duration=self._milliseconds, loop=0,
                optimize=False,
            )  # fmt: skip

    def discard(self) -> None:
        """Leave no file."""
        self._images.clear()


class Mp4Writer:
    """Writes an MP4 (H.264) through the ffmpeg that `imageio_ffmpeg` brings along.

    Args:
        path: the file.
        rate: pictures per second.

    Raises:
        MissingExtra: if `imageio_ffmpeg` is not installed.
    """

    def __init__(self, path: Path, rate: float) -> None:
        try:
            import imageio_ffmpeg
        except ImportError as error:
            raise MissingExtra(f"MP4 needs imageio-ffmpeg ({error}); {_INSTALL}, or use --gif") from error
        self._write_frames: Any = imageio_ffmpeg.write_frames
        self._path, self._rate = path, rate
        self._partial = path.with_name(f".partial-{secrets.token_hex(8)}.mp4")  # a name that nobody can foresee
        self._film: Any = None

    def add(self, image: Image) -> None:
        """One picture more."""
        if self._film is None:
            self._film = self._write_frames(
                str(self._partial), image.size, fps=self._rate, macro_block_size=2, ffmpeg_log_level="error"
            )
            self._film.send(None)
        self._film.send(image.tobytes())

    def close(self) -> None:
        """End the film and put it in place."""
        self._film.close()
        os.replace(self._partial, self._path)

    def discard(self) -> None:
        """Leave no file."""
        if self._film is not None:
            self._film.close()
        self._partial.unlink(missing_ok=True)


def writers_for(gif: str | None, mp4: str | None, rate: float) -> list[GifWriter | Mp4Writer]:
    """One writer for each file asked for.

    Raises:
        Failure: if none is, or the folder does not exist.
    """
    asked = [(kind, Path(name)) for kind, name in ((GifWriter, gif), (Mp4Writer, mp4)) if name is not None]
    if not asked:
        raise Failure("name a file: --gif FILE, --mp4 FILE or both", 2)
    for _, path in asked:
        if not path.absolute().parent.is_dir():
            raise Failure(f"there is no folder {path.parent}; make it first")
    return [kind(path, rate) for kind, path in asked]
