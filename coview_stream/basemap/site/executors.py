"""Executors of a build's steps: in this process, in other processes of this machine, or on a Dask scheduler.

All give the same results, as a step is a pure function of its arguments and of files that no other step changes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from coview_stream.errors import ConfigError, MapError, require_library

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_WORKERS = 256
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Executor:
    """Runner of one function for many items, in this process."""

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Yield the number of each item with its result or its exception, in any order."""
        for number, item in enumerate(items):
            try:
                yield number, function(item)
            except Exception as error:
                yield number, error

    def close(self) -> None:
        """End the workers."""


class ProcessExecutor(Executor):
    """Executor in ``workers`` processes of this machine, each with one thread for its libraries.

    After a process has died, its items run again one at a time; the item that kills its process gets an error.
    ConfigError if the number is out of range.
    """

    def __init__(self, workers: int) -> None:
        if not 1 <= workers <= MAX_WORKERS:
            raise ConfigError(f"workers: {workers} is out of range; use 1 to {MAX_WORKERS}")
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Yield results as they come."""
        suspects: list[int] = []
        with _one_thread():
            pool = self._pool = self._pool or self._new(self.workers)
            with _deaf_to_interrupts():
                futures: dict[Future[Any], int] = {pool.submit(function, item): k for k, item in enumerate(items)}
            try:
                for future in as_completed(futures):
                    try:
                        yield futures[future], future.result()
                    except BrokenProcessPool:
                        suspects.append(futures[future])
                    except Exception as error:
                        yield futures[future], error
            except BaseException:  # also KeyboardInterrupt: nobody uses the results
                self._pool = None
                _terminate(pool)
                raise
            if suspects:
                self.close()
            for number in sorted(suspects):
                yield number, self._alone(function, items[number])

    def _alone(self, function: Callable[[Item], Result], item: Item) -> Result | Exception:
        """Return the result of an item in a process of its own, or its error."""
        pool = self._new(1)
        try:
            with _deaf_to_interrupts():
                future = pool.submit(function, item)
            return future.result()
        except BrokenProcessPool:
            return MapError("its process died (killed, or out of memory?); fewer --workers take less")
        except Exception as error:
            return error
        finally:  # also after KeyboardInterrupt
            _terminate(pool)

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    @staticmethod
    def _new(workers: int) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


class DaskExecutor(Executor):
    """Executor on a Dask scheduler, whose workers have the same files under the same names.

    Args:
        address: ``HOST:PORT`` or ``tcp://HOST:PORT`` of a scheduler; ``local`` starts a cluster on this machine.
        workers: number in a local cluster; None lets Dask choose.

    Raises:
        DependencyError: no ``distributed``. ConfigError: the scheduler cannot be reached.
    """

    def __init__(self, address: str, workers: int | None = None) -> None:
        distributed = require_library("distributed", "distributed>=2024.5", "--dask")
        options: dict[str, Any] = {"set_as_default": False}
        if address == "local":
            options |= {"processes": True, "threads_per_worker": 1, "dashboard_address": None}
            options |= {} if workers is None else {"n_workers": workers}
        else:
            options |= {"address": address if "://" in address else f"tcp://{address}", "timeout": 10}
        try:
            with _one_thread():
                self._client = distributed.Client(**options)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--dask {address}: no scheduler answers there ({error}); start `dask scheduler`"
            ) from error
        self._as_completed = distributed.as_completed

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Yield results as they come."""
        futures = {self._client.submit(function, item, pure=False): k for k, item in enumerate(items)}
        for future in self._as_completed(list(futures), loop=self._client.loop):
            error = future.exception()
            if error is None:
                yield futures[future], future.result()
            elif isinstance(error, Exception):
                yield futures[future], error
            else:
                raise error
            future.release()

    def close(self) -> None:
        """Disconnect; a local cluster ends."""
        self._client.close()


def _terminate(pool: ProcessPoolExecutor) -> None:
    """End a pool's processes without waiting for their items."""
    for process in list((pool._processes or {}).values()):
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Let processes started in the block ignore Ctrl-C; this process gets it after the block, and ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes started in the block use one thread for their libraries, as the workers run in parallel already."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
