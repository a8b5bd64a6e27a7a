"""``neuralq presets``: the tuned settings that ``neuralq train`` starts from."""

from __future__ import annotations

import difflib
from typing import Any

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.runs import RunConfig
from neuralq.runs.recipe.presets import PRESETS, REACHED
from neuralq.runs.recipe.replay_presets import AGENTS
from neuralq.runs.report.page import flatten

__all__ = ["presets"]


def presets(argv: list[str]) -> int:
    """A line for each preset, or all settings of those of one environment, or of an agent."""
    parser = command_parser(
        "presets",
        "List the tuned settings per environment and learner, and whole agents by name. `neuralq train ENV` starts "
        "from the one that fits and says so; what is set explicitly wins, --preset false leaves it out, and --preset "
        "NAME takes an agent.",
        "neuralq presets",
        "neuralq presets CartPole-v1",
        "neuralq presets rainbow",
    )
    parser.add_argument("env", nargs="?", metavar="ENV", help="show the settings of one environment, or of an agent")
    options = parser.parse_args(argv)
    known: list[dict[str, Any]] = [
        {"env": env, "learner": learner, "settings": settings, "reached": REACHED.get((env, learner))}
        for (env, learner), settings in PRESETS.items()
    ]
    agents = [
        {"agent": name, "learner": settings["learner"], "settings": settings} for name, settings in AGENTS.items()
    ]
    if options.env is None:
        print_result({"presets": [*known, *agents]}, options.json, _overview(known))
        return 0
    chosen = [one for one in [*known, *agents] if options.env in (one.get("env"), one.get("agent"))]
    if not chosen:
        names = sorted({one["env"] for one in known} | set(AGENTS))
        close = difflib.get_close_matches(options.env, names, 1)
        hint = f"did you mean {close[0]}?" if close else f"there are presets for {', '.join(names)}"
        raise Failure(f"no preset for {options.env!r}; {hint}")
    print_result({"presets": chosen}, options.json, [line for one in chosen for line in _whole(one)])
    return 0


def _overview(known: list[dict[str, Any]]) -> list[str]:
    """Environment, learner, steps, and what was measured."""
    width = max([len("environment"), *(len(one["env"]) for one in known)])
    lines = [
        f"{'environment':<{width}}  {'learner':<9}  {'steps':>9}  reaches (interquartile mean over seeds, interval)"
    ]
    envs = [one["env"] for one in known]
    for one in sorted(known, key=lambda one: envs.index(one["env"])):
        steps = one["settings"].get("total_steps", RunConfig.total_steps)
        lines.append(f"{one['env']:<{width}}  {one['learner']:<9}  {steps:>9,}  {one['reached'] or '-'}")
    agents = ", ".join(f"{name} ({settings['learner']} learner)" for name, settings in AGENTS.items())
    return [
        *lines,
        f"agents for any environment, by --preset NAME: {agents}",
        "neuralq presets ENV shows one whole; docs/benchmarks.md says how it was measured",
    ]


def _whole(one: dict[str, Any]) -> list[str]:
    """How to train with it, and every setting."""
    if "agent" in one:
        title = f"{one['agent']}: neuralq train ENV --preset {one['agent']}"
    else:
        chooses = "" if one["learner"] == RunConfig.learner else f" --learner {one['learner']}"
        env = "ENV" if one["env"] == "any" else one["env"]
        title = f"{one['env']}, {one['learner']} learner: neuralq train {env}{chooses}"
        title += f"\n    reaches {one['reached']}" if one["reached"] else ""
    return [
        *title.split("\n"),
        *(f"    {name.rstrip('_')} = {_shown(value)}" for name, value in flatten(one["settings"])),
    ]


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)
