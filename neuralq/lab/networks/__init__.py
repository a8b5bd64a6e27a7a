"""Networks in the lab: expected steps, tangent kernels and local verdicts."""
