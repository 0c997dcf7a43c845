"""Dask workers, on this machine or on many, that drive the runs of a sweep."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from lavt.errors import UserError
from lavt.experiment.sweep.worker_processes import ignore_terminal_signals, terminal_signals_blocked
from lavt.experiment.sweep.workers import Workers
from lavt.recording.provenance import provenance

LOCAL = "local"
"""The address of Dask workers on this machine."""
CONNECT_TIMEOUT_S = 10


@contextmanager
def cluster_workers(address: str, jobs: int | None) -> Iterator[Workers]:
    """Yield the workers of the Dask scheduler at `address`, or `jobs` workers on this machine for `LOCAL`.

    Raises `UserError` if `jobs` is given with a scheduler, if Dask, the scheduler or its workers are missing, or if a
    worker has other versions: digests are only reproducible with equal versions.
    """
    if address != LOCAL and jobs is not None:
        raise UserError(f"--jobs is for this machine, and {address} has its own number of workers: omit --jobs")
    dask = _import_dask()
    if address == LOCAL:
        jobs = jobs or os.cpu_count() or 1
        with terminal_signals_blocked():
            local_cluster = dask.LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                dashboard_address=None,
                protocol="tcp",
                silence_logs=logging.CRITICAL,
            )
        with local_cluster, dask.Client(local_cluster) as client:
            client.run(ignore_terminal_signals)
            yield _checked_workers(client, address)
        return
    try:
        client = dask.Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(
            f"no Dask scheduler answers at {address} ({error}): start one with 'dask scheduler', or name another"
        ) from error
    with client:
        yield _checked_workers(client, address)


def check_cluster(address: str, jobs: int | None) -> None:
    """Raise the `UserError` that `cluster_workers` would raise, before any work begins."""
    if address == LOCAL:
        _import_dask()
    else:
        with cluster_workers(address, jobs):
            pass


def _import_dask() -> Any:
    try:
        return import_module("distributed")  # an optional dependency
    except ImportError as error:
        raise UserError(f"--cluster needs Dask ({error}): pip install -e '.[cluster]' in the clone") from error


def _checked_workers(client: Any, address: str) -> Workers:
    """Return the workers of a Dask client; raise `UserError` unless all have one thread and this machine's versions."""
    threads: Mapping[str, int] = client.nthreads()
    if not threads:
        raise UserError(f"the Dask scheduler at {address} has no worker: start some with 'dask worker --nthreads 1'")
    several_threads = [worker for worker, count in threads.items() if count != 1]
    if several_threads:
        worker = several_threads[0]
        raise UserError(
            f"the Dask worker {worker} has {threads[worker]} threads, but a run needs a process of its own: "
            "start it with --nthreads 1, and --nworkers for more"
        )
    try:
        versions: Mapping[str, Mapping[str, str]] = client.run(local_versions)
    except ImportError as error:
        raise UserError(f"a Dask worker has no LAVT ({error}): install the same version there as here") from error
    for worker, remote in versions.items():
        different = {
            name: (here, remote.get(name)) for name, here in local_versions().items() if here != remote.get(name)
        }
        if different:
            name, (here, other) = next(iter(different.items()))
            raise UserError(f"the Dask worker {worker} has {name} {other}, not {here} as here: install the same there")
    return Workers(client.get_executor(), len(threads), remote=True)


def local_versions() -> dict[str, str]:
    """Return the versions on which the digest of a run depends."""
    recorded = provenance()
    return {**recorded["versions"], "python": recorded["machine"]["python"]}
