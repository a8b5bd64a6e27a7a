"""A process that answers one request after another, so that one that takes too long can be ended.

``python -m neuralq.apps.web.worker`` reads a request per line, ``["diagnose", {...}]``, and writes ``[status, {...}]``
in a line, with the status of HTTP that it deserves. It ends with its input, and so with the server that started it.
"""

from __future__ import annotations

import json
import signal
import sys
import traceback
import warnings
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from neuralq.apps.web.answers import answer

__all__ = ["main", "reply"]


def reply(kind: str, spec: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """The status and the answer; an error that is the request's own says what was wrong.

    Example:
        >>> spec = {"problem": "baird", "gamma": 1.0, "step_size": 0.01, "method": "td", "sampling": "expected"}
        >>> reply("run", {**spec, "options": {}, "num_steps": 10, "num_seeds": 1})[0]  # γ = 1 without end
        422
    """
    try:
        with np.errstate(all="ignore"):
            return 200, answer(kind, spec)
    except ValueError as error:  # the message says what is wrong and what to do
        return 422, {"error": str(error)}
    except (RuntimeError, ArithmeticError) as error:
        why = "with γ = 1 a world without end has no values" if spec.get("gamma") == 1 else str(error)
        return 422, {"error": f"this cannot be computed here: {why}"}
    except MemoryError:
        return 422, {"error": "the problem is too large for the memory of this machine"}
    except Exception:
        traceback.print_exc(file=sys.stderr)
        return 500, {"error": "the computation failed; the server's terminal says why"}


def main() -> None:
    """Answer until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends its workers
    warnings.simplefilter("ignore")  # overflows of what diverges
    out = sys.stdout
    sys.stdout = sys.stderr  # nothing else may come in between
    with threadpool_limits(limits=1):  # small matrices: more threads only wait for each other
        for line in sys.stdin:
            kind, spec = json.loads(line)
            print(json.dumps(reply(kind, spec), allow_nan=False), file=out, flush=True)


if __name__ == "__main__":
    main()
