"""The doctor: why a value function is bad, shown by measurement, for agents of any origin.

    examine(subject, env)    every measurement that its origin, the environment and the data allow, and a decision
    load_subject(given)      the value function in a file or in memory; no code in a file is ever run
    hidden_state(env)        whether observations hide part of the state, before anything is trained
    VitalSigns               a hook that does the cheap part while a run trains

docs/doctor.md says what is measured, where thresholds come from, and how far findings can be trusted.
"""

from __future__ import annotations

from neuralq.doctor.examination import examine
from neuralq.doctor.findings import Finding
from neuralq.doctor.hidden import HiddenState, hidden_state
from neuralq.doctor.loading import load_subject
from neuralq.doctor.report import Report
from neuralq.doctor.subject import Settings, Subject
from neuralq.doctor.vital_signs import VitalSigns
from neuralq.doctor.weights import CannotLoad

__all__ = [
    "CannotLoad",
    "Finding",
    "HiddenState",
    "Report",
    "Settings",
    "Subject",
    "VitalSigns",
    "examine",
    "hidden_state",
    "load_subject",
]
