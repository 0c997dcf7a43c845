"""The checks of `lavt doctor`: each function turns measurements of one or two machines into a verdict."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final, Literal

from lavt.doctor.clock_checks import HINTS, ClockComparison, check_host
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US, State
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.router_check import Routers
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES

Verdict = Literal["ok", "warning", "problem", "not checked"]

PHYSICS_STEP_NS: Final = NS_PER_S // 240
COMMAND_PERIOD_NS: Final = 20 * NS_PER_MS
STATE_RATE_HZ: Final = 50.0
UNREADABLE_REASONS: Final = {
    "states_of_unknown_process": "signed by the vehicle, which does not answer this operator's key",
    "states_forged": "not signed by the vehicle that security.vehicle names",
}
"""Why a gateway rejects states, by the name of the gateway's counter for them."""
SHOWN_PACKAGES: Final = (
    "lavt",
    "eclipse-zenoh",
    "av",
    "opencv-python-headless",
    "numpy",
    "cryptography",
    "pylibsrtp",
)
"""Packages whose versions are shown, so that the user can compare two machines."""
MIN_PICTURE_RATE_SHARE: Final = 0.9
"""The required share of the configured picture rate; at a lower rate, the exposure is longer than the picture
period."""


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check; `found` is the finding as a sentence."""

    name: str
    verdict: Verdict
    found: str
    do: str = ""
    """The suggested fix; empty if there is nothing to fix."""
    measured: Mapping[str, Any] = field(default_factory=dict)
    """The measured values by name."""


@dataclass(frozen=True, slots=True)
class CodecTimes:
    """The processing times of synthetic pictures."""

    encode_ns: Sequence[int]
    """For each picture, the time to stamp and encode it."""
    decode_ns: Sequence[int]
    """For each picture, the time to decode it and read its stamp."""


@dataclass(frozen=True, slots=True)
class CameraSample:
    """The arrival times of a camera's pictures, and how many of the pictures have a capture time."""

    arrived_ns: Sequence[int]
    capture_time_count: int


@dataclass(frozen=True, slots=True)
class StateSample:
    """The vehicle states of the `seconds` after the first state, and the number of unreadable states by reason."""

    states: Sequence[State] = ()
    unreadable: Mapping[str, int] = field(default_factory=dict)
    seconds: float = 1.0


def check_versions(python: str, installed: Mapping[str, str | None], requirements: Sequence[str]) -> Check:
    """Check the installed versions (None: missing) against the `requirements` in LAVT's package metadata."""
    errors = []
    for requirement in requirements:
        match = re.match(r"([\w.-]+)(?:.*?>=([\d.]+))?", requirement)
        name, minimum = ("", None) if match is None else match.groups()
        version = installed.get(name)
        if version is None and "extra ==" not in requirement:
            errors.append(f"{name} is missing")
        elif version is not None and minimum is not None and _version_tuple(version) < _version_tuple(minimum):
            errors.append(f"{name} is {version}, but at least {minimum} is required")
    measured = {"python": python, **installed}
    if errors:
        do = "in LAVT's directory, with the Python that runs it: pip install -e ."
        return Check("versions", "problem", "; ".join(errors), do, measured)
    versions = [f"{name} {version}" for name in SHOWN_PACKAGES if (version := installed.get(name)) is not None]
    return Check("versions", "ok", ", ".join([f"Python {python}", *versions]), measured=measured)


def _version_tuple(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def check_codec(times: CodecTimes, *, size: str, rate_hz: float, side: str, cores: int) -> Check:
    """Check that the codec is fast enough for the picture rate.

    `side` is "server" for a machine that only encodes and "client" for one that only decodes. If it is empty, the
    machine must do both.
    """
    period_ms = 1000.0 / rate_hz
    times_ns = {"encode": times.encode_ns, "decode": times.decode_ns}
    median_ms = {name: median(values) / NS_PER_MS for name, values in times_ns.items()}
    p95_ms = {name: sorted(values)[int(len(values) * 0.95)] / NS_PER_MS for name, values in times_ns.items()}
    found = f"{size} at {rate_hz:g} Hz: " + ", ".join(
        f"to {name} takes {median_ms[name]:.1f} ms (p95 {p95_ms[name]:.1f} ms), "
        f"{median_ms[name] / period_ms:.0%} of the picture period"
        for name in times_ns
    )
    measured = {
        "cores": cores,
        "period_ms": period_ms,
        **{f"{name}_ms": value for name, value in median_ms.items()},
        **{f"{name}_p95_ms": value for name, value in p95_ms.items()},
    }
    relevant = {"server": ["encode"], "client": ["decode"]}.get(side, list(times_ns))
    found += f"; {cores} core{'s' * (cores != 1)}"
    if max(median_ms[name] for name in relevant) > period_ms:
        do = "use a lower camera.rate_hz, smaller pictures or a faster machine: this one is too slow"
        return Check("processor", "problem", found, do, measured)
    if max(p95_ms[name] for name in relevant) > period_ms / 2:
        do = (
            "close other programs, or use a lower camera.rate_hz or smaller pictures: other work needs half of the "
            "picture period"
        )
        return Check("processor", "warning", found, do, measured)
    if cores < 2:
        return Check(
            "processor", "warning", found, "use at least two cores: on one core, video delays commands", measured
        )
    return Check("processor", "ok", found, measured=measured)


def check_by_wire(frames: int, inhibit_reason: str, *, name: str) -> Check:
    """Check that a by-wire kit sends its reports on its bus, and that nothing inhibits driving."""
    found = f"{frames} frames received on {name}"
    if inhibit_reason:
        do = "fix this: until then the vehicle cannot be armed (docs/vehicles.md)"
        return Check("by wire", "problem", f"{found}; {inhibit_reason}", do, {"frames": frames})
    return Check("by wire", "ok", f"{found}, including every report of the profile", measured={"frames": frames})


def check_memory_lock(reason: str) -> Check:
    """Check that the actuator of a by-wire car may lock its memory; `reason` says why not."""
    if reason:
        do = "run the server as root, or with LimitMEMLOCK=infinity as in deploy/systemd/"
        return Check("memory", "warning", f"the actuator may have to wait for the disk: {reason}", do)
    return Check("memory", "ok", "the actuator can keep its memory in RAM")


def check_camera(sample: CameraSample | str, *, name: str, size: str, rate_hz: float) -> Check:
    """Check that a camera delivers pictures at the configured rate; a string is the reason why it delivers none."""
    if isinstance(sample, str):
        do = "fix this, or close the program that uses the camera: `lavt server` cannot start (docs/camera.md)"
        return Check("camera", "problem", sample, do)
    pictures, arrived_ns = len(sample.arrived_ns), sample.arrived_ns
    measured_hz = (pictures - 1) * NS_PER_S / (arrived_ns[-1] - arrived_ns[0]) if pictures > 1 else 0.0
    capture_times = "have a capture time" if sample.capture_time_count else "have no capture time"
    found = f"{name} delivers {measured_hz:.1f} pictures of {size} a second, which {capture_times}"
    measured = {"pictures": pictures, "rate_hz": measured_hz, "timed": sample.capture_time_count}
    if measured_hz < rate_hz * MIN_PICTURE_RATE_SHARE:
        do = f"{rate_hz:g} Hz are configured: add light (in the dark the exposure is longer), or lower camera.rate_hz"
        return Check("camera", "warning", found, do, measured)
    return Check("camera", "ok", found, measured=measured)


def check_buffer(granted_bytes: int) -> Check:
    """Check that the system grants a socket the receive buffer that LAVT requests."""
    found = f"a socket gets a receive buffer of {granted_bytes} bytes, LAVT requests {RECEIVE_BUFFER_BYTES}"
    measured = {"granted_bytes": granted_bytes, "requested_bytes": RECEIVE_BUFFER_BYTES}
    if granted_bytes >= RECEIVE_BUFFER_BYTES:
        return Check("receive buffer", "ok", found, measured=measured)
    do = f"as root: sysctl -w net.core.rmem_max={RECEIVE_BUFFER_BYTES} (and add it to /etc/sysctl.d/ to keep it)"
    return Check("receive buffer", "warning", found, do, measured)


def check_arrival(is_recorded: bool) -> Check:
    """Check that the kernel records the arrival time of datagrams."""
    if is_recorded:
        found = "the kernel records when datagrams arrive"
        return Check("arrival times", "ok", found, measured={"stamped": True})
    found = "the kernel does not record when datagrams arrive: their wait in the socket counts as network latency"
    return Check("arrival times", "warning", found, "use Linux 2.6.30 or newer, not in a sandbox", {"stamped": False})


def check_timer(resolution_ns: int, late_ns: Sequence[int]) -> Check:
    """Check how late sleeps of 1 ms end, compared with the physics step of 4.2 ms and the command period of 20 ms."""
    sorted_ns = sorted(late_ns)
    median_ns, p95_ns = median(sorted_ns), sorted_ns[int(len(sorted_ns) * 0.95)]
    found = (
        f"a sleep of 1 ms ends {median_ns / NS_PER_MS:.2f} ms late (p95 {p95_ns / NS_PER_MS:.2f} ms); the monotonic "
        f"clock has a resolution of {resolution_ns / NS_PER_US:.2f} µs"
    )
    measured = {"resolution_ns": resolution_ns, "late_ms": median_ns / NS_PER_MS, "late_p95_ms": p95_ns / NS_PER_MS}
    do = "close other programs, give a virtual machine dedicated processors, or run LAVT as root (for its priority)"
    if median_ns > COMMAND_PERIOD_NS:
        return Check("timer", "problem", found, do, measured)
    if p95_ns > PHYSICS_STEP_NS:
        return Check("timer", "warning", found, do, measured)
    return Check("timer", "ok", found, measured=measured)


def check_process_priority(niceness: int, session_niceness: int | None) -> Check:
    """Check that LAVT's processes have a higher priority than ordinary processes.

    `session_niceness` is the niceness of the terminal's session; None if the kernel does not share the processors among
    sessions.
    """
    name, measured = "process priority", {"niceness": niceness, "session_niceness": session_niceness}
    if niceness < 0 and session_niceness is not None and session_niceness >= 0:
        found = f"LAVT's processes have priority (nice {niceness}) over those of this terminal's session only"
        do = "run them as services, as in deploy/systemd/, or first run `echo -10 > /proc/self/autogroup` here, as root"
        return Check(name, "warning", found, do, measured)
    if niceness < 0:
        found = f"LAVT's processes have priority over ordinary ones (nice {niceness})"
        return Check(name, "ok", found, measured=measured)
    found = "LAVT's processes have ordinary priority: other programs add latency"
    do = "run as root, or with LimitNICE=-10 as in deploy/systemd/ (`ulimit -e 30` in a login shell)"
    return Check(name, "warning", found, do, measured)


def check_governor(governors: Sequence[str]) -> Check:
    """Check that the processors run at full frequency; `governors` is empty if the system does not report them."""
    measured = {"governors": sorted(set(governors))}
    if not governors:
        found = "this machine does not report its governor (usual for a virtual machine)"
        return Check("frequency", "not checked", found, measured=measured)
    found = f"the processors' governor is {', '.join(sorted(set(governors)))}"
    if set(governors) == {"performance"}:
        return Check("frequency", "ok", found, measured=measured)
    do = "as root: cpupower frequency-set -g performance; a low frequency at low load adds latency"
    return Check("frequency", "warning", found, do, measured)


def check_clock(report: ClockReport | None) -> Check:
    """Check this machine's time source. Driving is possible without one, but latency measurements are less accurate."""
    if report is None:
        return Check("clock", "warning", "the time source timed out", "try again when this machine is less busy")
    comparison = check_host(report)
    measured = {"source": report.source, "correction_s": report.correction_s, "bound_s": report.bound_s}
    found = "; ".join(comparison.says)
    if comparison.good or report.source == "probe":
        return Check("clock", "ok", found, measured=measured)
    if report.correction_s is None:
        return Check("clock", "warning", report.status, HINTS.get(report.status, ""), measured)
    do = "synchronise one machine to the other (deploy/chrony/), or both to a reference on the same network"
    return Check("clock", "warning", found, do, measured)


def check_netem(rejection: str, interface: str) -> Check:
    """Check that the kernel can delay packets here, which is required only if the config names an interface."""
    if not rejection:
        return Check("netem", "ok", "the kernel can delay packets, and this user has the required permissions")
    if interface:
        do = "fix this, or leave injection.interface empty: without netem, this side cannot start"
        return Check("netem", "problem", rejection, do, {"interface": interface})
    found = f"not available, but needed only to inject latency on this machine: {rejection}"
    return Check("netem", "ok", found)


def check_port(name: str, key: str, host: str, port: int, *, rejection: str, is_served: bool) -> Check:
    """Check that a UDP port is free, or in use by a `lavt server` (`is_served`)."""
    address = f"UDP {host}:{port}"
    measured = {"host": host, "port": port}
    if not rejection:
        return Check(name, "ok", f"{address} is free", measured=measured)
    if is_served:
        return Check(name, "ok", f"{address} is in use by a `lavt server` on this machine", measured=measured)
    do = f"end the program that uses it (`ss -lunp 'sport = :{port}'` shows it), or set {key} to another port"
    return Check(name, "problem", f"{address} cannot be opened: {rejection}", do, measured)


def check_router(endpoint: str, rejection: str, *, is_embedded: bool = False) -> Check:
    """Check that a router answers: of this machine or, if a client's router is embedded, the router that it dials."""
    measured = {"endpoint": endpoint}
    if not rejection:
        return Check("router", "ok", f"a router answers at {endpoint}", measured=measured)
    do = "start `lavt router FILE.json5` here, or fix zenoh.router"
    if is_embedded:
        do = "start `lavt server` on the vehicle's machine, and open UDP port 7448 there"
    return Check("router", "problem", rejection, do, measured)


def check_embedded_router(locators: Sequence[str], rejection: str) -> Check:
    """Check that the embedded router of a server that is not running can listen."""
    measured = {"locators": list(locators)}
    if not rejection:
        return Check("router", "ok", f"the server's router can listen at {', '.join(locators)}", measured=measured)
    return Check("router", "problem", rejection, "fix zenoh.router_file or zenoh.router_settings", measured)


def check_link(routers: Routers | None, *, has_vehicle: bool) -> Check:
    """Check that this machine's router is linked to another router of the same version.

    If `has_vehicle`, the vehicle's state arrives, and no link is needed.
    """
    name = "link of routers"
    if routers is None:
        found = "the router does not report its links: no adminspace, or no permission to query it"
        return Check(name, "not checked", found)
    measured = {"linked": routers.linked, "versions": routers.versions}
    if routers.linked == 0 and not has_vehicle:
        found = "this machine's router has no link to another one"
        do = (
            "check that the other side's router runs, that `connect` has its address, that both use the same "
            "protocol, and that UDP port 7448 is open on the listening side"
        )
        return Check(name, "warning", found, do, measured)
    found = f"linked to {routers.linked} other router{'s' * (routers.linked != 1)}; Zenoh {', '.join(routers.versions)}"
    if len(set(routers.versions)) > 1:
        return Check(name, "warning", found, "install the same version of eclipse-zenoh everywhere", measured)
    return Check(name, "ok", found, measured=measured)


def check_vehicle(sample: StateSample, vehicle: str, version: str) -> Check:
    """Check that the vehicle's state arrives, can be read, and has the expected rate."""
    state_count = len(sample.states)
    rate_hz = state_count / sample.seconds
    measured = {"states": state_count, "seconds": sample.seconds, "unreadable": dict(sample.unreadable)}
    if sample.unreadable:
        reasons = [f"{UNREADABLE_REASONS.get(name, name)} ({count})" for name, count in sample.unreadable.items()]
        do = (
            f"install the same version of LAVT on both machines (here it is {version}), use keys of one `lavt keys` "
            "on both machines or none, and name this operator in the vehicle's security.operators"
        )
        found = f"states of {vehicle} cannot be read: {', '.join(reasons)}"
        return Check("vehicle", "problem", found, do, measured)
    if not state_count:
        do = (
            "check that `lavt server` runs there, that both sides have the same vehicle_id, "
            "and that the routers are linked"
        )
        return Check("vehicle", "problem", f"no state of {vehicle} arrives", do, measured)
    latest = sample.states[-1]
    operator = f"{latest.active_operator} has control" if latest.active_operator else "no operator has control"
    found = f"the state of {vehicle} arrives {rate_hz:.0f} times a second: {latest.safety}, {operator}"
    measured |= {"safety": latest.safety, "active_operator": latest.active_operator}
    if rate_hz < STATE_RATE_HZ / 2:
        do = f"the vehicle sends {STATE_RATE_HZ:.0f} a second: look for packet loss (`ping`) or an overloaded machine"
        return Check("vehicle", "warning", found, do, measured)
    return Check("vehicle", "ok", found, measured=measured)


def check_probe(comparison: ClockComparison | None, host: str, port: int) -> Check:
    """Check the comparison of both machines' clocks by probes; None: no probe was answered."""
    measured: dict[str, Any] = {"host": host, "port": port}
    if comparison is None:
        do = (
            "check that `lavt server` runs there, that clock.probe_port is equal on both sides, "
            "and that this port is open"
        )
        return Check("clock probe", "problem", f"no answer from UDP {host}:{port}", do, measured)
    measured |= {"round_trip_ms": comparison.round_trip_ms}
    estimate = comparison.probe
    measured |= {} if estimate is None else {"offset_ms": estimate.ms, "bound_ms": estimate.bound_ms}
    found = "; ".join(comparison.says[1:])  # the first sentence is about this machine's clock
    if comparison.good:
        return Check("clock probe", "ok", found, measured=measured)
    do = "driving is possible, but one-way latencies are not accurate (docs/measuring_latency.md)"
    return Check("clock probe", "warning", found, do, measured)


def check_video(host: str, port: int) -> Check:
    """Return a check without a verdict: the port of the video can only be checked by a drive."""
    address = f"UDP {host}:{port}" if port else f"{host}, UDP, the server's video.port (5600 by default)"
    do = "open that port to the vehicle's machine; `lavt client` reports whether pictures arrive"
    found = f"{address}: the server answers only a client with a session token, so only a drive can check the port"
    return Check("video", "not checked", found, do, {"host": host, "port": port})
