"""A program that makes a joystick appear to other programs, by umockdev; it must run with umockdev's preload library.

It prints the directory of its devices, which other programs need as UMOCKDEV_DIR. Then it executes the lines that it
reads, and prints "done" after each: `plug`, `unplug`, `button NUMBER VALUE`, `axis NUMBER VALUE`. As with a kernel's
joystick, a plugged joystick first reports the present value of each axis and button.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import struct
import sys
from pathlib import Path

DEVICE = "/devices/pad/input/input7"
JOYSTICK = f"{DEVICE}/js0"
INPUT = """E: SUBSYSTEM=input
E: ID_INPUT=1
E: ID_INPUT_JOYSTICK=1
"""
DESCRIPTION = f"""P: {JOYSTICK}
E: DEVNAME=/dev/input/js0
E: MAJOR=13
E: MINOR=0
{INPUT}A: dev=13:0

P: {DEVICE}
{INPUT}A: name=Test pad
A: id/bustype=0003
A: id/vendor=045e
A: id/product=028e
A: id/version=0114

"""
"""A gamepad whose axes and buttons the browser knows; triggers are the axes 2 and 5."""
AXES, BUTTONS = 8, 11
REST = {("axis", 2): -32767, ("axis", 5): -32767}
BUTTON, AXIS, FIRST = 0x01, 0x02, 0x80
KINDS = {"button": BUTTON, "axis": AXIS}


def main() -> None:
    """Execute lines of commands until the end of the input."""
    library = ctypes.CDLL("libumockdev.so.0")
    library.umockdev_testbed_new.restype = ctypes.c_void_p
    library.umockdev_testbed_get_root_dir.restype = ctypes.c_char_p
    testbed = ctypes.c_void_p(library.umockdev_testbed_new())
    root = Path(library.umockdev_testbed_get_root_dir(testbed).decode())
    node, device = root / "dev" / "input" / "js0", f"/sys{JOYSTICK}".encode()
    assert library.umockdev_testbed_add_from_string(testbed, DESCRIPTION.encode(), None)
    node.parent.mkdir(parents=True)
    values = {(kind, number): 0 for kind, count in (("axis", AXES), ("button", BUTTONS)) for number in range(count)}
    values |= REST
    pipe = -1

    def write(kind: str, number: int, flag: int = 0) -> None:
        os.write(pipe, struct.pack("<IhBB", 0, values[kind, number], KINDS[kind] | flag, number))

    sys.stdout.write(f"{root}\n")
    sys.stdout.flush()
    for line in sys.stdin:
        name, *numbers = line.split()
        if name == "plug":
            os.mkfifo(node)
            pipe = os.open(node, os.O_RDWR | os.O_NONBLOCK)  # as a writer only, it would wait for the browser
            for kind, number in values:
                write(kind, number, FIRST)
            library.umockdev_testbed_uevent(testbed, device, b"add")
        elif name == "unplug":
            node.unlink()
            library.umockdev_testbed_uevent(testbed, device, b"remove")
            os.close(pipe)
            pipe = -1
        else:
            number, value = map(int, numbers)
            values[name, number] = value
            if pipe >= 0:
                write(name, number)
        sys.stdout.write("done\n")
        sys.stdout.flush()
    shutil.rmtree(root)


if __name__ == "__main__":
    main()
