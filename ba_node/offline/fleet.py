# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the same work on many recordings: one after the other, in processes of this machine, or on a cluster of Dask.

What is done is a function of a module, and what it is given and returns are plain values: workers import it by name. A
worker that dies costs the time of what it was doing, which another one begins again.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from ba_node import __version__
from ba_node.io.bag_files import PACKED, STORAGES

# A task is begun so many times before its recording is given up: it may be what kills workers.
_TRIES = 3
_CONNECT_S = 15
_LIBRARY = "several processes and clusters need dask.distributed: pip install ba_node[fleet]"
# An interrupt ends the process at once, and leaves its semaphores to their tracker, which need not speak of it.
_QUIET = "ignore::UserWarning:multiprocessing.resource_tracker"
Task = TypeVar("Task")
Result = TypeVar("Result")


class FleetError(ValueError):
    """Workers that are not there, or a recording that cannot be fetched."""


class LostError(FleetError):
    """Work that workers die of."""


class Fleet:
    """Workers. Use it as a context manager.

    Args:
        jobs: processes on this machine, where no scheduler is named.
        scheduler: address of a Dask scheduler, as tcp://host:8786; empty for none.

    Raises:
        FleetError: dask.distributed is missing, the scheduler does not answer, or its workers have another ba_node.
    """

    def __init__(self, jobs: int = 1, scheduler: str = "") -> None:
        if jobs < 1:
            raise FleetError(f"--jobs {jobs}: expected 1 or more")
        self._jobs, self._scheduler = jobs, scheduler
        self._stack = contextlib.ExitStack()
        self.size = 1  # workers
        self.remote = bool(scheduler)
        self._executor: Executor = _Here()

    def __enter__(self) -> Fleet:
        if self.remote or self._jobs > 1:
            with contextlib.ExitStack() as stack:
                self._connect(stack)
                self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _connect(self, stack: contextlib.ExitStack) -> None:
        try:
            import dask  # noqa: PLC0415
            import distributed  # noqa: PLC0415
        except ImportError:
            raise FleetError(_LIBRARY) from None
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": _TRIES - 1}))
        cluster: Any = distributed.LocalCluster
        connect: Any = distributed.Client
        address: Any = self._scheduler
        if not self.remote:
            os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [os.environ.get("PYTHONWARNINGS"), _QUIET]))
            address = stack.enter_context(
                cluster(n_workers=self._jobs, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
            )
        try:
            client = stack.enter_context(connect(address, timeout=_CONNECT_S))
            found = set(client.run(_version).values())
        except (OSError, ValueError) as error:
            raise FleetError(f"scheduler {self._scheduler}: does not answer: {error}") from None
        except ImportError:
            raise FleetError(f"scheduler {self._scheduler}: its workers have no ba_node: install it there") from None
        if not found:
            raise FleetError(f"scheduler {self._scheduler}: it has no workers: start some, see docs/fleet.md")
        if found != {__version__}:
            raise FleetError(
                f"scheduler {self._scheduler}: its workers have ba_node {', '.join(sorted(found))}, and here it is"
                f" {__version__}: install the same"
            )
        self.size = sum(client.nthreads().values())
        self._executor = stack.enter_context(client.get_executor(pure=False))

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        """Have a worker call a function."""
        return self._executor.submit(function, *args)

    def each(
        self, function: Callable[[Task], Result], tasks: Sequence[Task], failed: Callable[[Task, str], Result]
    ) -> Iterator[tuple[int, Result]]:
        """Call a function with each task; yield number and result as they come, those of this process one by one.

        ``failed`` makes a result of a task that several workers died of.
        """
        if isinstance(self._executor, _Here):
            yield from enumerate(map(function, tasks))
            return
        futures = {self.submit(function, task): n for n, task in enumerate(tasks)}
        for future in as_completed(futures):
            number = futures.pop(future)
            try:
                yield number, result_of(future)
            except LostError as error:
                yield number, failed(tasks[number], str(error))


def result_of(future: Future[Result]) -> Result:
    """Return what a worker has returned.

    Raises:
        LostError: several workers died of it.
    """
    try:
        return future.result()
    except Exception as error:  # what a scheduler says of dead workers is of its own types
        if type(error).__module__.partition(".")[0] != "distributed":
            raise
        name = type(error).__name__
        raise LostError(f"{_TRIES} workers died of it, perhaps for want of memory ({name})") from None


class _Here(Executor):
    """Does everything at once, in this process."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:  # as an executor does
            future.set_exception(error)
        return future


def words_of(error: Exception) -> str:
    """Return in one line what is wrong."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split())


def _version() -> str:
    return __version__


def is_url(place: str) -> bool:
    """Return True for what fsspec opens: s3://bucket/name.mcap, https://..."""
    return "://" in place


def expand(places: Sequence[str]) -> list[str]:
    """Return places with the wildcards of URLs filled in, in their order.

    Raises:
        FleetError: fsspec is missing, or a URL matches nothing.
    """
    found: list[str] = []
    for place in places:
        if not (is_url(place) and "*" in place):
            found.append(place)
            continue
        with _fetching(place):
            system, path = _file_system(place)
            matches = [system.unstrip_protocol(match) for match in sorted(system.glob(path))]
        if not matches:
            raise FleetError(f"{place}: nothing is there that matches")
        found += matches
    return found


def name_of(place: str) -> str:
    """Return the last part of a path or URL, without what its kind adds."""
    name = Path(urlsplit(place).path if is_url(place) else place).resolve().name
    for end in (PACKED, *STORAGES):
        name = name.removesuffix(end)
    return name or "recording"


@contextlib.contextmanager
def fetched(place: str) -> Iterator[Path]:
    """Yield a recording as a file or folder of this machine; what was fetched goes again afterwards.

    Raises:
        FleetError: it cannot be fetched.
    """
    if not is_url(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="ba_node_") as folder:
        target = Path(folder) / Path(urlsplit(place).path).name
        with _fetching(place):
            system, path = _file_system(place)
            system.get(path, str(target), recursive=system.isdir(path))
        yield target


@contextlib.contextmanager
def delivered(place: str) -> Iterator[Path]:
    """Yield a folder to write to; where the place is a URL, its files go there at the end.

    Raises:
        FleetError: they cannot be written there.
    """
    if not is_url(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="ba_node_") as folder:
        target = Path(folder) / "out"
        yield target
        with _fetching(place):
            system, path = _file_system(place)
            system.makedirs(path, exist_ok=True)
            for file in sorted(target.rglob("*")):
                if file.is_file():
                    system.put_file(str(file), f"{path.rstrip('/')}/{file.relative_to(target)}")


def _file_system(place: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs  # noqa: PLC0415

    system, path = url_to_fs(place)
    return system, str(path)


@contextlib.contextmanager
def _fetching(place: str) -> Iterator[None]:
    """Have all that a store may raise name the place."""
    try:
        yield
    except ImportError as error:
        # fsspec itself says what else to install, for s3:// and others.
        hint = ": URLs need fsspec: pip install ba_node[fleet]" if (error.name or "").startswith("fsspec") else ""
        raise FleetError(f"{place}: {error}{hint}") from None
    except Exception as error:  # each store has errors of its own
        raise FleetError(f"{place}: {type(error).__name__}: {error}") from None
