"""``neuralq presets``: the tuned settings that ``neuralq train`` starts from."""

from __future__ import annotations

import difflib

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.runs import RunConfig
from neuralq.runs.recipe.presets import PRESETS
from neuralq.runs.report.page import flatten

__all__ = ["presets"]


def presets(argv: list[str]) -> int:
    """List the presets with their settings."""
    parser = command_parser(
        "presets",
        "List the tuned settings per environment and learner. `neuralq train ENV` starts from the one that fits and "
        "says so; what is set explicitly wins, and --preset false leaves it out.",
        "neuralq presets",
        "neuralq presets CartPole-v1",
    )
    parser.add_argument("env", nargs="?", metavar="ENV", help="show those of one environment")
    options = parser.parse_args(argv)
    chosen = {key: values for key, values in PRESETS.items() if options.env in (None, key[0])}
    if not chosen:
        known = sorted({env for env, _ in PRESETS})
        close = difflib.get_close_matches(options.env, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"there are presets for {', '.join(known)}"
        raise Failure(f"no preset for {options.env!r}; {hint}")
    plain = {"presets": [{"env": env, "learner": learner, "settings": s} for (env, learner), s in chosen.items()]}
    lines = []
    for (env, learner), settings in chosen.items():
        chooses = "" if learner == RunConfig.learner else f" --learner {learner}"
        lines.append(f"{env}, {learner} learner: neuralq train {env}{chooses}")
        lines += [f"    {name.rstrip('_')} = {_shown(value)}" for name, value in flatten(settings)]
    print_result(plain, options.json, lines)
    return 0


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)
