"""The state of an environment as a plain tree, so that a resumed run meets the very step it would have met.

`encode_env` walks an environment and its wrappers attribute by attribute; `restore_env` writes the tree into an
environment that was freshly made in the same way; `is_resumable` proves on throwaway instances that the two together
are exact. Nothing is pickled and no code is stored: functions, spaces and render windows stay those of the fresh
environment. What cannot be read or written so (a C++ simulator, a process, a lock) is named in `NotCopyable`.

An environment may bring its own `get_state()` and `set_state(state)`: they are used if the state is a mapping of plain
leaves. Its generators are restored in either case.
"""

from __future__ import annotations

from neuralq.runs.folder.env_encode import NotCopyable, encode_env
from neuralq.runs.folder.env_probe import Resumability, is_resumable
from neuralq.runs.folder.env_restore import restore_env

__all__ = ["NotCopyable", "Resumability", "encode_env", "is_resumable", "restore_env"]
