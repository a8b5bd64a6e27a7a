"""The benchmark runs and reports; how fast is for a quiet machine to say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_bench_replay_prints_a_table_and_one_json_object() -> None:
    pytest.importorskip("stable_baselines3", reason="the bench extra is not installed")
    command = [sys.executable, "scripts/bench_replay.py", "--capacity=100", "--rounds=1", "--seconds=0.001", "--json"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "envs")))}
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True, timeout=120)
    results = json.loads(ran.stdout.splitlines()[-1])
    assert set(results) == {"4 x float32", "84x84x4 uint8"}
    assert all(x["ratio"] > 0 for rows in results.values() for x in rows.values())
