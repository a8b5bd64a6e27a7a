"""What the lab says of networks: expected steps, tangent kernels and local verdicts."""
