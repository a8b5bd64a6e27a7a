"""Learners that follow a true gradient: gradient TD (TDC, QRC, GQ) and residual gradients, on any network."""
