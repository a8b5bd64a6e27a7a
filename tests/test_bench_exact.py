"""The benchmark runs and reports; how fast is for a quiet machine to say."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.slow
def test_bench_exact_prints_ratios_and_one_json_object() -> None:
    for package in ("quantecon", "mdptoolbox"):
        pytest.importorskip(package, reason="the bench extra is not installed")
    sizes = ["--policy-states=50", "--sweep-states=60", "--rounds=1", "--sweeps=2"]
    command = [sys.executable, "scripts/bench_exact.py", *sizes, "--json"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "envs")))}
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True, timeout=300)
    results = json.loads(ran.stdout.splitlines()[-1])
    policy, sweeps = results["modified policy iteration"], results["value iteration"]
    assert policy["converged"] and sweeps["converged"] and policy["bound"] <= 1e-8
    assert policy["difference"] <= 2e-8  # QuantEcon finds the same values
    assert all(
        results[name]["ratio"] > 0 for name in ("modified policy iteration", "value iteration", "one full sweep")
    )
    assert all(results[f"memory, {name}"]["share"] > 0 for name in ("modified policy iteration", "value iteration"))
