"""Planning side by side with QuantEcon, pymdptoolbox and a plain C loop, one thread, on random models (Garnet).

    pip install "neuralq[bench]"
    python scripts/bench_exact.py             # seconds
    python scripts/bench_exact.py --full      # 100,000 x 4 x 8 and 1,000,000 x 4 x 5: minutes, and 2 GB of memory

prints one row for each measurement, in CPU time (rounds alternate between the programs, so that a change of the
machine's speed meets all; the median round counts, for the C loop the fastest):

* modified policy iteration to the same error, ours and QuantEcon's (and pymdptoolbox's where the model is small: its
  version makes a dense S x S matrix);
* value iteration, CPU time of a run divided by its sweeps: ours leaves out actions that cannot be the best for a while,
  QuantEcon's does not. "one full sweep" is ours over every action, beside the C loop below, compiled with cc -O3;
* the memory that a run needs beyond the model, as a share of the model's own bytes.

Measured with ``--full`` (on a machine of two cores that was busy otherwise, so the ratios say more than the times):

    modified policy iteration     ours 0.188 s    QuantEcon 0.273 s    0.69
    value iteration, per sweep    ours 64.0 ms    QuantEcon 124.9 ms   0.51
    one full sweep                ours 44.9 ms    C 58.5 ms            0.77   (0.77 to 1.6 from run to run)
    memory beyond the model       0.54 and 0.76 of the model's own bytes

``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import json
import shutil
import statistics
import subprocess
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from neuralq.exact import Solution, solve
from neuralq.exact.kernels import sweep
from neuralq.exact.problem import rows_of
from neuralq.mdp import FiniteMDP

DiscreteDP: Any = None  # without the peers only --help works
PolicyIterationModified: Any = None
if importlib.util.find_spec("quantecon") is not None and importlib.util.find_spec("mdptoolbox") is not None:
    DiscreteDP = importlib.import_module("quantecon.markov").DiscreteDP
    PolicyIterationModified = importlib.import_module("mdptoolbox.mdp").PolicyIterationModified

TOLERANCE = 1e-8
LARGEST_DENSE = 3000  # states

C_SWEEP = r"""
#include <math.h>
#include <stdint.h>
double sweep(int64_t num_states, const int64_t *starts, const int32_t *indptr, const int32_t *column,
             const double *probability, const double *reward, const double *decay, const double *v, double *better) {
    double worst = 0;
    for (int64_t s = 0; s < num_states; s++) {
        double best = -INFINITY;
        for (int64_t k = starts[s]; k < starts[s + 1]; k++) {
            double total = 0;
            for (int32_t j = indptr[k]; j < indptr[k + 1]; j++) total += probability[j] * v[column[j]];
            double q = reward[k] + decay[k] * total;
            if (q > best) best = q;
        }
        double change = fabs(best - v[s]);
        if (change > worst) worst = change;
        better[s] = best;
    }
    return worst;
}
"""


def cpu_s(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of CPU time of one call, and what it returned."""
    began = time.process_time()
    result = call()
    return time.process_time() - began, result


def alternating(calls: dict[str, Callable[[], Any]], rounds: int) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """CPU times of every call, round by round, and what the last round returned."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    results: dict[str, Any] = {}
    for _ in range(rounds):
        for name, call in calls.items():
            spent, results[name] = cpu_s(call)
            times[name].append(spent)
    return times, results


def peer(mdp: FiniteMDP, gamma: float) -> Any:
    """The same model as QuantEcon takes it."""
    return DiscreteDP(np.array(mdp.reward), sparse.csr_matrix(mdp.transition), gamma, mdp.s_tm1, mdp.a_tm1)


def toolbox(mdp: FiniteMDP, gamma: float) -> Callable[[], Any]:
    """The same model solved by pymdptoolbox."""
    transition = [sparse.csr_matrix(mdp.transition[a :: mdp.num_actions]) for a in range(mdp.num_actions)]
    reward = mdp.reward.reshape(mdp.num_states, mdp.num_actions)

    def run() -> Any:
        solver = PolicyIterationModified(transition, reward, gamma, epsilon=TOLERANCE, max_iter=10_000)
        solver.run()
        return np.array(solver.V)

    return run


def modified_policy_iteration(mdp: FiniteMDP, gamma: float, rounds: int) -> dict[str, Any]:
    """CPU seconds to the same error."""
    other = peer(mdp, gamma)
    calls: dict[str, Callable[[], Any]] = {
        "ours": lambda: solve(mdp, gamma, "modified-policy-iteration", TOLERANCE),
        "quantecon": lambda: other.modified_policy_iteration(epsilon=TOLERANCE, max_iter=10_000),
    }
    if mdp.num_states <= LARGEST_DENSE:
        calls["pymdptoolbox"] = toolbox(mdp, gamma)
    times, results = alternating(calls, rounds)
    answer: Solution = results["ours"]
    ours, quantecon = statistics.median(times["ours"]), statistics.median(times["quantecon"])
    return {
        "ours_s": ours,
        "quantecon_s": quantecon,
        "pymdptoolbox_s": statistics.median(times["pymdptoolbox"]) if "pymdptoolbox" in times else None,
        "ratio": ours / quantecon,
        "converged": answer.converged,
        "bound": answer.bound,
        "difference": float(np.abs(answer.v - results["quantecon"].v).max()),
    }


def value_iteration(mdp: FiniteMDP, gamma: float, rounds: int, sweeps: int) -> dict[str, Any]:
    """CPU milliseconds per sweep of a whole run of ours, and of ``sweeps`` sweeps of QuantEcon's, which are alike."""
    other = peer(mdp, gamma)
    times, results = alternating(
        {
            "ours": lambda: solve(mdp, gamma, "value-iteration", TOLERANCE),
            "quantecon": lambda: other.value_iteration(
                v_init=np.zeros(mdp.num_states), epsilon=1e-300, max_iter=sweeps
            ),
        },
        rounds,
    )
    answer: Solution = results["ours"]
    ours = statistics.median(times["ours"]) / answer.iterations * 1e3
    quantecon = statistics.median(times["quantecon"]) / sweeps * 1e3
    return {
        "ours_ms": ours,
        "quantecon_ms": quantecon,
        "ratio": ours / quantecon,
        "sweeps": answer.iterations,
        "converged": answer.converged,
    }


def compiled_sweep(folder: Path) -> Any:
    """The C loop, compiled with the machine's cc."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("a C compiler named cc is needed; on Debian and Ubuntu: apt install gcc")
    source, library = folder / "sweep.c", folder / "sweep.so"
    source.write_text(C_SWEEP)
    subprocess.run([compiler, "-O3", "-march=native", "-shared", "-fPIC", "-o", library, source], check=True)
    function = ctypes.CDLL(str(library)).sweep
    function.restype = ctypes.c_double
    return function


def full_sweep(mdp: FiniteMDP, gamma: float, rounds: int) -> dict[str, float]:
    """CPU milliseconds of one sweep over every action: ours, and the C loop on the same arrays."""
    rows = rows_of(mdp, gamma)
    v, better = np.random.default_rng(0).standard_normal(mdp.num_states), np.empty(mdp.num_states)
    also = np.empty(mdp.num_states)
    arrays = (mdp.row_starts, mdp.transition.indptr, mdp.transition.indices, mdp.transition.data)
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in (*arrays, mdp.reward, rows.decay, v, also)]
    with tempfile.TemporaryDirectory() as folder:
        c_sweep = compiled_sweep(Path(folder))
        calls = {
            "ours": lambda: sweep(rows, v, better, np.inf),
            "c": lambda: c_sweep(ctypes.c_int64(mdp.num_states), *pointers),
        }
        alternating(calls, 1)  # compile, and touch the pages
        times, _ = alternating(calls, rounds)
    if np.abs(better - also).max() > 1e-12:
        raise SystemExit("the C loop and our sweep disagree")
    ours, c = min(times["ours"]) * 1e3, min(times["c"]) * 1e3
    return {"ours_ms": ours, "c_ms": c, "ratio": ours / c}


def memory(mdp: FiniteMDP, gamma: float, method: str) -> dict[str, float]:
    """The most memory that a run holds at once beyond the model, in MiB and as a share of the model's bytes."""
    parts = (mdp.transition.data, mdp.transition.indices, mdp.transition.indptr, mdp.s_tm1, mdp.a_tm1, mdp.reward)
    model = sum(x.nbytes for x in (*parts, mdp.row_discount, mdp.start_distribution))
    tracemalloc.start()
    solve(mdp, gamma, method, TOLERANCE, max_iterations=50)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"model_mib": model / 2**20, "beyond_mib": peak / 2**20, "share": peak / model}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, printed line by line."""
    gamma = options.gamma
    small = FiniteMDP.garnet(200, 2, 3, seed=0)
    for method in ("modified-policy-iteration", "value-iteration"):
        solve(small, gamma, method)  # compile
    results: dict[str, Any] = {}
    mdp = FiniteMDP.garnet(options.policy_states, 4, 8, seed=0)
    results["modified policy iteration"] = x = modified_policy_iteration(mdp, gamma, options.rounds)
    also = "" if x["pymdptoolbox_s"] is None else f", pymdptoolbox {x['pymdptoolbox_s']:.3f} s"
    print(f"modified policy iteration, Garnet {mdp.num_states:,} x 4 x 8, error {TOLERANCE:g}")
    print(f"    ours {x['ours_s']:.3f} s, QuantEcon {x['quantecon_s']:.3f} s{also}: {x['ratio']:.2f} of QuantEcon's")
    results["memory, modified policy iteration"] = y = memory(mdp, gamma, "modified-policy-iteration")
    print(f"    memory beyond the model {y['beyond_mib']:.0f} MiB, {y['share']:.2f} of the model's own")
    mdp = FiniteMDP.garnet(options.sweep_states, 4, 5, seed=0)
    results["value iteration"] = x = value_iteration(mdp, gamma, options.rounds, options.sweeps)
    print(f"value iteration, Garnet {mdp.num_states:,} x 4 x 5, per sweep of a run of {x['sweeps']}")
    print(f"    ours {x['ours_ms']:.2f} ms, QuantEcon {x['quantecon_ms']:.2f} ms: {x['ratio']:.2f} of QuantEcon's")
    results["memory, value iteration"] = y = memory(mdp, gamma, "value-iteration")
    print(f"    memory beyond the model {y['beyond_mib']:.0f} MiB, {y['share']:.2f} of the model's own")
    results["one full sweep"] = z = full_sweep(mdp, gamma, 3 * options.rounds)
    print(f"    one full sweep: ours {z['ours_ms']:.2f} ms, C {z['c_ms']:.2f} ms: {z['ratio']:.2f} of C's")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy-states", type=int, default=2000, help="states of the first model (default 2,000)")
    parser.add_argument("--sweep-states", type=int, default=20_000, help="states of the second (default 20,000)")
    parser.add_argument("--full", action="store_true", help="100,000 and 1,000,000 states")
    parser.add_argument("--gamma", type=float, default=0.95, help="discount (default 0.95)")
    parser.add_argument("--rounds", type=int, default=5, help="alternating rounds (default 5)")
    parser.add_argument("--sweeps", type=int, default=20, help="sweeps of QuantEcon's value iteration (default 20)")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    if DiscreteDP is None:
        raise SystemExit('QuantEcon and pymdptoolbox are needed beside ours; run: pip install "neuralq[bench]"')
    if options.full:
        options.policy_states, options.sweep_states = 100_000, 1_000_000
    results = measure(options)
    if options.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
