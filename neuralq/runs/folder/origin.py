"""What a checkpoint was made by: the configuration, the versions, and what else decides the bits of the arithmetic.

The same configuration ends with other bits where a BLAS library chooses another kernel, a compiler another processor's
instructions, or a library was upgraded. Parameters of another configuration are another run's. So a checkpoint knows
all of it; what differs is named, and what may not differ is refused.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import platform
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import library_versions

__all__ = ["ARITHMETIC", "compared", "flat_names", "present"]

ARITHMETIC = frozenset(("device", "engine", "threads"))
"""Fields of configurations that say how to compute, and not what."""
_VARIABLES = ("MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "NUMBA_DISABLE_JIT", "ONEDNN_MAX_CPU_ISA")
_FEATURES, _LIBC, _NUMPY = "features of the processor", "C library", "instructions of NumPy"
_SINCE = frozenset((_FEATURES, _LIBC, _NUMPY))
"""What older checkpoints did not keep: a difference to nothing is none."""
_CALCULATES = re.compile(r"avx|sse|fma|f16c|amx|xop|neon|sve|sme|fp|bf16|i8mm|dotprod")
_CHOSEN = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "MKL_CBWR", "ONEDNN_MAX_CPU_ISA")
"""Where all of these are set, nothing asks the processor for more than is kept under other names (docs/scale.md)."""


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
    import numpy as np
    import torch
    from threadpoolctl import threadpool_info

    found = {
        f"BLAS kernel of {library['internal_api']}": f"{library.get('architecture')} {library.get('version')}"
        for library in threadpool_info()
        if library["user_api"] == "blas" and "scipy.libs" not in library["filepath"]  # loaded now or later
    }
    simd: Any = np.show_config(mode="dicts")
    found[_NUMPY] = " ".join(simd.get("SIMD Extensions", {}).get("found", ()))
    found[_LIBC] = " ".join(platform.libc_ver())
    found["instructions of torch"] = torch.backends.cpu.get_cpu_capability()
    name = os.environ.get("NUMBA_CPU_NAME")
    found["processor that kernels are compiled for"] = name or llvmlite.binding.get_host_cpu_name()
    if any(name not in os.environ for name in _CHOSEN):
        with contextlib.suppress(RuntimeError):  # not to be found out
            features = llvmlite.binding.get_host_cpu_features()
            found[_FEATURES] = " ".join(sorted(n for n, has in features.items() if has and _CALCULATES.search(n)))
    if "NUMBA_CPU_FEATURES" in os.environ:
        found["features that kernels are compiled for"] = os.environ["NUMBA_CPU_FEATURES"]
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
        known = [n for n in {**then, **here} if n not in _SINCE or (n in then and n in here)]
        changed |= {n: (then.get(n), here.get(n)) for n in known if then.get(n) != here.get(n)}
    return ", ".join(_told(name, then, here) for name, (then, here) in changed.items()) or None


def _told(name: str, then: Any, here: Any) -> str:
    if name != _FEATURES:
        return f"{name} was {then} and is {here}"
    before, now = set(then.split()), set(here.split())
    told = "the run is bit-exact on processors of the kind it was on; this one "
    lacks, has = (" ".join(sorted(names)) for names in (before - now, now - before))
    return told + " and ".join(filter(None, (lacks and f"lacks {lacks}", has and f"has {has} beside")))


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
