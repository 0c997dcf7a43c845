"""`lavt can`: what is on a drive-by-wire bus, and whether a profile fits its DBC."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.dbw import load_profile, read_profile
from lavt.assembly.dbw_bus import expected_traffic, find_dbw
from lavt.assembly.dbw_check import disagreements, hindrances_on_a_real_bus
from lavt.cli import console
from lavt.cli.can_prove import prove
from lavt.cli.can_view import BusView
from lavt.clock import MachineClock
from lavt.config.dbw import DbwConfig
from lavt.config_file import parse_yaml
from lavt.domain import NS_PER_S
from lavt.errors import UserError, WorkError
from lavt.vehicle.can_frame import BusGone, ReceivedCanFrame
from lavt.vehicle.dbw.bus import CanPort, log_line, read_log
from lavt.vehicle.dbw.codec import Codec
from lavt.vehicle.dbw.traffic import BusTraffic, ExpectedMessages

TAKE_EVERY_S = 0.02

Batch = tuple[list[ReceivedCanFrame], int]
"""What was heard up to a time, ns."""

Interface = Annotated[str | None, typer.Option(help="python-can's name of the interface, such as socketcan.")]
Channel = Annotated[str | None, typer.Option(help="The interface's channel, such as can0.")]
Option = Annotated[
    list[str] | None,
    typer.Option("--option", help="Another argument of python-can's Bus: name=value, as often as needed."),
]
Dbc = Annotated[str, typer.Option(help="The vendor's DBC file, instead of the profile's.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    can = typer.Typer(no_args_is_help=True, help="Drive-by-wire buses, see docs/can.md.")
    for command in (monitor, check, prove):
        can.command(command.__name__)(command)
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
    log: Annotated[Path | None, typer.Option(help="Read this log (candump -L) instead of a bus.")] = None,
    write: Annotated[Path | None, typer.Option(help="Write what is heard to a file, as candump -L does.")] = None,
    seconds: Annotated[int | None, typer.Option(min=1, help="End after so long, not by Ctrl-C only.")] = None,
    as_json: console.Json = False,
) -> None:
    """Listen to a bus and say each second, and at the end, what is on it and what is wrong with it. Sends nothing.

    Ends with 1 if no frame came.

    Example: lavt can monitor dataspeed_gen1 --channel can0
    """
    config = _with_bus(DbwConfig() if target.endswith(".dbc") else find_dbw(target), interface, channel, option)
    if target.endswith(".dbc"):
        codec, expected = Codec(Path(target)), ExpectedMessages()
    else:
        profile = load_profile(config.profile, dbc or config.dbc)
        codec, expected = profile.codec, expected_traffic(profile)
    with ExitStack() as ends, console.until_told() as told:
        if log is None:
            port = ends.enter_context(closing(_port(config)))
            batches, dropped, to_wall_ns = _from_bus(port, told, seconds), port.counts, _from_mono_to_wall_ns()
        else:
            batches, dropped, to_wall_ns = _from_log(log), Counter[str](), 0
        write_down = ends.enter_context(_writing(write, config.channel, to_wall_ns))
        if not _show(batches, (codec, expected), dropped, write_down, as_json):
            raise WorkError(
                f"no frame came on {config.interface} {config.channel}" if log is None else f"{log} is empty"
            )


def check(
    name: Annotated[str, typer.Argument(metavar="PROFILE", help="A profile's name, or its YAML file.")],
    dbc: Dbc = "",
    as_json: console.Json = False,
) -> None:
    """Check a profile against its DBC without a car, list what is unverified, and say whether it may arm on a real bus.

    Ends with 0 where the two agree; what is unverified is no disagreement.

    Example: lavt can check dataspeed_gen1
    """
    config, codec = read_profile(name, dbc)
    found = disagreements(config, codec)
    if not found:
        try:
            profile = load_profile(name, dbc)
        except UserError as error:
            found = [str(error)]
    hindrances = [] if found else hindrances_on_a_real_bus(profile)
    unverified = () if found else profile.unverified
    against = dbc or config.dbc
    if as_json:
        console.show_json(
            {
                "profile": name,
                "dbc": against,
                "agree": not found,
                "disagreements": found,
                "unverified": unverified,
                "may_arm_on_a_real_bus": not (found or hindrances),
                "hindrances_on_a_real_bus": hindrances,
            }
        )
    for sentence in found:
        console.say(sentence)
    if found:
        raise UserError(f"{name} and {against} disagree {len(found)} times: change the profile, or name another DBC")
    if not as_json:
        _show_agreement(name, against, unverified, hindrances)


def _show_agreement(name: str, dbc: str, unverified: Sequence[str], hindrances: Sequence[str]) -> None:
    console.show(f"{name} and {dbc} agree")
    console.show(f"unverified: {len(unverified) or 'nothing'}")
    for signal in unverified:
        console.show(f"  {signal}")
    if not hindrances:
        console.show("on a real bus: may arm, once `lavt can prove` has seen its watchdog brake")
    for sentence in hindrances:
        console.show(f"on a real bus: may not arm: {sentence}")


def _show(
    batches: Iterator[Batch],
    messages: tuple[Codec, ExpectedMessages],
    dropped: Counter[str],
    write_down: Callable[[ReceivedCanFrame], None],
    as_json: bool,
) -> bool:
    """Show what is heard until there is no more; tell whether anything was."""
    first = next(batches, ([], 0))
    begin_ns = now_ns = first[1]
    traffic = BusTraffic(*messages, start_ns=begin_ns)
    view, shown_s, is_any = BusView(traffic, dropped, as_json), 0, False
    with view.showing():
        for frames, now_ns in chain([first], batches):
            is_any = is_any or bool(frames)
            for heard in frames:
                traffic.receive(heard)
                write_down(heard)
            if (now_ns - begin_ns) // NS_PER_S > shown_s:
                shown_s = (now_ns - begin_ns) // NS_PER_S
                view.second(now_ns - begin_ns, now_ns)
    view.summary(now_ns - begin_ns, now_ns)
    return is_any


def _from_bus(port: CanPort, told: console.StopEvent, seconds: int | None) -> Iterator[Batch]:
    """Take what comes on a bus until told to end, or for so long; a bus that has gone is said, and tried again."""
    clock, gone = MachineClock(), ""
    begin_ns = clock.now().mono_ns
    while not told.wait(TAKE_EVERY_S):
        now_ns = clock.now().mono_ns
        try:
            frames, why = port.take(now_ns), ""
        except BusGone as error:
            frames, why = [], str(error)
        if why != gone:
            console.say(f"lavt: {why}; it is tried again each second" if why else "lavt: the bus is back")
            gone = why
        yield frames, now_ns
        if seconds is not None and now_ns - begin_ns >= seconds * NS_PER_S:
            return


def _from_log(path: Path) -> Iterator[Batch]:
    for heard in read_log(path):
        yield [heard], heard.arrived_ns


@contextmanager
def _writing(path: Path | None, channel: str, to_wall_ns: int) -> Iterator[Callable[[ReceivedCanFrame], None]]:
    """Give what writes a frame down: into a log, or nowhere."""
    if path is None:
        yield lambda _: None
        return
    try:
        file = path.open("w", encoding="ascii")
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}): name another file") from error
    with file:
        yield lambda heard: file.writelines([log_line(heard.arrived_ns + to_wall_ns, channel, heard.frame)])


def _with_bus(config: DbwConfig, interface: str | None, channel: str | None, option: list[str] | None) -> DbwConfig:
    """A config's bus, or another as the command line has it: another interface takes none of the config's options."""
    options = {} if interface else dict(config.options)
    for each in option or ():
        name, equals, text = each.partition("=")
        if not (name and equals):
            raise UserError(f"--option {each!r} is not of the form name=value")
        options[name] = parse_yaml(text, f"--option {name}")
    return config.model_copy(
        update={
            "interface": interface or config.interface,
            "channel": channel or config.channel,
            "options": options,
        }
    )


def _port(config: DbwConfig) -> CanPort:
    if config.interface == "inside":
        raise UserError("a bus inside the server's process can be heard by nobody else: name another with --interface")
    return CanPort(config.interface, config.channel, config.options, clock=MachineClock())


def _from_mono_to_wall_ns() -> int:
    now = MachineClock().now()
    return now.wall_ns - now.mono_ns
