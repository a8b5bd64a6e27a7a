"""Where value functions come from, one file each, found where they stand."""

from __future__ import annotations

import importlib
import pkgutil

from neuralq.doctor.origins.record import Origin

__all__ = ["ORIGINS"]


def _discovered() -> list[Origin]:
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    return [one for module in modules for one in vars(module).values() if isinstance(one, Origin)]


ORIGINS: tuple[Origin, ...] = tuple(sorted(_discovered(), key=lambda one: one.place))
