"""netem on an interface: applied, changed while packets are under way, verified, and taken away again.

Nothing here knows signals or globals: a long-running program may do it from any thread. Two programs, or two threads,
do one after the other what they do.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from lavt.clock import Clock, MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import LavtError, UserError, WorkError
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment, check_flows
from lavt.transport.netem.correlated_jitter import CorrelatedJitter
from lavt.transport.netem.probe import ProbeResult, judge, measure, probes
from lavt.transport.netem.state import (
    DIRECTORY,
    NO_OWNER,
    AppliedState,
    Owner,
    StateFiles,
    boot_id,
    current_process,
)
from lavt.transport.netem.tc import (
    PLACES,
    ROOT,
    Command,
    FoundFilter,
    Qdisc,
    add_filter,
    add_root,
    as_typed,
    delete_filter,
    delete_filters,
    delete_root,
    difference,
    expected_filter,
    filters,
    parse_filters,
    parse_impairment,
    parse_qdiscs,
    set_impairment,
    show_filters,
    show_qdiscs,
    uniform_table,
)
from lavt.value import value

TC_LIMIT_S: Final = 10.0
POLL_NS: Final = 10 * NS_PER_MS
AFTER_LONGEST_NS: Final = NS_PER_S
"""How much longer than the longest delay a queue is waited for."""

RunCommand = Callable[[Command], str]
"""Runs a command and gives its standard output; raises `UserError` or `WorkError`."""

NO_ROOT = "only root may change queues: run it with sudo, or use the relay, which needs no root"
NO_NETEM = (
    "this kernel has no netem, prio or u32: load them (`modprobe -a sch_netem sch_prio cls_u32`), use a kernel that "
    "has them, or use the relay, which needs none"
)
TELLING: Final = (
    ("Cannot find device", "there is no interface {interface}: `ip link` names those there are"),
    ("Operation not permitted", NO_ROOT),
    ("qdisc kind is unknown", NO_NETEM),
    ("TC classifier not found", NO_NETEM),
    ("No distribution data", "tc has no table of this distribution: install iproute2 whole, or name another"),
    ("No such file or directory", NO_NETEM),
    ("Cannot send dump request", NO_NETEM),
)
"""What tc says when it is refused, and what we say."""


def tc_environment() -> dict[str, str]:
    """Give the environment in which tc is found, and speaks English."""
    return {**os.environ, "PATH": os.environ.get("PATH", "") + ":/usr/sbin:/sbin", "LC_ALL": "C"}


def run_tc(command: Command) -> str:
    """Run a command of tc; raises `UserError` for what a user can put right, `WorkError` for everything else."""
    environment = tc_environment()
    if shutil.which("tc", path=environment["PATH"]) is None:
        raise UserError("there is no tc on this machine: install iproute2, or use the relay, which needs none")
    try:
        ended = subprocess.run(  # noqa: S603 (our own words; the interface's name is checked)
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TC_LIMIT_S,
            check=False,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
    except subprocess.TimeoutExpired as error:
        raise WorkError(f"`{as_typed(command)}` did not end within {TC_LIMIT_S:.0f} s") from error
    if ended.returncode:
        interface = command[command.index("dev") + 1]
        for part, sentence in TELLING:
            if part in ended.stderr:
                raise UserError(sentence.format(interface=interface))
        raise WorkError(f"`{as_typed(command)}` failed: {' '.join(ended.stderr.split())}")
    return ended.stdout


@value
class Verification:
    """What a verification found: `reasons` says in sentences what is not as asked, and is empty where all is."""

    reasons: list[str]
    measured: dict[str, ProbeResult]


class NetemInterface:
    """The delay of one interface. As a context it puts the interface back at its end, however it ends.

    `persistent`: what is applied outlives this process, as no program owns it. `directory` holds what is written down for a
    restart. `seed` is that of correlated jitter. Raises `UserError` for a name that no interface can have.
    """

    def __init__(
        self,
        interface: str,
        *,
        persistent: bool = False,
        directory: Path = DIRECTORY,
        run: RunCommand = run_tc,
        clock: Clock | None = None,
        seed: int = 1,
    ) -> None:
        if not re.fullmatch(r"(?!-)[^\s/]{1,15}", interface) or interface in {".", ".."}:
            raise UserError(f"{interface!r} is no name of an interface: `ip link` names those there are")
        self.interface = interface
        self._files = StateFiles(directory)
        self._tables = str(directory)
        self._owner = NO_OWNER if persistent else current_process()
        self._run = run
        self._clock = clock or MachineClock()
        self._seed = seed
        self._wander: CorrelatedJitter | None = None

    def __enter__(self) -> NetemInterface:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.clear()

    def check(self) -> list[str]:
        """Raise `UserError` where nothing could be applied; give what `restore` says."""
        said = self.restore()
        with self._files.alone():
            self._check_owner()
        return said

    def restore(self) -> list[str]:
        """Put back every interface that a process left held when it died, and say of each what was done.

        What cannot be put back is tried again the next time, but for an interface that is gone.
        """
        with self._files.alone():
            return [
                f"{each.interface} was still held ({each.description}, which has died): {self._restored(each.interface)}"
                for each in self._files.all()
                if each.is_abandoned
            ]

    def apply(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), condition: str = ""
    ) -> list[Command]:
        """Hold `flows` as their laws say, from now on; give the commands that did it.

        What is there already is changed without losing a packet, and what is no longer asked for is held no more.
        `exempt` names ports that no flow may cover. Raises `UserError` for flows that cannot be had, and for an
        interface that carries somebody else's queue, or a delay that another program of ours owns.
        """
        check_flows(flows, exempt)
        wanders = any(flow.impairment.jitter_correlation for flow in flows)
        if wanders and self._owner == NO_OWNER:
            raise UserError(
                "correlated jitter needs a program that stays: `lavt netem apply --hold`, or network.injection: netem"
            )
        self.restore()
        with self._files.alone():
            self._check_owner()
            qdiscs = self._ours_or_free(self.interface)
            if any(flow.impairment.jitter_distribution == "uniform" for flow in flows):
                self._files.write_text("uniform.dist", uniform_table())
            self._files.write(
                AppliedState(self.interface, network_namespace(), boot_id(), self._owner, condition, tuple(flows))
            )
            self._stand_still()
            ran = self._change(flows, qdiscs) if qdiscs else self._begin(flows)
            if wanders:
                self._wander = CorrelatedJitter(
                    self.interface, flows, tc_environment(), seed=self._seed, clock=self._clock
                )
            return ran

    def clear(self, *, at_once: bool = False, any_owner: bool = False) -> list[Command]:
        """Put the interface back as it was; give the commands that did it, none where nothing of this owner was there.

        What is under way is waited for, in order; lost is only what a rate has piled up beyond the longest delay and
        two seconds, and with `at_once` all of it. `any_owner` also clears
        what another program of ours owns, or was left in place; raises `UserError` for a queue that is not ours.
        """
        with self._files.alone():
            self._stand_still()
            if not any_owner and self._owner_of_what_is_there() != self._owner:
                return []
            ran = self._clear(self.interface, at_once=at_once)
            self._files.forget(self.interface)
            return ran

    def applied(self) -> AppliedState | None:
        """Tell what was applied, by whom; None where nothing was written down."""
        return self._files.read(self.interface)

    def status(self) -> dict[str, Any]:
        """Tell what is there, as it is read back: whether it is ours, and the law of each flow that has one."""
        qdiscs = parse_qdiscs(self._run(show_qdiscs(self.interface)))
        netems = {name: _netem_at(place.handle, qdiscs) for name, place in PLACES.items()}
        return {
            "interface": self.interface,
            "ours": _is_ours(qdiscs),
            "queues": [f"{each.kind} {each.handle} {each.parent}" for each in qdiscs],
            "impairments": {
                name: parse_impairment(found.options) for name, found in netems.items() if found is not None
            },
            "applied": self.applied(),
        }

    def read_back(self, flows: Sequence[ImpairedFlow]) -> list[str]:
        """Compare what tc tells with what was asked, in sentences; an empty list is as asked."""
        qdiscs = parse_qdiscs(self._run(show_qdiscs(self.interface)))
        if not _is_ours(qdiscs):
            return [f"{self.interface} has no queue of ours"]
        found = self._filters()
        wanted = {expected_filter(each) for flow in flows for each in filters(flow)}
        reasons = [reason for flow in flows for reason in difference(flow, qdiscs, found)]
        return reasons + [
            f"there is a filter that nobody asked for: {each[:3]}" for each in found if each not in wanted
        ]

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> dict[str, ProbeResult]:
        """Measure what happens to packets of each flow, and of what must not be held, on their way out."""
        return measure(self.interface, probes(flows, exempt), count=count, clock=self._clock)

    def verify(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> Verification:
        """Verify by reading back and by measuring, and tell what has stopped."""
        reasons = self.read_back(flows)
        measured = self.measure(flows, exempt=exempt, count=count)
        return Verification(reasons + self.problems() + judge(flows, exempt, measured), measured)

    def problems(self) -> list[str]:
        """Say in sentences what of ours has stopped by itself since it was applied; no program is started for it."""
        return [] if self._wander is None else self._wander.problems()

    def _restored(self, interface: str) -> str:
        """Put back what the dead left, and say what came of it."""
        became = "it is put back"
        try:
            self._clear(interface, at_once=True)
        except LavtError as error:
            if _exists(interface):
                return f"it is not put back: {error}"
            became = "the interface is gone"
        self._files.forget(interface)
        return became

    def _check_owner(self) -> None:
        """Raise `UserError` where the delay that is there belongs to another program of ours."""
        if not self._ours_or_free(self.interface):
            return
        if self._owner_of_what_is_there() != self._owner:
            there = self._files.read(self.interface)
            words = f"a delay on {self.interface}, left in place" if there is None else there.description
            raise UserError(
                f"there is {words}: clear it with `lavt netem clear --interface {self.interface}`, or let it end"
            )

    def _owner_of_what_is_there(self) -> Owner:
        there = self._files.read(self.interface)
        return NO_OWNER if there is None else there.owner  # without a file it was made by hand, with the scripts

    def _ours_or_free(self, interface: str) -> list[Qdisc]:
        """Give the queues where the root is ours, and none where it is the kernel's own.

        Raises `UserError` for a root that somebody made: one with a handle that is not ours.
        """
        qdiscs = parse_qdiscs(self._run(show_qdiscs(interface)))
        if _is_ours(qdiscs):
            return qdiscs
        for each in qdiscs:
            if each.parent == "root" and each.handle != "0:":
                raise UserError(
                    f"{interface} has a queue that is not ours ({each.kind} {each.handle}): take it away yourself "
                    f"(`tc qdisc del dev {interface} root`), or name another interface"
                )
        return []

    def _begin(self, flows: Sequence[ImpairedFlow]) -> list[Command]:
        """Hold flows on an interface that is free; where that fails it is left as it was."""
        try:
            return self._do([add_root(self.interface)]) + self._change(flows, [])
        except LavtError:
            with suppress(LavtError):
                self._do([delete_root(self.interface)])
            self._files.forget(self.interface)
            raise

    def _stand_still(self) -> None:
        """Let no delay wander any more."""
        if self._wander is not None:
            self._wander.end()
            self._wander = None

    def _change(self, flows: Sequence[ImpairedFlow], qdiscs: Sequence[Qdisc]) -> list[Command]:
        """Bring our queues from what they are to what is asked."""
        requested = {flow.name: flow for flow in flows}
        found = set(self._filters()) if qdiscs else set()
        wanted = {expected_filter(each): each for flow in flows for each in filters(flow)}
        commands = []
        for name, place in PLACES.items():
            exists = _netem_at(place.handle, qdiscs) is not None
            if exists or name in requested:
                impairment = requested[name].impairment if name in requested else Impairment()
                verb = "change" if exists else "add"
                commands.append(set_impairment(self.interface, name, impairment, verb=verb, tables=self._tables))  # type: ignore[arg-type]
        commands += [delete_filter(self.interface, *each[:2]) for each in sorted(found - set(wanted), key=str)]
        commands += [add_filter(self.interface, each) for key, each in wanted.items() if key not in found]
        return self._do(commands)

    def _clear(self, interface: str, *, at_once: bool) -> list[Command]:
        qdiscs = self._ours_or_free(interface)
        if not qdiscs:
            return []
        held = {name: found for name, place in PLACES.items() if (found := _netem_at(place.handle, qdiscs)) is not None}
        if at_once or not held:
            return self._do([delete_root(interface)])
        longest_ms = max(parse_impairment(found.options).longest_ms for found in held.values())
        ran = self._do([set_impairment(interface, name, Impairment(), verb="change") for name in held])
        self._wait_until_empty(interface, round(longest_ms * NS_PER_MS))
        ran += self._do([delete_filters(interface)])
        self._wait_until_empty(interface, 0)
        return ran + self._do([delete_root(interface)])

    def _wait_until_empty(self, interface: str, longest_ns: int) -> None:
        limit_ns = self._clock.now().mono_ns + longest_ns + AFTER_LONGEST_NS
        handles = {place.handle for place in PLACES.values()}
        while self._clock.now().mono_ns < limit_ns:
            qdiscs = parse_qdiscs(self._run(show_qdiscs(interface)))
            if not any(each.waiting_packets for each in qdiscs if each.handle in handles):
                return
            pause(POLL_NS)

    def _filters(self) -> list[FoundFilter]:
        return parse_filters(self._run(show_filters(self.interface)))

    def _do(self, commands: Sequence[Command]) -> list[Command]:
        for command in commands:
            self._run(command)
        return list(commands)


def _exists(interface: str) -> bool:
    try:
        return socket.if_nametoindex(interface) > 0
    except OSError:
        return False


def _is_ours(qdiscs: Sequence[Qdisc]) -> bool:
    return any(each.parent == "root" and each.handle == ROOT and each.kind == "prio" for each in qdiscs)


def _netem_at(handle: str, qdiscs: Sequence[Qdisc]) -> Qdisc | None:
    return next((each for each in qdiscs if each.handle == handle and each.kind == "netem"), None)
