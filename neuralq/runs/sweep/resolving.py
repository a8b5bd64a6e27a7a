"""What options of a sweep come to: the whole configuration of a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from neuralq.runs.kinds import KINDS
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.runs.recipe.keywords import nested, with_body
from neuralq.runs.recipe.presets import with_preset

__all__ = ["resolved"]


def resolved(base: Mapping[str, Any], options: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The whole configuration of a run, as `neuralq.runs.recipe.config.config_to_dict` writes it.

    Args:
        base: what all runs share; its ``preset`` is as for `neuralq.train`.
        options: of this run.
        seed: of this run.

    Raises:
        ValueError: for unknown names and values out of range.

    Example:
        >>> found = resolved({"env": "CartPole-v1"}, {"lambda_": 0.5}, 3)
        >>> found["rollout"]["lambda_"], found["seed"]
        (0.5, 3)
    """
    given = {**base, **options, "seed": seed}
    preset = given.pop("preset", True)
    if not given.get("env"):
        raise ValueError("a sweep needs an environment, e.g. env: CartPole-v1")
    if given["env"] in KINDS:
        raise ValueError(
            f"a sweep makes runs on environments, and {given['env']} is none; run its seeds one by one: neuralq train "
            f"{given['env']} --seed {seed}"
        )
    plain = {"env": given.pop("env")}
    if preset is False:
        config = config_from_dict(with_body(nested(plain, given)))
    else:
        config = with_preset(plain, preset=preset if isinstance(preset, str) else None, **given)
    whole: dict[str, Any] = json.loads(json.dumps(config_to_dict(config)))
    return whole
