"""Makes ``gymnasium.make("neuralq/...")`` work without an import of neuralq.

Gymnasium before 1.0 called the functions in the ``gymnasium.envs`` entry points when it was imported. From 1.0 on it no
longer does, and an environment's package has to be imported first. So this package brings the missing half along, for
its own environments only: ``neuralq_plugin.pth``, installed beside the package, makes the interpreter call `install`
when it starts. That puts one finder on ``sys.meta_path`` which waits for ``import gymnasium``, lets it happen as usual,
then registers, and takes itself away. The price is the import of two small files at each start of the interpreter,
about two milliseconds.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # known to type checkers; importing `typing` would cost every program more than all the rest here
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

__all__ = ["install", "register"]


def install() -> None:
    """Registers the environments once Gymnasium is imported; at once if it already is. Calling it again does nothing.

    Example:
        >>> install()
        >>> import gymnasium
        >>> "neuralq/MitchellGrid-v0" in gymnasium.registry
        True
    """
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def register() -> None:
    """Registers the environments as ``neuralq/<Name>-v<n>``; calling it again does nothing.

    A failure is a warning: a broken installation of this package must not take ``import gymnasium`` down for others.
    """
    try:
        import neuralq_envs

        neuralq_envs.register()
    except Exception as error:
        import warnings

        way_out = "reinstall it with `pip install --force-reinstall --no-deps neuralq`"
        warnings.warn(f"the environments of neuralq could not be registered: {error!r}; {way_out}", stacklevel=2)


class _AfterGymnasium:
    """A finder that finds Gymnasium where the others do, and registers when it has been executed."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec of the next finder, its loader told to register afterwards; None for every other module."""
        if name != "gymnasium":
            return None
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(name, path, target)
            if spec is not None:
                self._call_after(spec)
                return spec
        return None

    def _call_after(self, spec: ModuleSpec) -> None:
        loader = spec.loader
        if loader is None:  # a folder without __init__.py: not the package
            return
        execute = loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
                register()

        loader.exec_module = execute_and_register  # type: ignore[method-assign]
