"""Data sets of Minari (Younis et al., 2024), read and written; they lie where Minari keeps them."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import gymnasium as gym
import numpy as np

from neuralq.checks import MissingExtra
from neuralq.runs.offline.recorded import Recorded, recorded_from

__all__ = ["read_minari", "write_minari"]


def _minari() -> Any:
    try:
        import h5py  # noqa: F401  # Minari asks for it at its first file
        import minari
    except ImportError as error:
        raise MissingExtra('Minari is not installed; install it with: pip install "neuralq[minari]"') from error
    return minari


def read_minari(name: str) -> Recorded:
    """The data set of this id, which is on this machine.

    Raises:
        ValueError: if it is not, or holds what is no array of observations and discrete actions.
        MissingExtra: if Minari is not installed.
    """
    minari = _minari()
    try:
        episodes = list(minari.load_dataset(name).iterate_episodes())
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(
            f"cannot read Minari's data set {name!r}: {error}; minari list local names those on this machine, and "
            f"minari download {name} gets one"
        ) from error
    if not episodes or not isinstance(episodes[0].observations, np.ndarray):
        raise ValueError(f"Minari's data set {name!r} holds no episode with arrays of observations; flatten them first")
    parts = {
        "observations": [episode.observations[:-1] for episode in episodes],
        "next_observations": [episode.observations[1:] for episode in episodes],
        **{n: [getattr(e, n) for e in episodes] for n in ("actions", "rewards", "terminations", "truncations")},
    }
    arrays = {n: np.concatenate(values) for n, values in parts.items()}
    for one, episode in enumerate(episodes):  # where one was cut without a word, the next does not follow it
        end = sum(len(e.rewards) for e in episodes[: one + 1]) - 1
        arrays["truncations"][end] |= not arrays["terminations"][end]
        if isinstance(episode.infos, dict) and "probability" in episode.infos:
            parts.setdefault("probabilities", []).append(episode.infos["probability"][: len(episode.rewards)])
    if len(parts.get("probabilities", ())) == len(episodes):
        arrays["probabilities"] = np.concatenate(parts["probabilities"])
    return recorded_from(arrays)


def write_minari(name: str, data: Recorded, env: gym.Env[Any, Any], algorithm: str) -> None:
    """Make a data set of this id, with its environment.

    Args:
        name: as "cartpole/trained-v0": a name, perhaps with others before it, and a version.
        data: the steps; whole episodes with their successors.
        env: that they are of.
        algorithm: by which whoever acted had learned.

    Raises:
        ValueError: if there is one of this id, or it is no id.
        MissingExtra: if Minari is not installed.
    """
    minari = _minari()
    from minari.data_collector import EpisodeBuffer

    bounds = np.append(0, np.flatnonzero(data.ends) + 1)
    successors, mu, buffers = data.successors, data.probabilities, []
    for number, (begin, end) in enumerate(itertools.pairwise(bounds)):
        observations = np.concatenate([data.observations[begin:end], successors[end - 1 : end]])
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=list(observations),
                actions=list(data.actions[begin:end]),
                rewards=data.rewards[begin:end].tolist(),
                terminations=data.terminations[begin:end].tolist(),
                truncations=(data.truncations | data.ends & ~data.terminations)[begin:end].tolist(),
                infos=None if mu is None else {"probability": np.append(mu[begin:end], 1.0)},  # one for the last, too
            )
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nobody was named as its author
            minari.create_dataset_from_buffers(name, buffers, env=env, algorithm_name=algorithm, data_format="hdf5")
    except (ValueError, AssertionError, OSError) as error:
        raise ValueError(
            f"Minari cannot make the data set {name!r}: {error}; an id is like cartpole/trained-v0, and each can be "
            f"made once (minari delete {name} removes one)"
        ) from error
