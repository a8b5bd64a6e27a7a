"""What a checkpoint was made by: the configuration, the versions, and what else decides the bits of the arithmetic.

The same configuration ends with other bits where a BLAS library chooses another kernel, a compiler another processor's
instructions, or a library was upgraded. Parameters of another configuration are another run's. So a checkpoint knows
all of it; what differs is named, and what may not differ is refused.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import library_versions

__all__ = ["ARITHMETIC", "compared", "flat_names", "present"]

ARITHMETIC = frozenset(("device", "engine", "threads"))
"""Fields of configurations that say how to compute, and not what."""
_VARIABLES = ("MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_DISABLE_JIT")


def present(config: Mapping[str, Any], free: Collection[str] = ()) -> dict[str, Any]:
    """What computes here and now, for a run of this configuration.

    Args:
        config: of the run.
        free: its names that do not decide what is learned, such as budgets; they are left out.

    Example:
        >>> present({"seed": 3})["config"]
        '{"seed": 3}'
    """
    return {
        "config": json.dumps({n: value for n, value in config.items() if n not in free}, sort_keys=True),
        "versions": dict(_versions()),
        "arithmetic": _arithmetic(str(config.get("device", "cpu"))),
    }


@functools.cache
def _versions() -> dict[str, str]:
    return library_versions()


@functools.cache
def _arithmetic(device: str) -> dict[str, str]:
    """What decides the bits beside versions, by name."""
    import llvmlite.binding
    import torch
    from threadpoolctl import threadpool_info

    found = {
        f"BLAS kernel of {library['internal_api']}": f"{library.get('architecture')} {library.get('version')}"
        for library in threadpool_info()
        if library["user_api"] == "blas" and "scipy.libs" not in library["filepath"]  # loaded now or later
    }
    found["instructions of torch"] = torch.backends.cpu.get_cpu_capability()
    found["processor that kernels are compiled for"] = llvmlite.binding.get_host_cpu_name()
    if device != "cpu":
        cuda = device.startswith("cuda") and torch.cuda.is_available()
        found["accelerator"] = torch.cuda.get_device_name(device) if cuda else device
    return found | {name: os.environ[name] for name in _VARIABLES if name in os.environ}


def compared(
    saved: Any, config: Mapping[str, Any], place: object, changes: Sequence[Mapping[str, Any]] = ()
) -> str | None:
    """What decides the bits and differs from when something was saved, in words; None if nothing does.

    Args:
        saved: from `present`, then; None where it was saved by a version that kept none.
        config: of the run now.
        place: what was saved, for the message.
        changes: of the run, as `neuralq.runs.folder.run_folder.read_changes` has them: what was changed on purpose.

    Raises:
        CheckpointError: if what was saved belongs to a run of another configuration, naming what differs.
    """
    if not isinstance(saved, Mapping):
        return None
    now = present(config)
    then_config, now_config = (flat_names(json.loads(str(origin["config"]))) for origin in (saved, now))
    # A name that only the present one has came with another version of the library, which has a default for it.
    differing = [n for n in then_config if now_config.get(n) != then_config[n]]
    asked = {n: new for row in changes for n, (_, new) in row["changes"].items()}
    wrong = [
        n for n in differing if n not in ARITHMETIC and not ("." in n and n in asked and asked[n] == now_config.get(n))
    ]
    if wrong:
        wrong.sort(key=lambda n: n not in now_config)
        told = ", ".join(f"{n} was {then_config[n]!r} there and is {now_config.get(n)!r} here" for n in wrong[:4])
        raise CheckpointError(
            f"{place} is of another configuration than config.json: {told}; put back what was changed, or train anew "
            "with `neuralq train --config`"
        )
    changed = {n: (then_config[n], now_config.get(n)) for n in differing if n in ARITHMETIC}
    for part in ("versions", "arithmetic"):
        then, here = dict(saved[part]), dict(now[part])
        changed |= {n: (then.get(n), here.get(n)) for n in {**then, **here} if then.get(n) != here.get(n)}
    return ", ".join(f"{name} was {then} and is {here}" for name, (then, here) in changed.items()) or None


def flat_names(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Plain values of a configuration by full name, with a dot those of a part.

    Example:
        >>> flat_names({"seed": 3, "rollout": {"num_envs": 2}})
        {'seed': 3, 'rollout.num_envs': 2}
    """
    found: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, Mapping) and value and name != "env_kwargs":  # whose names are not ours
            found |= flat_names(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found
