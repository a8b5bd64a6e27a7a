"""A trained agent: a representation, how observations reach it, and what its values mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from neuralq.runs.stream import Normalisation, ObservationSpec
from neuralq.runs.stream.acting import choose_greedy
from neuralq.runs.stream.encoding import Encoder
from neuralq.types import Array, QFunction

__all__ = ["Agent"]


class Agent:
    """Acts greedily and tells what it expects.

    Args:
        q: the representation.
        encoder: from the environment's observations to arrays.
        spec: shape and kind of the encoded observations.
        first_action: smallest action of the environment (0 unless its space starts elsewhere).
        reward_scale: by which rewards were multiplied for learning; values are given in the environment's units.
        normalisation: through which observations were seen, frozen.
    """

    def __init__(
        self,
        q: QFunction,
        encoder: Encoder,
        spec: ObservationSpec,
        first_action: int = 0,
        reward_scale: float = 1.0,
        normalisation: Normalisation | None = None,
    ) -> None:
        self.q = q
        self.encoder = encoder
        self.spec = spec
        self.first_action = first_action
        self.reward_scale = reward_scale
        self.normalisation = normalisation

    def values(self, observation: Any, action_mask: Any = None) -> Array:
        """Action values of one observation, in units of the environment's return.

        Args:
            observation: as the environment gives it, not batched.
            action_mask: which actions are legal ``[A]``; all of them where it is left out.

        Returns:
            ``[A]`` float64, −∞ for illegal actions.

        Raises:
            ValueError: if the observation or the mask is not what the environment's spaces promise.
        """
        mask = np.ones(self.spec.num_actions, bool) if action_mask is None else np.asarray(action_mask) != 0
        if mask.shape != (self.spec.num_actions,):
            raise ValueError(f"action_mask must have {self.spec.num_actions} entries, got shape {mask.shape}")
        encoded = np.asarray(self.encoder.encode_single(observation))[None]
        if self.normalisation is not None:
            encoded = self.normalisation.observe(encoded)
        if self.spec.masked:
            flat = np.concatenate([encoded.reshape(1, -1), mask.reshape(1, -1)], axis=1)
            encoded = flat.astype(self.spec.dtype)
        device = next(iter(self.q.parameters())).device  # type: ignore[attr-defined]
        with torch.no_grad():
            q = self.q.all(torch.from_numpy(encoded).to(device))[0]
        values = q.cpu().numpy().astype(np.float64) / self.reward_scale
        return np.where(mask, values, -np.inf)

    def predict(self, observation: Any, action_mask: Any = None) -> int:
        """The greedy action for one observation, ready for ``env.step``.

        Arguments and errors as for `values`.
        """
        action, _ = choose_greedy(torch.from_numpy(self.values(observation, action_mask)[None]))
        return int(action[0]) + self.first_action
