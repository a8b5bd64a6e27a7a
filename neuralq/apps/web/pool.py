"""Worker processes that answer requests, each of which may be ended when it takes too long or nobody waits any more."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from neuralq.runs.children import python_command

__all__ = ["Busy", "Left", "Pool", "TooLong"]

_LONGEST_LINE = 2**24
_GRACE_SECONDS = 1.0  # a worker is worth its start-up time: what is nearly there may end when nobody waits
_LOOK_SECONDS = 0.2


class Busy(Exception):
    """Too many requests are waiting."""

    status = 503


class TooLong(Exception):
    """The answer was not there in time."""

    status = 504


class Left(Exception):
    """Who asked went away."""

    status = 499


class Pool:
    """At most so many workers, started when first needed and kept.

    Args:
        size: of them.
        most_waiting: requests that may wait for one.
        deadline_seconds: for one answer, from when a worker has it.

    Example:
        >>> asyncio.run(Pool(1).close())  # nothing was started
    """

    def __init__(self, size: int, *, most_waiting: int = 16, deadline_seconds: float = 60.0) -> None:
        self.deadline_seconds = deadline_seconds
        self._most_waiting = most_waiting
        self._waiting = 0
        self._free = asyncio.Semaphore(size)
        self._idle: list[asyncio.subprocess.Process] = []
        self._all: set[asyncio.subprocess.Process] = set()

    async def warm(self) -> None:
        """Start one worker before it is needed."""
        self._idle.append(await self._start())

    async def ask(
        self, kind: str, spec: Mapping[str, Any], is_gone: Callable[[], Awaitable[bool]]
    ) -> tuple[int, dict[str, Any]]:
        """The status and the answer.

        Args:
            kind: of request.
            spec: the request, checked.
            is_gone: whether who asked went away.

        Raises:
            Busy: too many wait already.
            TooLong: the deadline has passed.
            Left: who asked went away.
        """
        if self._waiting >= self._most_waiting:
            raise Busy("too many computations are waiting; try again in a moment")
        self._waiting += 1
        try:
            await self._free.acquire()
        finally:
            self._waiting -= 1
        try:
            if await is_gone():  # a newer request took its place while it waited
                raise Left("who asked went away")
            worker = self._idle.pop() if self._idle else await self._start()
            return await self._talk(worker, json.dumps([kind, spec]), is_gone)
        finally:
            self._free.release()

    async def _talk(
        self, worker: asyncio.subprocess.Process, line: str, is_gone: Callable[[], Awaitable[bool]]
    ) -> tuple[int, dict[str, Any]]:
        assert worker.stdin is not None and worker.stdout is not None
        reading = asyncio.ensure_future(worker.stdout.readline())
        try:
            worker.stdin.write(line.encode() + b"\n")
            await worker.stdin.drain()
            await self._wait(reading, is_gone)
            status, found = json.loads(reading.result())
        except BaseException:  # too late, not wanted, cancelled, or the worker died
            reading.cancel()
            self._end(worker)
            raise
        self._idle.append(worker)
        return status, found

    async def _wait(self, reading: asyncio.Future[bytes], is_gone: Callable[[], Awaitable[bool]]) -> None:
        loop = asyncio.get_running_loop()
        ends = loop.time() + self.deadline_seconds
        pause = min(_LOOK_SECONDS, self.deadline_seconds)
        while not (await asyncio.wait({reading}, timeout=pause))[0]:
            if loop.time() >= ends:
                seconds = f"{self.deadline_seconds:g} s"
                raise TooLong(f"this takes more than {seconds}; from Python it may take as long as it likes")
            if await is_gone():
                if not (await asyncio.wait({reading}, timeout=_GRACE_SECONDS))[0]:
                    raise Left("who asked went away")
                return

    async def _start(self) -> asyncio.subprocess.Process:
        worker = await asyncio.create_subprocess_exec(
            *python_command("from neuralq.apps.web.worker import main; main()"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=_LONGEST_LINE,
        )
        self._all.add(worker)
        return worker

    def _end(self, worker: asyncio.subprocess.Process) -> None:
        self._all.discard(worker)
        if worker.returncode is None:
            worker.kill()

    async def close(self) -> None:
        """End every worker."""
        workers = list(self._all)
        for worker in workers:
            self._end(worker)
        for worker in workers:
            await worker.wait()
        self._idle.clear()
