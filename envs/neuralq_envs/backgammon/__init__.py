"""Backgammon for money without a cube: positions, legal turns, inputs, pictures, and environments to play in.

`Position` is the readable door. The loops of a trainer use the compiled functions of `rules` and `inputs` on arrays;
`single_agent` is a Gymnasium environment against a chosen opponent, `two_agents` PettingZoo's turn-based one.
"""

from __future__ import annotations

from neuralq_envs.backgammon.position import Position

__all__ = ["Position"]
