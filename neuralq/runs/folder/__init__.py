"""What a run keeps on disk: its folder, its checkpoints, and the state of its environments.

The state of an environment is a plain tree, so that a resumed run meets the very step it would have met: `env_encode`
walks an environment and its wrappers attribute by attribute, `env_restore` writes the tree into an environment that
was freshly made in the same way, and `env_probe` proves on throwaway instances that the two together are exact.
Nothing is pickled and no code is stored: functions, spaces and render windows stay those of the fresh environment.
What cannot be read or written so (a C++ simulator, a process, a lock) is named in `env_encode.NotCopyable`.

An environment may bring its own ``get_state()`` and ``set_state(state)``: they are used if the state is a mapping of
plain leaves. Its generators are restored in either case.
"""
