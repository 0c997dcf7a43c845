"""Fetch and install the user-mode kernel of Debian's next release, if it is available.

It is faster than the kernel of the host's release: since 6.16 no ptrace is needed (`seccomp=auto`). A system call takes
9 instead of 19 us, the first access to a page 21 instead of 92 us, a fork of a Python program 9 instead of 26 ms (7.2
compared with 6.1, on one processor of a virtual machine). The kernel needs the C library that it was built with. That
library, too, is newer than the host's.
"""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

SUITE = "forky"
PACKAGES = ("user-mode-linux", "libc6")
FOLDER = "newer"
SIGNED_BY = "/usr/share/keyrings/debian-archive-keyring.gpg"
LOADER = "usr/lib/x86_64-linux-gnu/ld-linux-x86-64.so.2"
KERNEL = "usr/bin/linux.uml"
PT_INTERP = 3
FIRST_HEADER_AT, COUNT_AT = 32, 56
"""Offsets in the header of an ELF64 file: position and number of the program headers (elf(5))."""
HEADER = struct.Struct("<IIQQQQQQ")
"""A program header of ELF64: type, flags, offset, virtual and physical address, sizes in file and memory, alignment."""

Apt = Callable[..., subprocess.CompletedProcess[str]]


def fetch(folder: Path, apt: Apt, options: Sequence[str]) -> str:
    """Unpack the newer kernel into `folder`; return the reason if that fails. `options` set apt's directories."""
    folder.mkdir()
    archive = _archive(folder, apt, options)
    if not archive:
        return "this machine's packages do not come from Debian's archive"
    source = folder / "source.list"
    source.write_text(f"deb [signed-by={SIGNED_BY}] {archive} {SUITE} main\n")
    restricted = (
        *options,
        f"-oDir::Etc::SourceList={source}",
        "-oDir::Etc::SourceParts=-",
        "-oAcquire::Languages=none",
    )
    for command in (("update", "-oAPT::Update::Error-Mode=any"), ("download", *PACKAGES)):
        completed = apt(folder, "apt-get", *restricted, *command)
        if completed.returncode != 0:
            return (completed.stderr.strip().splitlines() or ["apt-get gave no reason"])[-1]
    for package in sorted(folder.glob("*.deb")):
        subprocess.run(["dpkg", "-x", str(package), str(folder)], check=True)
        package.unlink()
    return ""


def _archive(folder: Path, apt: Apt, options: Sequence[str]) -> str:
    """Return the address of the archive that the host's packages come from; empty if that is not Debian's."""
    query = ("indextargets", "--format", "$(ORIGIN) $(CODENAME) $(REPO_URI)", "Identifier: Packages")
    output = apt(folder, "apt-get", *query).stdout
    if not output:  # there are no package lists yet
        apt(folder, "apt-get", *options, "update")
        output = apt(folder, "apt-get", *options, *query).stdout
    for line in output.splitlines():
        origin, codename, address = line.split(" ", 2)
        if origin == "Debian" and "-" not in codename:  # a codename with a hyphen is an archive of updates only
            return address
    return ""


def install(tools: Path, kernel: Path, libraries: Path) -> bool:
    """Install the newer kernel and its C library; return False if they were not fetched.

    The library has its own loader, but the kernel's program header names the host's. So the kernel is copied, and the
    header of the copy names the library's loader. (To start the kernel as `LOADER KERNEL` instead does not work: the
    kernel would take the loader's memory for its own.)
    """
    kernel_file, loader = tools / FOLDER / KERNEL, tools / FOLDER / LOADER
    if not kernel_file.is_file() or not loader.exists():
        return False
    program, loader_name = bytearray(kernel_file.read_bytes()), bytes(loader.resolve()) + b"\0"
    (first_header_at,) = struct.unpack_from("<Q", program, FIRST_HEADER_AT)
    (count,) = struct.unpack_from("<H", program, COUNT_AT)
    for offset in range(first_header_at, first_header_at + HEADER.size * count, HEADER.size):
        kind, flags, _, virtual, physical, _, _, alignment = HEADER.unpack_from(program, offset)
        if kind == PT_INTERP:
            size = len(loader_name)
            # The header's offset is that of the name, which is appended to the file.
            HEADER.pack_into(program, offset, kind, flags, len(program), virtual, physical, size, size, alignment)
    kernel.write_bytes(program + loader_name)
    kernel.chmod(0o755)
    libraries.symlink_to(loader.parent)
    return True
