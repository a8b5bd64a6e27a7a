"""Processors of other kinds: what is recorded of them, and settings under which all of them calculate alike."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from neuralq.runs.folder import origin


def test_where_every_library_is_told_what_to_use_the_processor_itself_does_not_matter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+fma", "MKL_CBWR": "AVX2"}
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    found = origin._arithmetic.__wrapped__("cpu")
    assert "fma" in found["features of the processor"] or "x86" not in platform.machine()
    assert found["processor that kernels are compiled for"] == "haswell" and found["MKL_CBWR"] == "AVX2"
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    assert "features of the processor" not in origin._arithmetic.__wrapped__("cpu")


# What a run takes to be the same bits on every processor with AVX2, and FMA: see docs/scale.md.
PORTABLE = {
    **{"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "", "OPENBLAS_CORETYPE": "Haswell", "MKL_CBWR": "AVX2"},
    **{"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"},
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
}


def parameters_of(path: Path, settings: dict[str, str], *emulator: str) -> str:
    words = f"-m neuralq train CartPole-v1 --total-steps 500 --seed 3 --json --run-dir {path}".split()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **settings}
    ended = subprocess.run([*emulator, sys.executable, *words], env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return str(json.loads(ended.stdout.splitlines()[-1])["parameters_sha256"])


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings are those of x86-64")
def test_the_same_settings_give_the_same_bits_on_another_processor(tmp_path: Path) -> None:
    here = parameters_of(tmp_path / "here", PORTABLE)
    if (qemu := shutil.which("qemu-x86_64")) is None:
        pytest.skip("qemu-x86_64 (qemu-user), which emulates another processor, is not installed")
    assert parameters_of(tmp_path / "haswell", PORTABLE, qemu, "-cpu", "Haswell") == here
    words = f"-m neuralq resume {tmp_path / 'haswell'} --total-steps 600 --json".split()
    ended = subprocess.run([sys.executable, *words], env={**os.environ, **PORTABLE}, capture_output=True, text=True)
    assert ended.returncode == 0 and "same bits for certain" not in ended.stderr, ended.stderr
    assert "resumes bit-exact" in json.loads(ended.stdout.splitlines()[-1])["resumability"]
