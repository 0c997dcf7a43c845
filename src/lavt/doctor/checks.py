"""What measurements of a machine, or of a pair of machines, mean for driving: the verdicts of `lavt doctor`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal

from lavt.doctor.clock_checks import WHAT_TO_DO, ClockComparison, check_host
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US, State
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES
from lavt.transport.zenoh_link import Routers

Verdict = Literal["ok", "warning", "problem", "not checked"]

PHYSICS_STEP_NS: Final = NS_PER_S // 240
COMMAND_PERIOD_NS: Final = 20 * NS_PER_MS
STATE_RATE_HZ: Final = 50.0
UNREADABLE: Final = {
    "states_of_another_time": "signed by the vehicle, which does not answer this operator's key",
    "states_forged": "not signed by the vehicle that security.vehicle names",
}
"""Why a door lets no state in, by what it counts."""
SHOWN: Final = ("lavt", "eclipse-zenoh", "av", "opencv-python-headless", "numpy", "cryptography", "pylibsrtp")
"""Packages whose versions matter between two machines."""
CAMERA_SHARE: Final = 0.9
"""Of the configured pictures have to come: fewer, and the camera exposes for longer than their period."""
CERTIFICATE_DAYS: Final = 14.0
"""With fewer left it is time to make new ones."""


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at: what was found, and what to do about it (empty: nothing)."""

    name: str
    verdict: Verdict
    found: str
    do: str = ""
    measured: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CodecTimes:
    """How long each synthetic picture took: stamped and encoded, decoded and its stamp read."""

    encode_ns: Sequence[int]
    decode_ns: Sequence[int]


@dataclass(frozen=True, slots=True)
class CameraSample:
    """What a camera gave: when each picture came, and of how many was known when it was taken."""

    came_ns: Sequence[int]
    timed: int


@dataclass(frozen=True, slots=True)
class StateSample:
    """What came on the state's key within `seconds` of the first: states, and how often what could not be read."""

    states: Sequence[State] = ()
    unreadable: Mapping[str, int] = field(default_factory=dict)
    seconds: float = 1.0


def check_versions(python: str, found: Mapping[str, str | None], requirements: Sequence[str]) -> Check:
    """Compare installed packages (None: missing) with what LAVT asks for, `requirements` of a package's metadata."""
    wrong = []
    for each in requirements:
        match = re.match(r"([\w.-]+)(?:.*?>=([\d.]+))?", each)
        name, least = ("", None) if match is None else match.groups()
        version = found.get(name)
        if version is None and "extra ==" not in each:
            wrong.append(f"{name} is missing")
        elif version is not None and least is not None and _numbers(version) < _numbers(least):
            wrong.append(f"{name} is {version}, at least {least} is needed")
    measured = {"python": python, **found}
    if wrong:
        do = "in LAVT's directory, by the Python that runs it: pip install -e ."
        return Check("versions", "problem", "; ".join(wrong), do, measured)
    shown = [f"{name} {version}" for name in SHOWN if (version := found.get(name)) is not None]
    return Check("versions", "ok", ", ".join([f"Python {python}", *shown]), measured=measured)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def check_codec(times: CodecTimes, *, size: str, rate_hz: float, side: str, cores: int) -> Check:
    """Compare the time for each picture with the time between two; `side` "server" encodes, "client" decodes."""
    period_ms = 1000.0 / rate_hz
    parts = {"encode": times.encode_ns, "decode": times.decode_ns}
    middle = {name: median(each) / NS_PER_MS for name, each in parts.items()}
    high = {name: sorted(each)[int(len(each) * 0.95)] / NS_PER_MS for name, each in parts.items()}
    words = f"{size} at {rate_hz:g} Hz: " + ", ".join(
        f"to {name} takes {middle[name]:.1f} ms (95 %: {high[name]:.1f} ms), {middle[name] / period_ms:.0%} of a frame"
        for name in parts
    )
    measured = {
        "cores": cores,
        "period_ms": period_ms,
        **{f"{name}_ms": value for name, value in middle.items()},
        **{f"{name}_p95_ms": value for name, value in high.items()},
    }
    counts = {"server": ["encode"], "client": ["decode"]}.get(side, list(parts))
    words += f"; {cores} core{'s' * (cores != 1)}"
    if max(middle[name] for name in counts) > period_ms:
        do = "use a lower camera.rate_hz or smaller pictures, or a faster machine: this one cannot keep up"
        return Check("processor", "problem", words, do, measured)
    if max(high[name] for name in counts) > period_ms / 2:
        do = "close other programs, or use a lower camera.rate_hz or smaller pictures: the loop needs the other half"
        return Check("processor", "warning", words, do, measured)
    if cores < 2:
        return Check("processor", "warning", words, "use at least two cores: video holds up commands on one", measured)
    return Check("processor", "ok", words, measured=measured)


def check_by_wire(heard: int, inhibit_reason: str, *, name: str) -> Check:
    """Judge what a by-wire kit said on its bus while nothing was sent, and why it could not be driven."""
    found = f"{heard} frames were heard on {name}"
    if inhibit_reason:
        do = "put that right: until then the vehicle is not armed (docs/vehicles.md)"
        return Check("by wire", "problem", f"{found}; {inhibit_reason}", do, {"frames": heard})
    return Check("by wire", "ok", f"{found}, every report of the profile among them", measured={"frames": heard})


def check_camera(seen: CameraSample | str, *, name: str, size: str, rate_hz: float) -> Check:
    """Compare the rate at which pictures came with what is configured; a text says why none can come."""
    if isinstance(seen, str):
        do = "put that right, or end what has the camera: `lavt server` does not start like this (docs/camera.md)"
        return Check("camera", "problem", seen, do)
    pictures, times = len(seen.came_ns), seen.came_ns
    came_hz = (pictures - 1) * NS_PER_S / (times[-1] - times[0]) if pictures > 1 else 0.0
    known = "known" if seen.timed else "not known"
    found = f"{name} gives {size}, {came_hz:.1f} pictures a second; when each was taken is {known}"
    measured = {"pictures": pictures, "rate_hz": came_hz, "timed": seen.timed}
    if came_hz < rate_hz * CAMERA_SHARE:
        do = f"{rate_hz:g} are configured: give it light (it exposes for longer in the dark), or lower camera.rate_hz"
        return Check("camera", "warning", found, do, measured)
    return Check("camera", "ok", found, measured=measured)


def check_buffer(granted_bytes: int) -> Check:
    """Compare the receive buffer that the system gives a socket with what LAVT asks for."""
    words = f"a socket may keep {granted_bytes} bytes that wait to be read, {RECEIVE_BUFFER_BYTES} are asked for"
    measured = {"granted_bytes": granted_bytes, "requested_bytes": RECEIVE_BUFFER_BYTES}
    if granted_bytes >= RECEIVE_BUFFER_BYTES:
        return Check("receive buffer", "ok", words, measured=measured)
    do = f"as root: sysctl -w net.core.rmem_max={RECEIVE_BUFFER_BYTES} (and into /etc/sysctl.d/ to keep it)"
    return Check("receive buffer", "warning", words, do, measured)


def check_arrival(stamped: bool) -> Check:
    """Judge whether the kernel says when a datagram arrived."""
    if stamped:
        return Check("arrival times", "ok", "the kernel stamps datagrams as they arrive", measured={"stamped": True})
    found = "the kernel does not stamp datagrams: waiting in the socket counts as network"
    return Check("arrival times", "warning", found, "use Linux 2.6.30 or newer, not in a sandbox", {"stamped": False})


def check_timer(resolution_ns: int, late_ns: Sequence[int]) -> Check:
    """Judge by how much a sleep of a millisecond is too long; the physics has 4.2 ms, a command 20 ms."""
    late = sorted(late_ns)
    middle_ns, high_ns = median(late), late[int(len(late) * 0.95)]
    words = (
        f"a sleep of 1 ms ends {middle_ns / NS_PER_MS:.2f} ms late (95 %: {high_ns / NS_PER_MS:.2f} ms); the monotonic "
        f"clock tells {resolution_ns / NS_PER_US:.2f} µs apart"
    )
    measured = {"resolution_ns": resolution_ns, "late_ms": middle_ns / NS_PER_MS, "late_p95_ms": high_ns / NS_PER_MS}
    do = "close other programs, give a virtual machine processors of its own, run LAVT as root (it takes precedence)"
    if middle_ns > COMMAND_PERIOD_NS:
        return Check("timer", "problem", words, do, measured)
    return (
        Check("timer", "warning", words, do, measured)
        if high_ns > PHYSICS_STEP_NS
        else Check("timer", "ok", words, measured=measured)
    )


def check_precedence(niceness: int) -> Check:
    """Judge whether LAVT's processes go before ordinary ones."""
    measured = {"niceness": niceness}
    if niceness < 0:
        found = f"LAVT's processes go before ordinary ones (nice {niceness})"
        return Check("precedence", "ok", found, measured=measured)
    found = "LAVT's processes wait like ordinary ones: what else runs shows as latency"
    do = "run as root, or with LimitNICE=-10 as in deploy/systemd/ (`ulimit -e 30` of a login)"
    return Check("precedence", "warning", found, do, measured)


def check_governor(governors: Sequence[str]) -> Check:
    """Judge how the processors' frequency is set; none where the system does not tell."""
    measured = {"governors": sorted(set(governors))}
    if not governors:
        found = "this machine does not tell (usual for a virtual one)"
        return Check("frequency", "not checked", found, measured=measured)
    found = f"the processors' governor is {', '.join(sorted(set(governors)))}"
    if set(governors) == {"performance"}:
        return Check("frequency", "ok", found, measured=measured)
    do = "as root: cpupower frequency-set -g performance; a slow clock at little load shows as latency"
    return Check("frequency", "warning", found, do, measured)


def check_clock(report: ClockReport | None) -> Check:
    """Judge what this machine's source of time says; without one can be driven, but not measured as well."""
    if report is None:
        found = "the source of time did not answer in time"
        return Check("clock", "warning", found, "ask again when this machine is less busy")
    finding = check_host(report)
    measured = {"source": report.source, "correction_s": report.correction_s, "bound_s": report.bound_s}
    found = "; ".join(finding.says)
    if finding.good or report.source == "probe":
        return Check("clock", "ok", found, measured=measured)
    if report.correction_s is None:
        return Check("clock", "warning", report.status, WHAT_TO_DO.get(report.status, ""), measured)
    do = "let one machine follow the other closely (deploy/chrony/), or both a reference on the same network"
    return Check("clock", "warning", found, do, measured)


def check_netem(rejection: str, interface: str) -> Check:
    """Judge whether the kernel can delay packets here; it must only where the config names an interface."""
    if not rejection:
        return Check("netem", "ok", "this kernel can delay packets, and this user may have it do so")
    if interface:
        do = "put that right, or set injection.interface to nothing: the side does not start like this"
        return Check("netem", "problem", rejection, do, {"interface": interface})
    found = f"not needed unless a delay is to be injected on this machine, where it would be refused: {rejection}"
    return Check("netem", "ok", found)


def check_port(name: str, key: str, host: str, port: int, *, rejection: str, served: bool) -> Check:
    """Judge whether a UDP port can be opened; `served`: a `lavt server` answers there already."""
    where = f"UDP {host}:{port}"
    measured = {"host": host, "port": port}
    if not rejection:
        return Check(name, "ok", f"{where} can be opened", measured=measured)
    if served:
        return Check(name, "ok", f"{where} is in use by a `lavt server` that runs here already", measured=measured)
    do = f"end what has it (`ss -lunp 'sport = :{port}'` names it), or set {key} to another"
    return Check(name, "problem", f"{where} cannot be opened: {rejection}", do, measured)


def check_router(endpoint: str, rejection: str) -> Check:
    """Judge whether a router answers on this machine."""
    measured = {"endpoint": endpoint}
    if not rejection:
        return Check("router", "ok", f"a router answers at {endpoint}", measured=measured)
    return Check(
        "router", "problem", rejection, "start `lavt router FILE.json5` here, or put zenoh.router right", measured
    )


def check_link(routers: Routers | None, *, heard: bool) -> Check:
    """Judge whether this machine's router has a link to another one, and whether both are of one version."""
    name = "link of routers"
    if routers is None:
        return Check(name, "not checked", "the router does not tell: no adminspace, or no right to ask it")
    measured = {"linked": routers.linked, "versions": routers.versions}
    if routers.linked == 0 and not heard:
        found = "this machine's router has no link to another one"
        do = (
            "see that the other side's router runs, that the address in `connect` is its own, that both name the "
            "protocol alike, and that UDP port 7448 is open at the side that listens"
        )
        return Check(name, "warning", found, do, measured)
    found = f"linked to {routers.linked} other router{'s' * (routers.linked != 1)}; Zenoh {', '.join(routers.versions)}"
    if len(set(routers.versions)) > 1:
        return Check(name, "warning", found, "install the same eclipse-zenoh everywhere", measured)
    return Check(name, "ok", found, measured=measured)


def check_vehicle(heard: StateSample, vehicle: str, version: str) -> Check:
    """Judge by the states that came whether the vehicle's server is there and understood; nobody takes the vehicle."""
    states = len(heard.states)
    rate_hz = states / heard.seconds
    measured = {"states": states, "seconds": heard.seconds, "unreadable": dict(heard.unreadable)}
    if heard.unreadable:
        why = ", ".join(f"{UNREADABLE.get(reason, reason)} ({count})" for reason, count in heard.unreadable.items())
        do = (
            f"install the same version of LAVT on both machines (here it is {version}), give both of them keys of one "
            "`lavt keys`, or none, and name this operator in the vehicle's security.operators"
        )
        return Check("vehicle", "problem", f"states of {vehicle} come that cannot be read: {why}", do, measured)
    if not states:
        do = "see that `lavt server` runs there, that vehicle_id is the same on both, and that the routers are linked"
        return Check("vehicle", "problem", f"{vehicle} tells no state", do, measured)
    latest = heard.states[-1]
    active_operator = f"held by {latest.active_operator}" if latest.active_operator else "held by nobody"
    found = f"{vehicle} tells its state {rate_hz:.0f} times a second: {latest.safety}, {active_operator}"
    measured |= {"safety": latest.safety, "active_operator": latest.active_operator}
    if rate_hz < STATE_RATE_HZ / 2:
        do = f"{STATE_RATE_HZ:.0f} are sent: look for loss on the way (`ping`), or a busy machine"
        return Check("vehicle", "warning", found, do, measured)
    return Check("vehicle", "ok", found, measured=measured)


def check_probe(finding: ClockComparison | None, host: str, port: int) -> Check:
    """Judge the clocks of both machines by probes; None: nobody answered."""
    measured: dict[str, Any] = {"host": host, "port": port}
    if finding is None:
        do = "see that `lavt server` runs there, that clock.probe_port is the same on both, and that the port is open"
        return Check("clock probe", "problem", f"nobody answers at UDP {host}:{port}", do, measured)
    measured |= {"round_trip_ms": finding.round_trip_ms}
    measured |= {} if finding.probe is None else {"offset_ms": finding.probe.ms, "bound_ms": finding.probe.bound_ms}
    found = "; ".join(finding.says[1:])  # the first is of this machine's clock
    if finding.good:
        return Check("clock probe", "ok", found, measured=measured)
    do = "driving is possible, one-way latencies are not: docs/measuring_latency.md says what they need"
    return Check("clock probe", "warning", found, do, measured)


def check_video(host: str, port: int) -> Check:
    """Say why nobody knows beforehand whether the video comes through."""
    where = f"UDP {host}:{port}" if port else f"{host}, UDP, at the server's video.port (5600 as shipped)"
    do = "let that port through to the vehicle's machine; `lavt client` says whether pictures come"
    found = f"{where}: the server answers only who has a session's token, so this shows in a drive alone"
    return Check("video", "not checked", found, do, {"host": host, "port": port})


def check_plain(secured: bool) -> Check:
    """Judge whether messages are signed and the video is encrypted."""
    if secured:
        return Check("security", "ok", "messages are signed, and the video is encrypted")
    do = "two machines: make keys with `lavt keys` and use the secure configs (docs/deployment.md)"
    return Check("security", "warning", "plain: whoever reaches the vehicle's router can drive; for a lab or a VPN", do)


def check_key_file(key: str, path: Path, *, rejection: str, mode: int, private: bool) -> Check:
    """Judge a file with a key: readable, and a private one by its owner alone."""
    if rejection:
        return Check(key, "problem", f"{path} cannot be read: {rejection}", "copy it here, or put the config right")
    if private and mode & 0o077:
        found = f"{path} is a private key that others may read (mode {mode & 0o777:o})"
        return Check(key, "problem", found, f"chmod 600 {path}; make new keys if others had access")
    return Check(key, "ok", f"{path} is there")


def check_certificate(path: Path, days_left: float) -> Check:
    """Judge for how long a certificate is valid."""
    name, measured = path.name, {"days_left": round(days_left, 2)}
    do = "make new ones with `lavt keys`, and put them onto all machines"
    if days_left < 0:
        return Check(name, "problem", f"the certificate {path} expired {-days_left:.0f} days ago", do, measured)
    found = f"the certificate {path} is valid for {days_left:.0f} days"
    if days_left < CERTIFICATE_DAYS:
        return Check(name, "warning", found, do, measured)
    return Check(name, "ok", found, measured=measured)
