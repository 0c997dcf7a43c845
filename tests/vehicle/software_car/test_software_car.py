"""A software car: a kit and the simulator together."""

import math
from functools import cache

import pytest
from tests.vehicle.software_car.rig import START_NS, CommandValues, Sender1, Sender2, both_generations

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.state import ReleaseReason


@cache
def road() -> Road:
    return load_road("a_key")


class DrivenCar:
    """A software car that gets hand-made commands every 20 ms; its speed is read from the bus."""

    def __init__(self, generation: int) -> None:
        self.simulator = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
        self.car = SoftwareCar(Kit(1 if generation == 1 else 2, start_ns=START_NS), self.simulator)
        self.sender: Sender1 | Sender2 = Sender1() if generation == 1 else Sender2()
        self.now_ns = START_NS
        self.reports: list[tuple[int, bytes]] = []
        self.command(brake=0.5)
        if isinstance(self.sender, Sender2):
            self.car.receive(self.sender.system(1), self.now_ns)
        self.car.receive(self.sender.gear(4), self.now_ns)

    @property
    def speed_mps(self) -> float:
        """The speed in the newest report."""
        speeds = [
            int.from_bytes(data[4:6] if identifier == 0x065 else data[:2], "little", signed=True) / 360
            for identifier, data in self.reports
            if identifier in {0x065, 0x107}
        ]
        return speeds[-1] if speeds else 0.0

    def command(self, **keys: float) -> None:
        """Send a set of commands."""
        for frame in self.sender.commands(CommandValues(**keys)):  # type: ignore[arg-type]
            self.reports += [(report.identifier, report.data) for report in self.car.receive(frame, self.now_ns)]

    def wait_ms(self, duration_ms: int) -> None:
        """Advance the time."""
        self.now_ns += duration_ms * NS_PER_MS
        self.reports += [(frame.identifier, frame.data) for frame in self.car.advance(self.now_ns)]

    def keep_speed_ms(self, duration_ms: int, speed_mps: float, angle_deg: float = 0.0) -> None:
        """Control the speed with the pedals."""
        for _ in range(duration_ms // 20):
            missing = speed_mps - self.speed_mps
            self.command(angle_deg=angle_deg, throttle=min(max(missing + 0.08, 0), 1), brake=min(max(-missing, 0), 1))
            self.wait_ms(20)


@both_generations
def test_a_straight_drive(generation: int) -> None:
    """Driven by hand-made frames, the car goes straight ahead at 5 m/s after 5 s, and reports its speed."""
    drive = DrivenCar(generation)
    heading_rad = drive.simulator.pose().heading_rad
    drive.keep_speed_ms(5_000, speed_mps=5.0)
    assert drive.simulator.state().speed_mps == pytest.approx(5.0, abs=0.1)
    assert drive.speed_mps == pytest.approx(drive.simulator.state().speed_mps, abs=0.05)
    assert drive.simulator.pose().heading_rad == heading_rad


@both_generations
def test_the_wheels_reach_the_commanded_angle(generation: int) -> None:
    """29.6 degrees at the steering wheel are 2 degrees at the road wheels, to the left, and are reported."""
    drive = DrivenCar(generation)
    drive.keep_speed_ms(2_000, speed_mps=2.0, angle_deg=29.6)
    assert math.degrees(drive.simulator.state().steering_rad) == pytest.approx(2.0, abs=0.001)
    assert drive.simulator.ground_truth().heading_error_rad > 0
    angles = [data for identifier, data in drive.reports if identifier in {0x065, 0x100}]
    assert int.from_bytes(angles[-1][:2], "little") == 296


@both_generations
def test_a_command_timeout_stops_the_car(generation: int) -> None:
    """Without commands the watchdog stops a car from 5 m/s in at most 2.5 s."""
    drive = DrivenCar(generation)
    drive.keep_speed_ms(5_000, speed_mps=5.0)
    drive.wait_ms(100)
    assert drive.car.kit.state.watchdog_reason == ReleaseReason.TIMEOUT
    drive.wait_ms(2_400)
    assert (drive.simulator.state().speed_mps, drive.speed_mps) == (0.0, 0.0)


@both_generations
def test_a_command_takes_effect_in_the_next_step(generation: int) -> None:
    """A command between two steps of 1/240 s takes effect from the next step on."""
    drive = DrivenCar(generation)
    drive.wait_ms(20)
    drive.command(angle_deg=100.0)
    step_ns = drive.simulator.next_wake_ns()
    drive.car.advance(step_ns)
    assert drive.simulator.state().steering_rad == 0.0
    drive.car.advance(drive.simulator.next_wake_ns())
    after = drive.simulator.state()
    assert after.steering_rad > 0.0
    assert after.mono_ns - step_ns <= NS_PER_S // 240 + 1


@both_generations
def test_a_drive_is_reproducible(generation: int) -> None:
    """The same frames at the same times give the same reports and pose, however finely the car is advanced."""
    coarse, fine = DrivenCar(generation), DrivenCar(generation)
    for drive, parts in ((coarse, 1), (fine, 20)):
        for index in range(50):
            drive.command(angle_deg=index, throttle=0.5)
            for _ in range(parts):
                drive.wait_ms(20 // parts)
    assert coarse.reports == fine.reports
    assert coarse.simulator.pose() == fine.simulator.pose()


def test_a_car_without_commands_is_stationary() -> None:
    """A car without commands is stationary in park, and sends reports."""
    car = SoftwareCar(Kit(2, start_ns=START_NS), Simulator(road=road(), seed=1, start_mono_ns=START_NS))
    frames = car.advance(START_NS + NS_PER_S)
    assert car.simulator.state().speed_mps == 0.0
    assert len(frames) == 100 * 2 + 50 * 3 + 10 * 3, "two reports have 100 Hz, three 50 Hz and three 10 Hz"
