"""Compiled loops, one per family of learners, and what they share.

Every loop takes ``(model, policy, table, walk, log, step_size, …, gamma, num_steps)`` and consumes ``num_steps``
transitions: of ``model``, or of ``log`` if it replays; else ``log`` says what to record. ``policy`` acts, ``step_size``
gives α by updates of a pair; ``table`` (values and visits), ``walk`` (where the agent is) and the arrays of the loop's
own arguments are changed in place. Each loop says only what it takes besides.
"""
