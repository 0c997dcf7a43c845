"""Dask's workers, on this machine or on many, as those who drive the runs of a sweep."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from lavt.errors import UserError
from lavt.experiment.sweep.workers import Workers, ignore_terminal, terminal_held
from lavt.recording.provenance import provenance

LOCAL = "local"
"""Instead of an address: Dask's workers on this machine."""
CONNECT_S = 10


@contextmanager
def cluster(address: str, jobs: int | None) -> Iterator[Workers]:
    """Give the workers of the Dask scheduler at `address`, or `LOCAL` ones, `jobs` of them.

    Raises `UserError` where `jobs` are asked of a scheduler, where there is no Dask, no scheduler or no worker, or
    where a worker has other versions: the same digests are promised for equal versions only.
    """
    if address != LOCAL and jobs is not None:
        raise UserError(f"--jobs is for this machine, and {address} has the workers it has: leave --jobs away")
    dask = _dask()
    if address == LOCAL:
        jobs = jobs or os.cpu_count() or 1
        with terminal_held():
            started = dask.LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                dashboard_address=None,
                protocol="tcp",
                silence_logs=logging.CRITICAL,
            )
        with started, dask.Client(started) as client:
            client.run(ignore_terminal)
            yield _of_client(client, address)
        return
    try:
        client = dask.Client(address, timeout=CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(
            f"no Dask scheduler answers at {address} ({error}): start one with 'dask scheduler', or name another"
        ) from error
    with client:
        yield _of_client(client, address)


def check_cluster(address: str, jobs: int | None) -> None:
    """Raise the `UserError` that `cluster` would, before anything is begun."""
    if address == LOCAL:
        _dask()
    else:
        with cluster(address, jobs):
            pass


def _dask() -> Any:
    try:
        return import_module("distributed")  # an extra
    except ImportError as error:
        raise UserError(f"--cluster needs Dask ({error}): pip install 'lavt[cluster]'") from error


def _of_client(client: Any, address: str) -> Workers:
    threads: Mapping[str, int] = client.nthreads()
    if not threads:
        raise UserError(f"the Dask scheduler at {address} has no worker: start some with 'dask worker --nthreads 1'")
    crowded = [worker for worker, count in threads.items() if count != 1]
    if crowded:
        raise UserError(
            f"the Dask worker {crowded[0]} has {threads[crowded[0]]} threads, and a run takes a process of its own: "
            "start it with --nthreads 1, and --nworkers for more"
        )
    try:
        versions: Mapping[str, Mapping[str, str]] = client.run(versions_here)
    except ImportError as error:
        raise UserError(f"a Dask worker has no LAVT ({error}): install the same version there as here") from error
    for worker, there in versions.items():
        different = {name: (here, there.get(name)) for name, here in versions_here().items() if here != there.get(name)}
        if different:
            name, (here, other) = next(iter(different.items()))
            raise UserError(f"the Dask worker {worker} has {name} {other}, not {here} as here: install the same there")
    return Workers(client.get_executor(), len(threads), far=True)


def versions_here() -> dict[str, str]:
    """Give the versions of what a run's digest depends on."""
    here = provenance()
    return {**here["versions"], "python": here["machine"]["python"]}
