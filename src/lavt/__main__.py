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
    try:
        from lavt.cli.main import main as run  # noqa: PLC0415 (Ctrl-C during this import is handled)

        run(lambda: signal.signal(signal.SIGINT, found))
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGINT, at_once)


def _end_at_once(*_: object) -> None:
    if "lavt.runtime.output" in sys.modules:
        sys.modules["lavt.runtime.output"].finish_output()
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
