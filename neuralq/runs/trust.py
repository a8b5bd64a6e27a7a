"""Whether the code that a run names is code that is installed.

A configuration names modules: of an environment ("module:id"), a network body ("module:Class"), the hook of a sweep.
Whoever goes on with a run, evaluates it or watches it imports them, and so runs what is in them. With a folder from
somebody else there may have come a module, too; installed packages are at least those that were asked for.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

__all__ = ["refuse_strangers"]


def refuse_strangers(config: Mapping[str, Any], *hooks: str) -> None:
    """Nothing where every module that a configuration names belongs to an installed package; nothing is imported.

    Args:
        config: of a run, as ``config.json`` holds it.
        hooks: "module:name" of each hook.

    Raises:
        ValueError: for a module that does not, naming it.

    Example:
        >>> refuse_strangers({"env": "neuralq_envs:neuralq/MitchellGrid-v0"})
        >>> refuse_strangers({"env": "my_game:My-v0"})
        Traceback (most recent call last):
        ValueError: the run imports the module my_game (its environment), which is no installed package; ...
    """
    for what, module in _named(config, hooks):
        if not _is_installed(module.partition(".")[0]):
            raise ValueError(
                f"the run imports the module {module} (its {what}), which is no installed package; read it, and if you "
                "trust it leave --trust out"
            )


def _named(config: Mapping[str, Any], hooks: Sequence[str]) -> list[tuple[str, str]]:
    """What is imported for which part; whatever is no text is refused elsewhere."""
    body = config.get("body")
    named = {"environment": config.get("env"), "body": body.get("module") if isinstance(body, Mapping) else body}
    wrappers = [name for one in config.get("wrappers") or () for name in ([one] if isinstance(one, str) else one)]
    parts = [*named.items(), *(("wrapper", name) for name in wrappers), *(("hook", hook) for hook in hooks)]
    found = [(what, name) for what, name in parts if isinstance(name, str)]
    return [(what, name.partition(":")[0]) for what, name in found if ":" in name]


def _is_installed(module: str) -> bool:
    if module in ("neuralq", "neuralq_envs"):
        return True
    try:
        spec = find_spec(module)
    except (ImportError, ValueError, AttributeError):
        return False
    places: Sequence[str] = () if spec is None else [spec.origin or "", *(spec.submodule_search_locations or ())]
    # A file of that name in the present folder is not the package, whatever is installed beside it.
    here = Path.cwd()
    beside = any(Path(place).resolve().parent in (here, here / module) for place in places if place)
    return spec is not None and not beside and module in importlib.metadata.packages_distributions()
