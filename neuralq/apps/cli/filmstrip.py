"""A few pictures of one greedy episode, for the page of a run."""

from __future__ import annotations

import io
from pathlib import Path

import gymnasium as gym

from neuralq.apps.cli.film import caption, drawn, make_shown, picture, play
from neuralq.checks import MissingExtra
from neuralq.runs.api import load
from neuralq.runs.control import last_cap
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.kinds import same_folder
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.stream import EnvironmentFault

__all__ = ["filmstrip", "filmstrip_unasked"]

_MOST_PICTURES = 8
_WIDTH = 240  # pixels


def filmstrip(run_dir: str | Path) -> list[tuple[bytes, str]]:
    """Pictures of the agent's first greedy episode at even intervals, begin and end among them, as PNG, with captions.

    Raises:
        ValueError: the environment draws no pictures.
        MissingExtra: what it draws with is not installed.
        EnvironmentFault: it fails.
    """
    config = config_from_dict(read_config(run_dir))
    with same_folder() as here:  # environments may change it
        agent, limit = load(here / run_dir), config.evaluation_max_steps or last_cap(here / run_dir)
        env = make_shown(config, "rgb_array")
        try:
            if env.render_mode != "rgb_array":
                raise ValueError(f"{config.env} draws no pictures; leave --film out")
            kept: list[tuple[int, bytes, str]] = []
            every = 1  # step between two pictures; it doubles when there are too many
            for moment in play(env, agent, 1, 0, limit):
                if moment.step % every and not moment.over:
                    continue
                if len(kept) == 2 * _MOST_PICTURES:
                    every *= 2
                    kept = [one for one in kept if one[0] % every == 0]
                    if moment.step % every and not moment.over:
                        continue
                kept.append((moment.step, _png(drawn(env)), caption(moment).partition(" · ")[2]))
        finally:
            env.close()
    chosen = sorted({round(i * (len(kept) - 1) / (_MOST_PICTURES - 1)) for i in range(_MOST_PICTURES)})
    return [kept[i][1:] for i in chosen]


def _png(frame: object) -> bytes:
    out = io.BytesIO()
    picture(frame, None, _WIDTH).quantize(colors=64).save(out, format="PNG", optimize=True)
    return out.getvalue()


def filmstrip_unasked(run_dir: str | Path) -> list[tuple[bytes, str]]:
    """The same of our own environments, which draw in milliseconds and without a library; empty for others."""
    config = config_from_dict(read_config(run_dir))
    if not config.env.startswith("neuralq/") or not getattr(config.settings, "acts", True):
        return []
    try:
        return filmstrip(run_dir)
    except (ValueError, MissingExtra, EnvironmentFault, gym.error.Error):  # a page does without
        return []
