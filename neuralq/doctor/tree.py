"""From measurements to causes: what is wrong first, and what follows from it.

1. Numbers that are not finite come first: nothing else can be said of them.
2. A faulty environment (E1, E3, E6) makes everything else conditional.
3. A policy that has learned (V1) and whose values are right (V2, V4) is healthy: what else is beyond its threshold is a
   vital sign and no verdict. Mistakes that can be seen in the data, the settings or the exact answer stay what they
   are, for that it went well once is luck. Values that are too low and in the right order (V6), with no mistake that
   explains them (V3), choose the same actions: they are those of a policy that explored, and a vital sign, too.
4. Else causes come before symptoms: what the weights, data and scales say, then how far values can see, then which
   mistake would make them right, and last that they are wrong.
5. Where the same settings succeed with some seeds only (X5), that is the cause, after what experiments confirm and
   unless a mistake of the environment or the data is named, which no seed explains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neuralq.doctor.findings import UNEXPLAINED, Finding

__all__ = ["decide"]

_ORDER = tuple(
    "X3 X2 X1 E1 E3 E6 R6a D1 D2 D5 E4 E5 D3a D4a D3 D4 R7 R1 V5 V3 X5 V4 V7a V2 V6a V7 V1 "
    "R3 R6 E2 V6 V3a V8 R2 R4 R5".split()
)
_CERTAIN = {"E1", "E3", "E6", "D1", "D2", "D3a", "D4a", "D5", "V7", "V7a"}
"""What stays a finding although the policy has learned and its values are right."""
_MISTAKES = {"E1", "E3", "E6", "D1", "D2", "D5"}
"""What no seed explains: they come before luck."""
_FAR_BEYOND = 1.3
"""V4 up to which right values on the average are right: a few states may be extreme; our own."""
_FAR_OFF = {"E4": 100.0, "E5": 1e4}
"""Beyond these a scale is no vital sign but a cause, where values or policy are bad; our own."""


def decide(measured: Sequence[Finding]) -> tuple[tuple[Finding, ...], str]:
    """What is flagged, the first cause first, and the answer in a sentence.

    Args:
        measured: every measurement and experiment.

    Example:
        >>> good = Finding("V1", "the policy is no better than none", "algorithm", "B", 100.0, (99.0, 101.0), 20.0)
        >>> decide([good])[1]
        'Nothing was found: the policy has learned; whether its values are right could not be measured.'
    """
    by_id = {one.id: one for one in measured}
    flagged = [_weighed(one, by_id) for one in measured if one.flagged]
    flagged.sort(key=lambda one: (one.grade == "C", one.grade != "A", _place(one, by_id)))
    return tuple(flagged), _headline(flagged, by_id)


def _is_well(by_id: Mapping[str, Finding]) -> bool:
    """Whether the policy has learned and its values are right."""
    has_learned = "V1" in by_id and not by_id["V1"].flagged
    exact = "V7" in by_id and not by_id["V7"].flagged
    right = all(not by_id[name].flagged for name in ("V2", "V7a") if name in by_id) or _only_low(by_id)
    right = right and not ("V4" in by_id and by_id["V4"].flagged and not by_id["V4"].value < _FAR_BEYOND)
    return (has_learned or exact) and right and ("V2" in by_id or exact)


def _only_low(by_id: Mapping[str, Finding]) -> bool:
    """Whether values are below the returns, and nothing else is wrong with them."""
    others = any(by_id[name].flagged for name in ("V3", "V5", "V6", "V7a") if name in by_id)
    return "V2" in by_id and by_id["V2"].flagged and by_id["V2"].value < 0 and not others


def _weighed(one: Finding, by_id: Mapping[str, Finding]) -> Finding:
    """The finding with the grade that it has beside the others."""
    well = _is_well(by_id)
    if one.id == "X5" and any(other.flagged and other.id in _MISTAKES for other in by_id.values()):
        return one.graded("B")
    if one.grade == "A":
        return one
    if one.grade == "B" and one.id == "V1" and "V7" in by_id and not by_id["V7"].flagged:
        return one.graded("C")  # exactly as good as the best, though chance is, too
    if well and one.id not in _CERTAIN:
        return one.graded("C")
    if one.id in _FAR_OFF and not well and one.value > _FAR_OFF[one.id] and _is_bad(by_id):
        return one.graded("B")
    return one


def _is_bad(by_id: Mapping[str, Finding]) -> bool:
    return any(by_id[name].flagged for name in ("V1", "V2", "V4", "V7", "V7a") if name in by_id)


def _place(one: Finding, by_id: Mapping[str, Finding]) -> int:
    if one.value != one.value:
        return 0
    if one.id == "V4" and one.value > 3 and "R1" in by_id and not by_id["R1"].flagged:
        return _ORDER.index("V5")  # far beyond any return: divergence explains what else the values say
    return _ORDER.index(one.id)


def _headline(flagged: Sequence[Finding], by_id: Mapping[str, Finding]) -> str:
    named = [one for one in flagged if one.grade in "AB"]
    if not named:
        if _is_well(by_id):
            low = "lower than what it returns, in the right order" if _only_low(by_id) else "what it returns"
            learned = f"the policy has learned, and its values are {low}"
            return f"Healthy: {learned} (if a better one exists, they do not say)."
        if "V1" in by_id and not by_id["V1"].flagged:
            return "Nothing was found: the policy has learned; whether its values are right could not be measured."
        return "Cannot tell: too little could be measured; see what was not, and why."
    first = named[0]
    if {one.id for one in named} <= UNEXPLAINED:
        return (
            f"Cannot tell the cause from measurements alone: {first.title}, and nothing measured says why "
            f"({first.id}, grade {first.grade}). Experiments would: --level experiments."
        )
    rest = " Everything else is conditional on that." if first.cause == "environment" and len(named) > 1 else ""
    return f"{first.cause.capitalize()}: {first.title} ({first.id}, grade {first.grade}).{rest}"
