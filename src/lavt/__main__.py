"""The `lavt` command, also as `python -m lavt`."""

import os
import signal
import sys

INTERRUPTED = 130
"""The exit code after Ctrl-C: 128 + SIGINT, as shells report it."""


def main() -> None:
    """Run the command line; Ctrl-C during its import or its end ends it at once, without a traceback.

    An import can turn `KeyboardInterrupt` into another error, and the interpreter prints the one that ends its wait for
    threads. So none is raised then.
    """
    found = signal.getsignal(signal.SIGINT)
    is_default = found == signal.default_int_handler  # not in the background of a shell script, where it is ignored
    at_once = _end_at_once if is_default else found
    signal.signal(signal.SIGINT, at_once)
    _open_closed_streams()
    try:
        from lavt.cli.main import main as run  # noqa: PLC0415 (Ctrl-C during this import is handled)

        run(lambda: signal.signal(signal.SIGINT, found))
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGINT, at_once)


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed, as after `2>&-` in a shell.

    Otherwise the next file, such as a record, would get the stream's number, and the messages of libraries.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # it gets the lowest number that is free, which is this one
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))


def _end_at_once(*_: object) -> None:
    if "lavt.runtime.output" in sys.modules:
        sys.modules["lavt.runtime.output"].finish_output()
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
