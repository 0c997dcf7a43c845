"""Apply, change, verify and clear netem on an interface.

This module uses no signals and no globals, so a long-running program can call it from any thread. A lock serialises
the changes of several threads or programs.
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

from msgspec import Struct

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import LavtError, UserError, WorkError
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment, check_flows
from lavt.transport.netem.correlated_jitter import CorrelatedJitter
from lavt.transport.netem.queue_probe import ProbeResult, judge, measure, queue_probes
from lavt.transport.netem.state import (
    DIRECTORY,
    NO_OWNER,
    AppliedState,
    Owner,
    StateFiles,
    boot_id,
    current_process,
    network_namespace,
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

TC_TIMEOUT_S: Final = 10.0
POLL_NS: Final = 10 * NS_PER_MS
DRAIN_MARGIN_NS: Final = NS_PER_S
"""A queue gets this much time to drain, in addition to its longest delay."""

RunCommand = Callable[[Command], str]
"""Runs a command and returns its standard output; raises `UserError` or `WorkError`."""

NO_ROOT = "only root may change queueing disciplines: use sudo, or use the relay, which needs no root"
NO_NETEM = (
    "this kernel lacks netem, prio or u32: load them (`modprobe -a sch_netem sch_prio cls_u32`), use a kernel that has "
    "them, or use the relay, which needs none"
)
TC_ERRORS: Final = (
    ("Cannot find device", "there is no interface {interface}: list the interfaces with `ip link`"),
    ("Operation not permitted", NO_ROOT),
    ("qdisc kind is unknown", NO_NETEM),
    ("TC classifier not found", NO_NETEM),
    (
        "No distribution data",
        "tc lacks the table of this distribution: install all of iproute2, or use another distribution",
    ),
    ("No such file or directory", NO_NETEM),
    ("Cannot send dump request", NO_NETEM),
)
"""Error texts of tc, and the messages to show for them."""


def tc_environment() -> dict[str, str]:
    """Return an environment in which tc is found and prints English."""
    return {**os.environ, "PATH": os.environ.get("PATH", "") + ":/usr/sbin:/sbin", "LC_ALL": "C"}


def run_tc(command: Command) -> str:
    """Run a tc command. Raise `UserError` for what a user can correct, `WorkError` for anything else."""
    environment = tc_environment()
    if shutil.which("tc", path=environment["PATH"]) is None:
        raise UserError("tc is not installed: install iproute2, or use the relay, which does not need it")
    try:
        completed = subprocess.run(  # noqa: S603 (the arguments are ours; the interface's name is checked)
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TC_TIMEOUT_S,
            check=False,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
    except subprocess.TimeoutExpired as error:
        raise WorkError(f"`{as_typed(command)}` did not end within {TC_TIMEOUT_S:.0f} s") from error
    if completed.returncode:
        interface = command[command.index("dev") + 1]
        for part, sentence in TC_ERRORS:
            if part in completed.stderr:
                raise UserError(sentence.format(interface=interface))
        raise WorkError(f"`{as_typed(command)}` failed: {' '.join(completed.stderr.split())}")
    return completed.stdout


class Verification(Struct, frozen=True):
    """The result of a verification: `reasons` lists every difference from the request; it is empty if there is none."""

    reasons: list[str]
    measured: dict[str, ProbeResult]


class NetemInterface:
    """netem on one interface. As a context manager it restores the interface at the end of the block.

    With `persistent`, the impairments outlive this process and have no owner. `directory` has the state files
    for restoring after a crash. `seed` is the seed of correlated jitter. Raises `UserError` for an invalid name.
    """

    def __init__(
        self,
        interface: str,
        *,
        persistent: bool = False,
        directory: Path = DIRECTORY,
        run: RunCommand = run_tc,
        seed: int = 1,
    ) -> None:
        if not re.fullmatch(r"(?!-)[^\s/]{1,15}", interface) or interface in {".", ".."}:
            raise UserError(f"{interface!r} is not an interface name: list the interfaces with `ip link`")
        self.interface = interface
        self._files = StateFiles(directory)
        self._tables = str(directory)
        self._owner = NO_OWNER if persistent else current_process()
        self._run = run
        self._clock = MachineClock()
        self._seed = seed
        self._jitter: CorrelatedJitter | None = None

    def __enter__(self) -> NetemInterface:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.clear()

    def check(self) -> list[str]:
        """Raise `UserError` if nothing can be applied. Return the messages of `restore`."""
        messages = self.restore()
        with self._files.locked():
            self._check_owner()
        return messages

    def restore(self) -> list[str]:
        """Restore every interface whose owner died, and return a message for each.

        A failed restoration is tried again the next time, unless the interface no longer exists.
        """
        with self._files.locked():
            return [
                f"found {state.description}, which has died: {self._restore(state.interface)}"
                for state in self._files.all()
                if state.is_abandoned
            ]

    def apply(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), condition: str = ""
    ) -> list[Command]:
        """Apply the impairments of `flows` and return the commands that did it.

        Existing impairments are changed without losing a packet, and those of other flows are removed. No flow may
        cover a port of `exempt`. Raise `UserError` for flows that netem cannot produce, and for an interface with a
        foreign root qdisc or an impairment that another LAVT program owns.
        """
        check_flows(flows, exempt)
        is_correlated = any(flow.impairment.jitter_correlation for flow in flows)
        if is_correlated and self._owner == NO_OWNER:
            raise UserError(
                "correlated jitter needs a running program: `lavt netem apply --hold`, or network.injection: netem"
            )
        self.restore()
        with self._files.locked():
            self._check_owner()
            qdiscs = self._our_qdiscs(self.interface)
            if any(flow.impairment.jitter_distribution == "uniform" for flow in flows):
                self._files.write_text("uniform.dist", uniform_table())
            self._files.write(
                AppliedState(self.interface, network_namespace(), boot_id(), self._owner, condition, tuple(flows))
            )
            self._stop_jitter()
            commands = self._change(flows, qdiscs) if qdiscs else self._create(flows)
            if is_correlated:
                self._jitter = CorrelatedJitter(
                    self.interface, flows, tc_environment(), seed=self._seed, clock=self._clock
                )
            return commands

    def clear(self, *, at_once: bool = False, any_owner: bool = False) -> list[Command]:
        """Restore the interface and return the commands that did it; none if nothing here belongs to this owner.

        Queued packets leave first, in order. They are lost only with `at_once`, which loses all of them, or if a rate
        limit has queued more packets than leave within the longest delay plus two seconds. `any_owner` also clears
        impairments of other LAVT programs and persistent ones. Raise `UserError` for a foreign root qdisc.
        """
        with self._files.locked():
            self._stop_jitter()
            if not any_owner and self._current_owner() != self._owner:
                return []
            commands = self._clear(self.interface, at_once=at_once)
            self._files.remove(self.interface)
            return commands

    def applied(self) -> AppliedState | None:
        """Return what was applied and who owns it, or None if no state is stored."""
        return self._files.read(self.interface)

    def status(self) -> dict[str, Any]:
        """Return what tc reports: whether the root qdisc is LAVT's, and the impairment of each flow."""
        qdiscs = parse_qdiscs(self._run(show_qdiscs(self.interface)))
        netems = {name: _netem_at(place.handle, qdiscs) for name, place in PLACES.items()}
        return {
            "interface": self.interface,
            "ours": _is_ours(qdiscs),
            "queues": [f"{qdisc.kind} {qdisc.handle} {qdisc.parent}" for qdisc in qdiscs],
            "impairments": {
                name: parse_impairment(netem.options) for name, netem in netems.items() if netem is not None
            },
            "applied": self.applied(),
        }

    def read_back(self, flows: Sequence[ImpairedFlow]) -> list[str]:
        """Compare tc's report with the request, and return a message for each difference."""
        qdiscs = parse_qdiscs(self._run(show_qdiscs(self.interface)))
        if not _is_ours(qdiscs):
            return [f"{self.interface} has no qdisc of LAVT"]
        actual = self._filters()
        expected = {expected_filter(tc_filter) for flow in flows for tc_filter in filters(flow)}
        reasons = [reason for flow in flows for reason in difference(flow, qdiscs, actual)]
        surplus = [found[:3] for found in actual if found not in expected]
        return reasons + [f"there is a filter that was not requested: {found}" for found in surplus]

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> dict[str, ProbeResult]:
        """Measure, through the queue, packets of each flow and packets that must not be delayed."""
        return measure(self.interface, queue_probes(flows, exempt), count=count)

    def verify(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> Verification:
        """Compare the request with what tc reports and with a measurement; also report stopped correlated jitter."""
        reasons = self.read_back(flows)
        measured = self.measure(flows, exempt=exempt, count=count)
        return Verification(reasons + self.problems() + judge(flows, exempt, measured), measured)

    def problems(self) -> list[str]:
        """Return a message for each flow whose correlated jitter has stopped; this starts no program."""
        return [] if self._jitter is None else self._jitter.problems()

    def _restore(self, interface: str) -> str:
        """Restore an interface whose owner died, and return the outcome."""
        outcome = "the interface is restored"
        try:
            self._clear(interface, at_once=True)
        except LavtError as error:
            if _exists(interface):
                return f"the interface could not be restored: {error}"
            outcome = "the interface no longer exists"
        self._files.remove(interface)
        return outcome

    def _check_owner(self) -> None:
        """Raise `UserError` if the impairment on the interface belongs to another LAVT program."""
        if not self._our_qdiscs(self.interface):
            return
        if self._current_owner() != self._owner:
            state = self._files.read(self.interface)
            description = f"a delay on {self.interface}, left in place" if state is None else state.description
            raise UserError(
                f"found {description}: clear it with `lavt netem clear --interface {self.interface}`, or let it end"
            )

    def _current_owner(self) -> Owner:
        state = self._files.read(self.interface)
        return NO_OWNER if state is None else state.owner  # no state is stored if the scripts in netem/ applied it

    def _our_qdiscs(self, interface: str) -> list[Qdisc]:
        """Return the qdiscs if the root is LAVT's, or an empty list if it is the kernel's own.

        Raise `UserError` for a foreign root: one with another handle than LAVT's.
        """
        qdiscs = parse_qdiscs(self._run(show_qdiscs(interface)))
        if _is_ours(qdiscs):
            return qdiscs
        for qdisc in qdiscs:
            if qdisc.parent == "root" and qdisc.handle != "0:":
                raise UserError(
                    f"{interface} has a root qdisc that is not LAVT's ({qdisc.kind} {qdisc.handle}): delete it "
                    f"yourself (`tc qdisc del dev {interface} root`), or name another interface"
                )
        return []

    def _create(self, flows: Sequence[ImpairedFlow]) -> list[Command]:
        """Apply flows to an interface without a qdisc of LAVT; restore the interface if that fails."""
        try:
            return self._run_all([add_root(self.interface)]) + self._change(flows, [])
        except LavtError:
            with suppress(LavtError):
                self._run_all([delete_root(self.interface)])
            self._files.remove(self.interface)
            raise

    def _stop_jitter(self) -> None:
        """Stop the thread for correlated jitter."""
        if self._jitter is not None:
            self._jitter.stop()
            self._jitter = None

    def _change(self, flows: Sequence[ImpairedFlow], qdiscs: Sequence[Qdisc]) -> list[Command]:
        """Change LAVT's qdiscs and filters to what is requested."""
        requested = {flow.name: flow for flow in flows}
        actual = set(self._filters()) if qdiscs else set()
        expected = {expected_filter(tc_filter): tc_filter for flow in flows for tc_filter in filters(flow)}
        commands = []
        for name, place in PLACES.items():
            exists = _netem_at(place.handle, qdiscs) is not None
            if exists or name in requested:
                impairment = requested[name].impairment if name in requested else Impairment()
                verb = "change" if exists else "add"
                commands.append(set_impairment(self.interface, name, impairment, verb=verb, tables=self._tables))  # type: ignore[arg-type]
        surplus = sorted(actual - set(expected), key=str)
        missing = [tc_filter for key, tc_filter in expected.items() if key not in actual]
        commands += [delete_filter(self.interface, found.number, found.version) for found in surplus]
        commands += [add_filter(self.interface, tc_filter) for tc_filter in missing]
        return self._run_all(commands)

    def _clear(self, interface: str, *, at_once: bool) -> list[Command]:
        qdiscs = self._our_qdiscs(interface)
        if not qdiscs:
            return []
        netems = {
            name: found for name, place in PLACES.items() if (found := _netem_at(place.handle, qdiscs)) is not None
        }
        if at_once or not netems:
            return self._run_all([delete_root(interface)])
        longest_ms = max(parse_impairment(found.options).longest_ms for found in netems.values())
        commands = self._run_all([set_impairment(interface, name, Impairment(), verb="change") for name in netems])
        self._wait_until_empty(interface, round(longest_ms * NS_PER_MS))
        commands += self._run_all([delete_filters(interface)])
        self._wait_until_empty(interface, 0)
        return commands + self._run_all([delete_root(interface)])

    def _wait_until_empty(self, interface: str, longest_delay_ns: int) -> None:
        limit_ns = self._clock.now().mono_ns + longest_delay_ns + DRAIN_MARGIN_NS
        handles = {place.handle for place in PLACES.values()}
        while self._clock.now().mono_ns < limit_ns:
            qdiscs = parse_qdiscs(self._run(show_qdiscs(interface)))
            if not any(qdisc.waiting_packets for qdisc in qdiscs if qdisc.handle in handles):
                return
            pause(POLL_NS)

    def _filters(self) -> list[FoundFilter]:
        return parse_filters(self._run(show_filters(self.interface)))

    def _run_all(self, commands: Sequence[Command]) -> list[Command]:
        for command in commands:
            self._run(command)
        return list(commands)


def _exists(interface: str) -> bool:
    try:
        return socket.if_nametoindex(interface) > 0
    except OSError:
        return False


def _is_ours(qdiscs: Sequence[Qdisc]) -> bool:
    return any(qdisc.parent == "root" and qdisc.handle == ROOT and qdisc.kind == "prio" for qdisc in qdiscs)


def _netem_at(handle: str, qdiscs: Sequence[Qdisc]) -> Qdisc | None:
    return next((qdisc for qdisc in qdiscs if qdisc.handle == handle and qdisc.kind == "netem"), None)
