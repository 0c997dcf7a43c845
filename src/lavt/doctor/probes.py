"""How `lavt doctor` looks at a machine and at its peer: each function measures one thing and judges nothing."""

from __future__ import annotations

import os
import queue
import re
import socket
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from lavt.assembly.cameras import build_device
from lavt.assembly.clock_source import clock_source, interpreter
from lavt.assembly.fidelity import VIDEO
from lavt.assembly.security import cipher_of, gateway_of
from lavt.clock import MachineClock, pause
from lavt.config import ClientCameraConfig, ClientConfig, ClockConfig, ServerConfig
from lavt.doctor.checks import SHOWN, CameraSample, CodecTimes, StateSample
from lavt.domain import NS_PER_MS, NS_PER_S, Now, Picture, State
from lavt.errors import BadMessage, LavtError, UserError, WorkError
from lavt.streams import stream
from lavt.transport.arrival import ANCILLARY_BYTES, SO_TIMESTAMPNS, enable_arrival_times
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.messages import decode
from lavt.transport.netem.netem import NetemInterface, run_tc
from lavt.transport.security.gateway import Carry
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES
from lavt.transport.zenoh_link import ZenohLink

PICTURES = 60
STEP_PX = 4
CODEC_LONGEST_NS = 3 * NS_PER_S
SLEEPS = 100
FIRST_STATE_NS = 3 * NS_PER_S
STATES_NS = NS_PER_S
CAMERA_NS = 2 * NS_PER_S
GOVERNORS = Path("/sys/devices/system/cpu")


def packages() -> tuple[dict[str, str | None], Sequence[str]]:
    """Give the version of each package that matters, None where it is missing, and what LAVT's metadata asks for."""
    try:
        requirements = requires("lavt") or []
    except PackageNotFoundError:  # run from the source tree alone
        requirements = []
    needed = [match[0] for each in requirements if "extra ==" not in each and (match := re.match(r"[\w.-]+", each))]
    return {name: _version(name) for name in dict.fromkeys((*SHOWN, *needed))}, requirements


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def codec_times(config: ServerConfig, clock: MachineClock) -> CodecTimes:
    """Stamp, encode, decode and read synthetic pictures as server and client would; raises what the codec raises."""
    camera = config.camera
    known = ClientCameraConfig(width_px=camera.width_px, height_px=camera.height_px, rate_hz=camera.rate_hz)
    sender, receiver = VIDEO.sender(config), VIDEO.receiver(ClientConfig(camera=known))
    encode_ns, decode_ns = [], []
    end_ns = clock.now().mono_ns + CODEC_LONGEST_NS
    for picture in _pictures(camera.width_px, camera.height_px):
        begun = clock.now()
        prepared, _ = sender.prepare(picture)
        unit = sender.encode(sender.write_stamp(prepared, begun.wall_ns), keyframe=False)
        encoded_ns = clock.now().mono_ns
        received = receiver.decode(unit)
        if received is None or receiver.read_stamp(received) != begun.wall_ns:
            raise WorkError("a picture that was encoded does not come out again with its stamp")
        decode_ns.append(clock.now().mono_ns - encoded_ns)
        encode_ns.append(encoded_ns - begun.mono_ns)
        if clock.now().mono_ns > end_ns:
            break
    return CodecTimes(encode_ns, decode_ns)


def _pictures(width_px: int, height_px: int) -> Iterator[Picture]:
    """Make soft structure that moves, with some noise.

    A little harder than the simulator's road: 2.2 ms to encode and 0.8 ms to decode where that takes 2.0 and 0.7.
    """
    random = stream(1, "doctor")
    coarse = random.integers(0, 256, (height_px // 16 + 1, width_px // 16 + 1, 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (width_px + PICTURES * STEP_PX, height_px), interpolation=cv2.INTER_CUBIC)
    noise = random.integers(0, 6, (height_px, width_px, 3), dtype=np.uint8)
    for number in range(PICTURES):
        seen = wide[:, number * STEP_PX : number * STEP_PX + width_px]
        yield cast("Picture", cv2.add(seen, np.roll(noise, 37 * number, axis=0)))


def camera_seen(config: ServerConfig, clock: MachineClock) -> CameraSample | str:
    """Take what the camera that is plugged in gives in two seconds; a text says why it gives nothing."""
    try:
        camera = build_device(config)
    except UserError as error:
        return str(error)
    came_ns, timed = [], 0
    with closing(camera):
        end_ns = clock.now().mono_ns + CAMERA_NS
        while (left_ns := end_ns - clock.now().mono_ns) > 0:
            if camera.wait(left_ns / NS_PER_S) and (frame := camera.capture(0, clock.now().mono_ns, None)):
                came_ns.append(clock.now().mono_ns)
                timed += frame.capture_ns is not None
    return CameraSample(came_ns, timed)


def receive_buffer_bytes() -> int:
    """Ask for LAVT's receive buffer as `UdpLink` does, and tell what is granted (Linux counts double, for itself)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def arrivals_are_stamped() -> bool:
    """Send one datagram to oneself, and tell whether the kernel says when it came."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.settimeout(1.0)
        opened.bind(("127.0.0.1", 0))
        enable_arrival_times(opened)
        opened.sendto(b"doctor", opened.getsockname())
        _, ancillary, _, _ = opened.recvmsg(64, ANCILLARY_BYTES)
    return any((level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS) for level, kind, _ in ancillary)


def timer(clock: MachineClock) -> tuple[int, list[int]]:
    """Give the smallest step of the monotonic clock, and by how much each of many sleeps of 1 ms was too long."""
    readings = [clock.now().mono_ns for _ in range(1000)]
    steps = [after - before for before, after in pairwise(readings) if after > before]
    late = []
    for _ in range(SLEEPS):
        begun_ns = clock.now().mono_ns
        pause(NS_PER_MS)
        late.append(clock.now().mono_ns - begun_ns - NS_PER_MS)
    return min(steps, default=0), late


def niceness() -> int:
    """Tell how far this process goes before (negative) or after ordinary ones."""
    return os.getpriority(os.PRIO_PROCESS, 0)


def governors() -> list[str]:
    """Read the governor of every processor's frequency; none where the system does not tell."""
    found = []
    for path in GOVERNORS.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        with suppress(OSError):
            found.append(path.read_text().strip())
    return found


def clock_report(config: ClockConfig, clock: MachineClock) -> ClockReport | None:
    """Ask this machine's source of time; None where it did not answer in time."""
    with closing(interpreter(config)) as requested:
        return clock_source(config, clock, requested.run)()


def netem_rejection(interface: str) -> str:
    """Tell why no delay could be injected here; empty where it could.

    The kernel is tried in a network of its own, which goes when the command ends: nothing that is there is touched.
    """
    apart = ("unshare", "--net", "--", "tc", "qdisc", "add", "dev", "lo", "root")
    try:
        for queue in (("handle", "1:", "prio"), ("netem", "delay", "1ms")):
            run_tc([*apart, *queue])
        if interface:
            NetemInterface(interface).check()
    except LavtError as error:
        return str(error)
    return ""


def bind_rejection(host: str, port: int) -> str:
    """Tell why a UDP port cannot be opened; empty where it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        try:
            opened.bind((host, port))
        except (OSError, ValueError) as error:
            return str(getattr(error, "strerror", error))
    return ""


class Listener:
    """What a link delivers to the doctor: states, counted outside of the door, and kept behind it."""

    def __init__(self, settings: ServerConfig | ClientConfig) -> None:
        self._behind: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._outside = 0
        self._carry: Carry = lambda *_: None
        self._gateway = gateway_of(settings, self._keep, lambda *sends: self._carry(*sends))

    def receive(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        """Take what the link delivers."""
        self._outside += channel == "state"
        self._gateway.receive(channel, payload, arrived, peer)

    def _keep(self, channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        if channel == "state":
            self._behind.put(payload)

    def hear(self, link: ZenohLink, clock: MachineClock) -> StateSample:
        """Listen for the vehicle's state: some seconds for the first, and one second from there."""
        self._carry = link.send
        link.start()
        states: list[State] = []
        unreadable: Counter[str] = Counter()
        begun, end_ns = False, clock.now().mono_ns + FIRST_STATE_NS
        while (left_ns := end_ns - clock.now().mono_ns) > 0:
            try:
                payload = self._behind.get(timeout=left_ns / NS_PER_S)
            except queue.Empty:
                break
            if not begun:
                begun, end_ns = True, clock.now().mono_ns + STATES_NS
            try:
                states.append(decode(State, payload))
            except BadMessage as error:
                unreadable[str(error)] += 1
        if self._outside and not states and not unreadable:
            unreadable.update(self._gateway.counts or {"nothing of it gets through": self._outside})
        return StateSample(states, dict(unreadable), STATES_NS / NS_PER_S)


def key_files(section: Any) -> list[tuple[str, Path, bool]]:
    """List what a config's `security` names: the key in the config, the file, and whether it is a private key."""
    given: Mapping[str, Any] = {} if section is None else section.model_dump()
    return [
        (f"security.{name}", Path(path), name == "key")
        for name, value in given.items()
        for name, path in (_named(name, value))
        if path
    ]


def _named(name: str, value: Any) -> list[tuple[str, str]]:
    if isinstance(value, Mapping):
        return [(f"{name}.{part}", str(path)) for part, path in value.items()]
    return [(name, str(value))] if value else []


def file_state(path: Path) -> tuple[str, int]:
    """Tell why a file cannot be read (empty: it can), and who may."""
    try:
        with path.open("rb") as opened:
            opened.read(1)
            return "", os.fstat(opened.fileno()).st_mode & 0o777
    except OSError as error:
        return str(error.strerror), 0


def certificates(folder: Path, now_wall_ns: int) -> list[tuple[Path, float]]:
    """Give the certificates in a directory, and for how many days each is still valid; needs `cryptography`."""
    try:
        from lavt.transport.security.certificates import days_left  # noqa: PLC0415 (an extra)
    except ImportError:
        return []
    found = []
    for path in sorted(folder.glob("*.pem")):
        with suppress(OSError, UserError):  # whoever uses the file says what is wrong with it
            found.append((path, days_left(path.read_bytes(), path.name, now_wall_ns)))
    return found


def keys_rejection(settings: ServerConfig | ClientConfig) -> str:
    """Tell why the keys that a config names cannot be used; empty where they can."""
    try:
        cipher_of(settings)
        gateway_of(settings, lambda *_: None, lambda *_: None)
    except (UserError, ImportError) as error:
        return str(error)
    return ""
