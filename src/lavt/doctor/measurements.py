"""The measurements of `lavt doctor`: each function measures one property of a machine, without a verdict."""

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
from typing import Any, NamedTuple, cast

import cv2
import numpy as np

from lavt.assembly.cameras import build_device
from lavt.assembly.clock_source import build_query_process, clock_source
from lavt.assembly.fidelity import VIDEO
from lavt.assembly.security import build_authenticator, build_cipher, build_gateway
from lavt.clock import MachineClock, pause
from lavt.config import ClientCameraConfig, ClientConfig, ClockConfig, ServerConfig
from lavt.doctor.checks import SHOWN_PACKAGES, CameraSample, CodecTimes, StateSample
from lavt.domain import NS_PER_MS, NS_PER_S, Now, Picture, State
from lavt.errors import BadMessage, LavtError, UserError, WorkError
from lavt.streams import stream
from lavt.transport.arrival import ANCILLARY_BYTES, SO_TIMESTAMPNS, enable_arrival_times
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.messages import decode
from lavt.transport.netem.netem import NetemInterface, run_tc
from lavt.transport.security.keys import NS_PER_DAY, key_expiry_ns, load_private, load_public
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES
from lavt.transport.zenoh_link import ZenohLink

CODEC_PICTURES = 60
SHIFT_PX_PER_PICTURE = 4
NOISE_SHIFT_PX_PER_PICTURE = 37
"""The noise moves in another way than the texture, so that the encoder cannot predict it."""
CODEC_TIMEOUT_NS = 3 * NS_PER_S
SLEEPS = 100
FIRST_STATE_TIMEOUT_NS = 3 * NS_PER_S
STATE_SAMPLE_NS = NS_PER_S
CAMERA_SAMPLE_NS = 2 * NS_PER_S
PROCESSORS = Path("/sys/devices/system/cpu")


class KeyFile(NamedTuple):
    """A file that a config's `security` names, with the config's key for it, such as `security.key`."""

    config_key: str
    path: Path
    is_private: bool


def packages() -> tuple[dict[str, str | None], Sequence[str]]:
    """Return the installed versions of relevant packages (None: missing), and the requirements of LAVT's metadata."""
    try:
        requirements = requires("lavt") or []
    except PackageNotFoundError:  # LAVT runs from the source tree and is not installed
        requirements = []
    required = [requirement for requirement in requirements if "extra ==" not in requirement]
    names = [match[0] for requirement in required if (match := re.match(r"[\w.-]+", requirement))]
    return {name: _version(name) for name in dict.fromkeys((*SHOWN_PACKAGES, *names))}, requirements


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def codec_times(config: ServerConfig, clock: MachineClock) -> CodecTimes:
    """Time the codec with synthetic pictures and the settings of server and client; let the codec's errors through."""
    camera = config.camera
    client_camera = ClientCameraConfig(width_px=camera.width_px, height_px=camera.height_px, rate_hz=camera.rate_hz)
    sender, receiver = VIDEO.sender(config), VIDEO.receiver(ClientConfig(camera=client_camera))
    encode_ns, decode_ns = [], []
    end_ns = clock.now().mono_ns + CODEC_TIMEOUT_NS
    for picture in _pictures(camera.width_px, camera.height_px):
        start = clock.now()
        prepared, _ = sender.prepare(picture)
        unit = sender.encode(sender.write_stamp(prepared, start.wall_ns), keyframe=False)
        encoded_ns = clock.now().mono_ns
        received = receiver.decode(unit)
        if received is None or receiver.read_stamp(received) != start.wall_ns:
            raise WorkError("the stamp of an encoded picture was lost")
        decode_ns.append(clock.now().mono_ns - encoded_ns)
        encode_ns.append(encoded_ns - start.mono_ns)
        if clock.now().mono_ns > end_ns:
            break
    return CodecTimes(encode_ns, decode_ns)


def _pictures(width_px: int, height_px: int) -> Iterator[Picture]:
    """Yield pictures of a moving smooth texture with some noise.

    These pictures take a little longer than pictures of the simulator's road: measured on one machine, 2.2 ms to encode
    and 0.8 ms to decode, compared with 2.0 ms and 0.7 ms.
    """
    random = stream(1, "doctor")
    coarse = random.integers(0, 256, (height_px // 16 + 1, width_px // 16 + 1, 3), dtype=np.uint8)
    wide = cv2.resize(
        coarse, (width_px + CODEC_PICTURES * SHIFT_PX_PER_PICTURE, height_px), interpolation=cv2.INTER_CUBIC
    )
    noise = random.integers(0, 6, (height_px, width_px, 3), dtype=np.uint8)
    for number in range(CODEC_PICTURES):
        view = wide[:, number * SHIFT_PX_PER_PICTURE : number * SHIFT_PX_PER_PICTURE + width_px]
        yield cast("Picture", cv2.add(view, np.roll(noise, NOISE_SHIFT_PX_PER_PICTURE * number, axis=0)))


def sample_camera(config: ServerConfig, clock: MachineClock) -> CameraSample | str:
    """Take pictures from the configured camera for two seconds; if the camera cannot be used, return the reason."""
    try:
        camera = build_device(config)
    except UserError as error:
        return str(error)
    arrived_ns, capture_time_count = [], 0
    with closing(camera):
        end_ns = clock.now().mono_ns + CAMERA_SAMPLE_NS
        while (left_ns := end_ns - clock.now().mono_ns) > 0:
            if camera.wait(left_ns / NS_PER_S) and (frame := camera.capture(0, clock.now().mono_ns, None)):
                arrived_ns.append(clock.now().mono_ns)
                capture_time_count += frame.capture_ns is not None
    return CameraSample(arrived_ns, capture_time_count)


def receive_buffer_bytes() -> int:
    """Request LAVT's receive buffer as `UdpLink` does, and return the granted size (Linux reports it doubled)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        udp_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        return udp_socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def kernel_records_arrivals() -> bool:
    """Send a datagram to this process, and return whether the kernel records its arrival time."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        udp_socket.settimeout(1.0)
        udp_socket.bind(("127.0.0.1", 0))
        enable_arrival_times(udp_socket)
        udp_socket.sendto(b"doctor", udp_socket.getsockname())
        _, ancillary, _, _ = udp_socket.recvmsg(64, ANCILLARY_BYTES)
    return any((level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS) for level, kind, _ in ancillary)


def timer_accuracy(clock: MachineClock) -> tuple[int, list[int]]:
    """Return the resolution of the monotonic clock, and by how much each of many sleeps of 1 ms was too long."""
    readings = [clock.now().mono_ns for _ in range(1000)]
    steps = [after - before for before, after in pairwise(readings) if after > before]
    late_ns = []
    for _ in range(SLEEPS):
        start_ns = clock.now().mono_ns
        pause(NS_PER_MS)
        late_ns.append(clock.now().mono_ns - start_ns - NS_PER_MS)
    return min(steps, default=0), late_ns


def niceness() -> int:
    """Return the nice value of this process: negative means priority over ordinary processes."""
    return os.getpriority(os.PRIO_PROCESS, 0)


def governors() -> list[str]:
    """Return the frequency governor of every processor; empty if the system does not report them."""
    found = []
    for path in PROCESSORS.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        with suppress(OSError):
            found.append(path.read_text().strip())
    return found


def clock_report(config: ClockConfig, clock: MachineClock) -> ClockReport | None:
    """Query this machine's time source; return None if it times out."""
    with closing(build_query_process(config)) as process:
        return clock_source(config, clock, process.run)()


def netem_rejection(interface: str) -> str:
    """Return why no delay can be injected on this machine; empty: it can.

    The check creates its queues in a temporary network namespace, so that no existing interface is changed.
    """
    command = ("unshare", "--net", "--", "tc", "qdisc", "add", "dev", "lo", "root")
    try:
        for qdisc in (("handle", "1:", "prio"), ("netem", "delay", "1ms")):
            run_tc([*command, *qdisc])
        if interface:
            NetemInterface(interface).check()
    except LavtError as error:
        return str(error)
    return ""


def bind_rejection(host: str, port: int) -> str:
    """Return why a UDP port cannot be opened; empty: it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        try:
            udp_socket.bind((host, port))
        except (OSError, ValueError) as error:
            return str(getattr(error, "strerror", error))
    return ""


class StateListener:
    """A receiver of the vehicle's states: it counts all states, and keeps the states that a gateway accepts."""

    def __init__(self, settings: ServerConfig | ClientConfig) -> None:
        self._accepted: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._received = 0
        self._authenticator = build_authenticator(settings)

    def _keep_state(self, channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        if channel == "state":
            self._accepted.put(payload)

    def listen(self, link: ZenohLink, clock: MachineClock) -> StateSample:
        """Wait some seconds for the vehicle's first state, then collect states for one second."""
        gateway = build_gateway(self._authenticator, self._keep_state, link.send, lambda: (0, -1))

        def receive(channel: str, payload: Any, arrived: Now, peer: Any) -> None:
            self._received += channel == "state"
            gateway.receive(channel, payload, arrived, peer)

        link.start(receive)
        states: list[State] = []
        unreadable: Counter[str] = Counter()
        has_first, end_ns = False, clock.now().mono_ns + FIRST_STATE_TIMEOUT_NS
        while (left_ns := end_ns - clock.now().mono_ns) > 0:
            try:
                payload = self._accepted.get(timeout=left_ns / NS_PER_S)
            except queue.Empty:
                break
            if not has_first:
                has_first, end_ns = True, clock.now().mono_ns + STATE_SAMPLE_NS
            try:
                states.append(decode(State, payload))
            except BadMessage as error:
                unreadable[str(error)] += 1
        if self._received and not states and not unreadable:
            unreadable.update(gateway.counts or {"rejected by the gateway": self._received})
        return StateSample(states, dict(unreadable), STATE_SAMPLE_NS / NS_PER_S)


def key_files(security: Any) -> list[KeyFile]:
    """Return the files that a config's section `security` names; none if the section is None."""
    values: Mapping[str, Any] = {} if security is None else security.model_dump()
    return [
        KeyFile(f"security.{name}", Path(path), is_private=name == "key")
        for name, value in values.items()
        for name, path in (_flatten(name, value))
        if path
    ]


def _flatten(name: str, value: Any) -> list[tuple[str, str]]:
    """Return names and paths: one pair for a string, and one for each entry of a mapping."""
    if isinstance(value, Mapping):
        return [(f"{name}.{part}", str(path)) for part, path in value.items()]
    return [(name, str(value))] if value else []


def file_state(path: Path) -> tuple[str, int]:
    """Return why a file cannot be read (empty: it can), and its permission bits."""
    try:
        with path.open("rb") as file:
            file.read(1)
            return "", os.fstat(file.fileno()).st_mode & 0o777
    except OSError as error:
        return str(error.strerror), 0


def certificates(folder: Path, now_wall_ns: int) -> list[tuple[Path, float]]:
    """Return the certificates in a directory with their remaining days; empty without `cryptography`."""
    try:
        from lavt.transport.security.certificates import days_left  # noqa: PLC0415 (an optional dependency)
    except ImportError:
        return []
    found = []
    for path in sorted(folder.glob("*.pem")):
        with suppress(OSError, UserError):  # loading the keys reports an invalid file
            found.append((path, days_left(path.read_bytes(), path.name, now_wall_ns)))
    return found


def signing_key_days_left(path: Path, now_wall_ns: int, *, is_private: bool) -> float | None:
    """Return the days until a signing key expires; None if it never expires. Raise `UserError` for an invalid key."""
    (load_private if is_private else load_public)(path)
    expires_ns = key_expiry_ns(path.read_bytes(), path)
    return None if expires_ns is None else (expires_ns - now_wall_ns) / NS_PER_DAY


def keys_rejection(settings: ServerConfig | ClientConfig) -> str:
    """Return why the keys that a config names cannot be used; empty: they can."""
    try:
        build_cipher(settings)
        build_authenticator(settings)
    except (UserError, ImportError) as error:
        return str(error)
    return ""
