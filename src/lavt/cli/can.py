"""`lavt can`: monitor a drive-by-wire bus, check a profile against its DBC, and test a kit's watchdog."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from lavt.assembly.dbw import find_dbw, load_profile, read_profile
from lavt.assembly.dbw_check import find_mismatches, real_bus_inhibit_reasons
from lavt.cli import console
from lavt.cli.can_test_watchdog import run_watchdog_test
from lavt.cli.can_view import BusView
from lavt.clock import MachineClock
from lavt.config.dbw import DbwConfig
from lavt.config_file import parse_yaml
from lavt.domain import NS_PER_S
from lavt.errors import UserError, WorkError
from lavt.vehicle.can_frame import BusGone, ReceivedCanFrame
from lavt.vehicle.dbw.bus import CanPort, log_line, read_log
from lavt.vehicle.dbw.codec import Codec
from lavt.vehicle.dbw.traffic import BusTraffic, ExpectedMessages, expected_traffic

POLL_PERIOD_S = 0.02

Interface = Annotated[str | None, typer.Option(help="python-can's name of the CAN interface, such as socketcan.")]
Channel = Annotated[str | None, typer.Option(help="The interface's channel, such as can0.")]
Option = Annotated[
    list[str] | None,
    typer.Option("--option", help="A further argument of python-can's Bus, as name=value; repeatable."),
]
Dbc = Annotated[str, typer.Option(help="The vendor's DBC file, to use instead of the profile's.")]


class FrameBatch(NamedTuple):
    """The frames received since the previous batch, and the time up to which they were received."""

    frames: list[ReceivedCanFrame]
    end_ns: int


def register(app: typer.Typer) -> None:
    """Add the commands."""
    can = typer.Typer(no_args_is_help=True, help="Inspect drive-by-wire CAN buses (docs/can.md).")
    can.command("monitor")(monitor)
    can.command("check")(check)
    can.command("test-watchdog")(run_watchdog_test)
    app.add_typer(can, name="can")


def monitor(
    target: Annotated[
        str,
        typer.Argument(
            metavar="CONFIG_OR_PROFILE", help="A server's config, a profile (name or YAML file), or a DBC file."
        ),
    ] = "dataspeed_gen2",
    interface: Interface = None,
    channel: Channel = None,
    option: Option = None,
    dbc: Dbc = "",
    log: Annotated[Path | None, typer.Option(help="Read a log (candump -L) instead of a bus.")] = None,
    write: Annotated[Path | None, typer.Option(help="Write the received frames to a log, as candump -L does.")] = None,
    seconds: Annotated[int | None, typer.Option(min=1, help="Stop after this time; default: on Ctrl-C.")] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Decode the messages on a CAN bus and report errors.

    The command prints the messages and their errors each second, and a summary at the end. It sends nothing. It exits
    with 1 if no frame arrived.

    Example: lavt can monitor dataspeed_gen1 --channel can0
    """
    config = _with_bus(DbwConfig() if target.endswith(".dbc") else find_dbw(target), interface, channel, option)
    if target.endswith(".dbc"):
        codec, expected = Codec(Path(target)), ExpectedMessages()
    else:
        profile = load_profile(config.profile, dbc or config.dbc)
        codec, expected = profile.codec, expected_traffic(profile)
    with ExitStack() as stack:
        if log is None:
            stop = stack.enter_context(console.stop_on_signals())
            port = stack.enter_context(closing(_open_port(config)))
            batches, drop_counts, wall_offset_ns = _read_bus(port, stop, seconds), port.counts, _wall_offset_ns()
        else:
            # A log has wall-clock times already.
            batches, drop_counts, wall_offset_ns = _read_log(log), Counter[str](), 0
        write_frame = stack.enter_context(_log_writer(write, config.channel, wall_offset_ns))
        if not _show_batches(batches, (codec, expected), drop_counts, write_frame, as_json):
            raise WorkError(
                f"no frame arrived on {config.interface} {config.channel}: is it up, and does anything send?"
                if log is None
                else f"{log} is empty: name another log"
            )


def check(
    name: Annotated[str, typer.Argument(metavar="PROFILE", help="A profile's name, or its YAML file.")],
    dbc: Dbc = "",
    as_json: console.JsonOption = False,
) -> None:
    """Check a by-wire profile against its DBC file.

    The check needs no car. It lists the mismatches, the unverified signals, and the reasons why a vehicle with this
    profile must not be armed on a real bus. The command exits with 0 if profile and DBC match; an unverified signal is
    not a mismatch.

    Example: lavt can check dataspeed_gen1
    """
    config, codec = read_profile(name, dbc)
    mismatches = find_mismatches(config, codec)
    if not mismatches:
        try:
            profile = load_profile(name, dbc)
        except UserError as error:
            mismatches = [str(error)]
    inhibit_reasons = [] if mismatches else real_bus_inhibit_reasons(profile)
    unverified = () if mismatches else profile.unverified
    dbc_name = dbc or config.dbc
    if as_json:
        console.print_json(
            {
                "profile": name,
                "dbc": dbc_name,
                "agree": not mismatches,
                "disagreements": mismatches,
                "unverified": unverified,
                "may_arm_on_a_real_bus": not (mismatches or inhibit_reasons),
                "real_bus_inhibit_reasons": inhibit_reasons,
            }
        )
    for mismatch in mismatches:
        console.print_message(mismatch)
    if mismatches:
        raise UserError(
            f"{name} and {dbc_name} have {len(mismatches)} mismatches: change the profile, or name another DBC"
        )
    if not as_json:
        _show_match(name, dbc_name, unverified, inhibit_reasons)


def _show_match(name: str, dbc: str, unverified: Sequence[str], inhibit_reasons: Sequence[str]) -> None:
    console.print_result(f"{name} and {dbc} match")
    console.print_result(f"unverified signals: {len(unverified) or 'none'}")
    for signal in unverified:
        console.print_result(f"  {signal}")
    if not inhibit_reasons:
        console.print_result("on a real bus: may arm, after `lavt can test-watchdog` has passed")
    for reason in inhibit_reasons:
        console.print_result(f"on a real bus: may not arm: {reason}")


def _show_batches(
    batches: Iterator[FrameBatch],
    codec_and_expected: tuple[Codec, ExpectedMessages],
    drop_counts: Counter[str],
    write_frame: Callable[[ReceivedCanFrame], None],
    as_json: bool,
) -> bool:
    """Show the frames of all batches, second by second and as a summary; return whether there was any frame."""
    first = next(batches, FrameBatch([], 0))
    start_ns = now_ns = first.end_ns
    traffic = BusTraffic(*codec_and_expected, start_ns=start_ns)
    view, shown_s, has_frames = BusView(traffic, drop_counts, as_json), 0, False
    with view.live_table():
        for frames, now_ns in chain([first], batches):
            has_frames = has_frames or bool(frames)
            for frame in frames:
                traffic.receive(frame)
                write_frame(frame)
            if (now_ns - start_ns) // NS_PER_S > shown_s:
                shown_s = (now_ns - start_ns) // NS_PER_S
                view.show_second(now_ns - start_ns, now_ns)
    view.show_summary(now_ns - start_ns, now_ns)
    return has_frames


def _read_bus(port: CanPort, stop: console.StopEvent, seconds: int | None) -> Iterator[FrameBatch]:
    """Yield the frames received until the stop event, or for `seconds`; report a lost bus and retry."""
    clock, reported_error = MachineClock(), ""
    start_ns = clock.now().mono_ns
    while not stop.wait(POLL_PERIOD_S):
        now_ns = clock.now().mono_ns
        try:
            frames, error = port.take(now_ns), ""
        except BusGone as bus_gone:
            frames, error = [], str(bus_gone)
        if error != reported_error:
            console.print_message(f"lavt: {error}; retrying each second" if error else "lavt: the bus is back")
            reported_error = error
        yield FrameBatch(frames, now_ns)
        if seconds is not None and now_ns - start_ns >= seconds * NS_PER_S:
            return


def _read_log(path: Path) -> Iterator[FrameBatch]:
    for frame in read_log(path):
        yield FrameBatch([frame], frame.arrived_ns)


@contextmanager
def _log_writer(path: Path | None, channel: str, wall_offset_ns: int) -> Iterator[Callable[[ReceivedCanFrame], None]]:
    """Yield a function that writes a frame to the log at `path`, with its arrival time plus `wall_offset_ns`.

    Without a path, the function does nothing.
    """
    if path is None:
        yield lambda _: None
        return
    try:
        file = path.open("w", encoding="ascii")
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}): name another file") from error
    with file:
        yield lambda received: file.writelines(
            [log_line(received.arrived_ns + wall_offset_ns, channel, received.frame)]
        )


def _with_bus(config: DbwConfig, interface: str | None, channel: str | None, option: list[str] | None) -> DbwConfig:
    """Return the config with the bus that the command line names.

    If the command line names an interface, the config's options for the bus do not apply.
    """
    options = {} if interface else dict(config.options)
    for text in option or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise UserError(f"--option {text!r} is not of the form name=value: write it as bitrate=500000")
        options[name] = parse_yaml(value, f"--option {name}")
    return config.model_copy(
        update={
            "interface": interface or config.interface,
            "channel": channel or config.channel,
            "options": options,
        }
    )


def _open_port(config: DbwConfig) -> CanPort:
    if config.interface == "inside":
        raise UserError("a bus inside the server's process cannot be reached from here: name another with --interface")
    return CanPort(config.interface, config.channel, config.options, clock=MachineClock())


def _wall_offset_ns() -> int:
    """Return the machine's wall-clock time minus its monotonic time."""
    now = MachineClock().now()
    return now.wall_ns - now.mono_ns
