"""The user-mode kernel and its tools, from Debian's packages: fetched once, unpacked, never installed."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.kernel.lane import newer
from tests.kernel.lane.rejection import Refusal

WANTED = (
    "user-mode-linux",
    "kmod",
    "libkmod2",
    "busybox-static",
    "iproute2",
    "iputils-ping",
    "chrony",
    "can-utils",
)
LIST = "".join(f"{package}\n" for package in (*WANTED, *(f"{each}/{newer.SUITE}" for each in newer.PACKAGES)))
"""What a directory of unpacked packages was made from."""
PROGRAMS = ("usr/bin", "usr/sbin", "bin", "sbin")
LIBRARIES = ("usr/lib/x86_64-linux-gnu", "lib/x86_64-linux-gnu")


def fetched(cache: Path) -> Path:
    """Give the directory of the unpacked packages; raises `Refusal` where they are neither there nor can be fetched."""
    tools = cache / "root"
    if (tools / "packages").is_file() and (tools / "packages").read_text() == LIST:
        return tools
    if platform.machine() != "x86_64" or not sys.platform.startswith("linux"):
        raise Refusal("the user-mode kernel runs on amd64 Linux only: use such a machine")
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        raise Refusal("the kernel comes from Debian's packages: use Debian or Ubuntu, or a container of these")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=cache) as folder:
            _fetch(Path(folder))
            shutil.rmtree(tools, ignore_errors=True)
            (Path(folder) / "root").rename(tools)
    except OSError as error:
        raise Refusal(
            f"{cache} cannot be written ({error.strerror}): name another directory with LAVT_KERNEL"
        ) from None
    return tools


def program(tools: Path, name: str) -> Path:
    """Find a program among the unpacked packages: releases of Debian differ in where it lies."""
    return next(path for folder in PROGRAMS if (path := tools / folder / name).is_file())


def search_path(tools: Path, folders: Sequence[str]) -> str:
    """Join those of the folders that the packages have, for PATH and its like."""
    return os.pathsep.join(str(tools / folder) for folder in folders if (tools / folder).is_dir())


def _fetch(folder: Path) -> None:
    """Download with the lists that this machine has or, where these do not do, with fresh ones of our own."""
    own = folder / "apt"
    (own / "lists" / "partial").mkdir(parents=True)
    (own / "archives" / "partial").mkdir(parents=True)
    patient = ("-oAPT::Sandbox::User=root", "-oAcquire::Retries=3")  # apt's own user could not write here
    fresh = (*patient, f"-oDir::State::Lists={own / 'lists'}", f"-oDir::Cache={own}")
    print("fetching a user-mode kernel and its tools from Debian's packages, once", file=sys.stderr, flush=True)
    said = _download(folder, patient)
    if said:
        _apt(folder, "apt-get", *fresh, "update")
        said = _download(folder, fresh)
    if said:
        raise Refusal(
            f"the packages cannot be fetched ({said}): connect this machine to Debian's archive and try again"
        )
    (folder / "root").mkdir()
    for package in sorted(folder.glob("*.deb")):
        subprocess.run(["dpkg", "-x", str(package), str(folder / "root")], check=True)
    why = newer.fetch(folder / "root" / newer.FOLDER, _apt, fresh)
    if why:
        print(
            f"the kernel is this release's own, slower one, as {newer.SUITE}'s cannot be had ({why}); to try again: "
            f"rm -r {folder.parent}",
            file=sys.stderr,
        )
    (folder / "root" / "packages").write_text(LIST)


def _download(folder: Path, options: Sequence[str]) -> str:
    """Download all that is wanted; tell apt's last words where that fails."""
    libraries = _missing_libraries(folder, options)
    done = _apt(folder, "apt-get", *options, "download", *WANTED, *libraries)
    return "" if done.returncode == 0 else _last_line(done.stderr)


def _missing_libraries(folder: Path, options: Sequence[str]) -> list[str]:
    """List the libraries that the packages need and this machine has not installed."""
    depends = ("--recurse", "--important", "--no-pre-depends")
    listed = _apt(folder, "apt-cache", *options, "depends", *depends, *WANTED).stdout
    libraries = set(re.findall(r"^\s*\|?Depends: (lib[^\s:]+)", listed, re.MULTILINE))
    known = _apt(folder, "dpkg-query", "-W", "-f", "${db:Status-Status} ${Package}\n").stdout.splitlines()
    installed = {line.partition(" ")[2] for line in known if line.startswith("installed ")}
    return sorted(libraries - installed - set(WANTED))


def _apt(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "LC_ALL": "C"}, capture_output=True, text=True, check=False
    )


def _last_line(said: str) -> str:
    lines = [line for line in said.splitlines() if line.startswith("E:")] or ["E: no reason given"]
    return lines[-1].removeprefix("E:").strip()
