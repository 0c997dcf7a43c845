"""The user-mode kernel and its tools from Debian's packages: fetched once and unpacked, not installed."""

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
from tests.kernel.lane.unavailable import LaneUnavailable

PACKAGES = (
    "user-mode-linux",
    "kmod",
    "libkmod2",
    "busybox-static",
    "iproute2",
    "iputils-ping",
    "chrony",
    "can-utils",
)
PACKAGE_LIST = "".join(
    f"{package}\n" for package in (*PACKAGES, *(f"{newer_package}/{newer.SUITE}" for newer_package in newer.PACKAGES))
)
"""The content of the file that names the packages from which a directory was unpacked."""
PROGRAMS = ("usr/bin", "usr/sbin", "bin", "sbin")
LIBRARIES = ("usr/lib/x86_64-linux-gnu", "lib/x86_64-linux-gnu")


def fetch_packages(cache: Path) -> Path:
    """Return the directory of the unpacked packages. Raise `LaneUnavailable` if they cannot be fetched."""
    tools = cache / "root"
    if (tools / "packages").is_file() and (tools / "packages").read_text() == PACKAGE_LIST:
        return tools
    if platform.machine() != "x86_64" or not sys.platform.startswith("linux"):
        raise LaneUnavailable("the user-mode kernel runs on amd64 Linux only: use such a machine")
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        raise LaneUnavailable("the kernel comes from Debian's packages: use Debian or Ubuntu, or a container of these")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=cache) as folder:
            _fetch(Path(folder))
            shutil.rmtree(tools, ignore_errors=True)
            (Path(folder) / "root").rename(tools)
    except OSError as error:
        raise LaneUnavailable(
            f"cannot write {cache} ({error.strerror}): name another directory with LAVT_KERNEL"
        ) from None
    return tools


def program(tools: Path, name: str) -> Path:
    """Return a program's path among the unpacked packages, which depends on Debian's release."""
    return next(path for folder in PROGRAMS if (path := tools / folder / name).is_file())


def search_path(tools: Path, folders: Sequence[str]) -> str:
    """Join the folders that exist among the unpacked packages, for variables like PATH."""
    return os.pathsep.join(str(tools / folder) for folder in folders if (tools / folder).is_dir())


def _fetch(folder: Path) -> None:
    """Download with the host's package lists or, if that fails, with fresh lists in a separate directory."""
    apt_folder = folder / "apt"
    (apt_folder / "lists" / "partial").mkdir(parents=True)
    (apt_folder / "archives" / "partial").mkdir(parents=True)
    common_options = ("-oAPT::Sandbox::User=root", "-oAcquire::Retries=3")  # apt's own user cannot write here
    fresh_lists = (*common_options, f"-oDir::State::Lists={apt_folder / 'lists'}", f"-oDir::Cache={apt_folder}")
    print("fetching a user-mode kernel and its tools from Debian's packages, once", file=sys.stderr, flush=True)
    error_text = _download(folder, common_options)
    if error_text:
        _apt(folder, "apt-get", *fresh_lists, "update")
        error_text = _download(folder, fresh_lists)
    if error_text:
        raise LaneUnavailable(
            f"cannot fetch the packages ({error_text}): connect this machine to Debian's archive and try again"
        )
    (folder / "root").mkdir()
    for package in sorted(folder.glob("*.deb")):
        subprocess.run(["dpkg", "-x", str(package), str(folder / "root")], check=True)
    reason = newer.fetch(folder / "root" / newer.FOLDER, _apt, fresh_lists)
    if reason:
        print(
            f"using this release's slower kernel, because {newer.SUITE}'s is not available ({reason}); to try again: "
            f"rm -r {folder.parent}",
            file=sys.stderr,
        )
    (folder / "root" / "packages").write_text(PACKAGE_LIST)


def _download(folder: Path, options: Sequence[str]) -> str:
    """Download all packages; return apt's last error if that fails."""
    libraries = _missing_libraries(folder, options)
    completed = _apt(folder, "apt-get", *options, "download", *PACKAGES, *libraries)
    return "" if completed.returncode == 0 else _last_line(completed.stderr)


def _missing_libraries(folder: Path, options: Sequence[str]) -> list[str]:
    """Return the libraries that the packages need and that are not installed on the host."""
    depends = ("--recurse", "--important", "--no-pre-depends")
    listed = _apt(folder, "apt-cache", *options, "depends", *depends, *PACKAGES).stdout
    libraries = set(re.findall(r"^\s*\|?Depends: (lib[^\s:]+)", listed, re.MULTILINE))
    status_lines = _apt(folder, "dpkg-query", "-W", "-f", "${db:Status-Status} ${Package}\n").stdout.splitlines()
    installed = {line.partition(" ")[2] for line in status_lines if line.startswith("installed ")}
    return sorted(libraries - installed - set(PACKAGES))


def _apt(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "LC_ALL": "C"}, capture_output=True, text=True, check=False
    )


def _last_line(error_text: str) -> str:
    lines = [line for line in error_text.splitlines() if line.startswith("E:")] or ["E: no reason given"]
    return lines[-1].removeprefix("E:").strip()
