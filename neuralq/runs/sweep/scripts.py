"""What to hand to somebody else's scheduler: a batch script for Slurm, a Job for Kubernetes.

Both run ``neuralq sweep DIR --index I --of N`` for every share I and leave queueing, limits and what happens to a lost
node to the scheduler. A share has one run at a time, since a node has more cores than a task may use. Nothing but the
run folders is state, so handing the file in again is the whole of recovery.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from neuralq.checks import check_whole

__all__ = ["MOST_SHARES", "REQUEUE", "kubernetes_job", "num_shares", "slurm_script"]

MOST_SHARES = 1000
"""Shares at most, where nobody says how many: Slurm's MaxArraySize is 1001 unless a site raises it."""
REQUEUE = 75
"""Exit status of a share that was asked to end before its end: to be begun again (EX_TEMPFAIL of sysexits.h)."""
_SECONDS_TO_SAVE = 120
_WATCHED = """\
# The shell hears that its time is up, the command does not: pass it on. A trap cuts "wait" short.
asked=
share=
trap 'asked=yes; [ -z "$share" ] || kill -USR1 "$share" 2>/dev/null' USR1
share_of_the_runs &
share=$!
[ -z "$asked" ] || kill -USR1 "$share"
wait "$share"
while kill -0 "$share" 2>/dev/null; do wait "$share"; done
wait "$share"
status=$?

# Killed by USR1 itself: asked before it could listen, and nothing lost.
if [ "$status" = "$work_is_left" ] || { [ -n "$asked" ] && [ "$status" = $((128 + $(kill -l USR1))) ]; }; then
  if [ "$SECONDS" -lt 30 ] && [ "${SLURM_RESTART_COUNT:-0}" -ge 3 ]; then
    echo "its time is up before it gets to work: not queued again; give sbatch a longer --time" >&2
  elif ! scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"; then
    echo "could not be queued again: what is left is done by handing this script to sbatch once more" >&2
  fi
fi
exit "$status"
"""


def num_shares(num_runs: int, asked: int | None = None) -> int:
    """Into how many shares runs are dealt: as asked for, else one each, up to `MOST_SHARES`.

    Raises:
        ValueError: if there would be a share without a run.

    Example:
        >>> num_shares(24), num_shares(1_000_000), num_shares(24, 4)
        (24, 1000, 4)
    """
    if asked is None:
        return min(num_runs, MOST_SHARES)
    check_whole("of", asked)
    if asked > num_runs:
        raise ValueError(f"of must be at most the number of runs, which is {num_runs}, got {asked}")
    return asked


def slurm_script(path: str | Path, shares: int, num_threads: int = 1, num_gpus: int = 0) -> str:
    """A script for ``sbatch``: an array with one task for each share of a sweep.

    Two minutes before its time is up a task is told so by USR1 and passes it on; what runs is saved, and the task
    queues again. It does so for that one reason only: a share that failed stays failed, and one that is finished stays
    finished. A node that is lost, and a task that is preempted, are Slurm's to replace (``--requeue``). What the site
    wants beside it (``--time``, ``--partition``, ``--mem``) goes to ``sbatch``.

    A task that is asked to end within half a minute of its beginning queues again three times, not for ever. A task is
    named by its array and its index: the last task of an array has the number of the whole array, so that its number
    alone would requeue all of them (github.com/Lightning-AI/pytorch-lightning/issues/15022).

    Args:
        path: of the sweep, where the nodes see it too.
        shares: into how many shares its runs are dealt.
        num_threads: of each run.
        num_gpus: of each task.

    Raises:
        ValueError: if the path has a line break or a quote, which no ``#SBATCH`` line can have.

    Example:
        >>> print(slurm_script("/data/a sweep", 24).partition("export")[0])
        #!/bin/bash
        #SBATCH --job-name=neuralq-sweep
        #SBATCH --array=0-23
        #SBATCH --cpus-per-task=1
        #SBATCH --requeue
        #SBATCH --signal=B:USR1@120
        #SBATCH --open-mode=append
        #SBATCH --output="/data/a sweep/slurm-%A_%a.log"
        <BLANKLINE>
    """
    folder = str(Path(path).resolve())
    if not {'"', "\\"}.isdisjoint(folder) or not folder.isprintable():
        raise ValueError(
            f"Slurm takes no path with a quote, a backslash or a line break, got {folder!r}; rename the folder"
        )
    log = folder.replace("%", "%%") + "/slurm-%A_%a.log"
    gpus = f"\n#SBATCH --gpus-per-task={num_gpus}\n#SBATCH --ntasks=1" if num_gpus else ""
    words = [sys.executable, "-m", "neuralq", "sweep", folder]
    return f"""\
#!/bin/bash
#SBATCH --job-name=neuralq-sweep
#SBATCH --array=0-{shares - 1}
#SBATCH --cpus-per-task={num_threads}{gpus}
#SBATCH --requeue
#SBATCH --signal=B:USR1@{_SECONDS_TO_SAVE}
#SBATCH --open-mode=append
#SBATCH --output="{log}"

export OMP_NUM_THREADS={num_threads}
work_is_left={REQUEUE}
share_of_the_runs() {{
  exec {shlex.join(words)} --index "$SLURM_ARRAY_TASK_ID" --of {shares} --workers 1
}}
{_WATCHED}"""


def kubernetes_job(
    path: str | Path, shares: int, image: str, claim: str = "neuralq-sweeps", num_threads: int = 1, num_gpus: int = 0
) -> str:
    """A manifest for ``kubectl create -f``: an Indexed Job with one pod for each share of a sweep.

    A pod that is evicted or preempted, and one that ended with `REQUEUE`, is replaced and counts as no failure; a
    share that failed is not tried again, since its runs say why; one whose pod was killed, for memory perhaps, is tried
    three times more. Takes Kubernetes 1.31 or newer.

    Args:
        path: of the sweep. The folder of this name has to be at the root of the claim.
        shares: into how many shares its runs are dealt.
        image: container image in which ``neuralq`` is installed, with the environment's package.
        claim: name of a PersistentVolumeClaim that pods on several nodes may write to (ReadWriteMany).
        num_threads: of each run.
        num_gpus: of each pod.

    Raises:
        ValueError: if there is no image.

    Example:
        >>> job = yaml.safe_load(kubernetes_job("runs/lr", 24, "registry/neuralq:1"))
        >>> job["spec"]["completions"], job["spec"]["template"]["spec"]["containers"][0]["args"]
        (24, ['sweep', '/sweeps/lr', '--index', '$(JOB_COMPLETION_INDEX)', '--of', '24', '--workers', '1'])
    """
    if not image.strip():
        raise ValueError(
            "a Job needs the name of a container image that holds neuralq, e.g. --image registry/neuralq:1"
        )
    name = Path(path).resolve().name
    limits = {"memory": "2Gi"} | ({"nvidia.com/gpu": str(num_gpus)} if num_gpus else {})
    folder = f"/sweeps/{name}".replace("$", "$$")  # Kubernetes puts in the pod's variables for "$(X)", and $ for $$
    container = {
        "name": "share",
        "image": image,
        "command": ["neuralq"],
        "args": ["sweep", folder, "--index", "$(JOB_COMPLETION_INDEX)", "--of", str(shares), "--workers", "1"],
        "env": [{"name": "OMP_NUM_THREADS", "value": str(num_threads)}],
        "resources": {"requests": {"cpu": str(num_threads), **limits}, "limits": limits},
        "volumeMounts": [{"name": "sweeps", "mountPath": "/sweeps"}],
    }
    pod = {
        "restartPolicy": "Never",
        "terminationGracePeriodSeconds": _SECONDS_TO_SAVE,
        "containers": [container],
        "volumes": [{"name": "sweeps", "persistentVolumeClaim": {"claimName": claim}}],
    }
    head = f"# kubectl create -f THIS_FILE, when the folder {name!r} is at the root of the claim {claim!r}.\n"
    return head + str(yaml.safe_dump(_job(shares, pod), sort_keys=False, width=120))


def _job(shares: int, pod: dict[str, Any]) -> dict[str, Any]:
    rules = [
        {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]},
        {"action": "Ignore", "onExitCodes": {"operator": "In", "values": [REQUEUE]}},
        {"action": "FailIndex", "onExitCodes": {"operator": "In", "values": [1, 2]}},
    ]
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"generateName": "neuralq-sweep-"},
        "spec": {
            "completionMode": "Indexed",
            "completions": shares,
            "parallelism": shares,
            "backoffLimitPerIndex": 3,
            "podFailurePolicy": {"rules": rules},
            "template": {"spec": pod},
        },
    }
