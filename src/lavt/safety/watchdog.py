"""The watchdog on the vehicle: command timeouts, faults, and actuation while degraded or stopping."""

from __future__ import annotations

from lavt.domain import Actuation, Command, VehicleState
from lavt.safety.governor import Governor
from lavt.safety.issued_stamps import IssuedStamps
from lavt.safety.limiter import Limiter
from lavt.safety.limits import Limits
from lavt.safety.path_follower import PathFollower
from lavt.safety.session import CommandEpoch
from lavt.safety.speed_limit import SpeedLimit, lowest
from lavt.safety.state_machine import UNCOMMANDED, SafetyStateMachine
from lavt.safety.stop_brake import StopBrake


class Watchdog:
    """A watchdog that stops the vehicle after a command timeout or a fault, and computes every actuation.

    A command is fresh if it was made from a newer picture than all earlier commands. Only fresh commands reset the
    command timeout.
    """

    def __init__(
        self,
        limits: Limits,
        limiter: Limiter,
        machine: SafetyStateMachine,
        epoch: CommandEpoch,
        issued_stamps: IssuedStamps,
        *,
        governor: Governor | None = None,
    ) -> None:
        self.speed_limit: SpeedLimit | None = None
        """The lowest limit of the speed at the last actuation; None without a governor, or if no command was in
        force."""
        self._governor = governor
        self._limits = limits
        self._limiter = limiter
        self._machine = machine
        self._epoch = epoch
        self._issued_stamps = issued_stamps
        self._path = PathFollower(limiter.wheelbase_m, limits.stamp_memory_ns)
        self._stop_brake = StopBrake(limits, limiter.max_braking_mps2)
        self._fresh_command_ns = 0
        self._captured_ns = 0
        """Capture time of the picture of `CommandEpoch.command`."""
        self._was_engaged = False
        """The last result of `should_engage`."""

    def reset_timeout(self, now_ns: int) -> None:
        """Restart the command timeout, because a fresh command was accepted."""
        self._fresh_command_ns = now_ns

    def has_fresh_command(self, now_ns: int) -> bool:
        """Return whether the last fresh command is younger than the limit for `degraded`."""
        return now_ns - self._fresh_command_ns < self._limits.degraded_after_ns

    def check_timeouts(self, now_ns: int) -> None:
        """Trigger the transitions of a frozen camera and of command timeouts."""
        if self._issued_stamps.is_frozen:
            self._machine.trigger("camera fault")
        since_command_ns = now_ns - self._fresh_command_ns
        if since_command_ns >= self._limits.degraded_after_ns:
            self._machine.trigger("arming interrupted")
            self._machine.trigger("command timeout")
        if since_command_ns >= self._limits.stop_after_ns:
            self._machine.trigger("command-timeout stop")

    def next_wake_ns(self) -> int | None:
        """Return when `check_timeouts` is due if no fresh command arrives; None if no timeout is running."""
        if not self._machine.is_active():
            return None
        is_degraded = self._machine.state == "degraded"
        return self._fresh_command_ns + (self._limits.stop_after_ns if is_degraded else self._limits.degraded_after_ns)

    def check_vehicle(self, vehicle: VehicleState) -> None:
        """Trigger the transition of a driver override, of a vehicle fault, or of motion during arming."""
        if vehicle.is_overridden:
            self._machine.trigger("driver override")
        elif vehicle.inhibit_reason:
            self._machine.trigger("vehicle fault", vehicle.inhibit_reason)
        elif not self._limits.is_possible(vehicle):
            self._machine.trigger("vehicle fault", "its speed or steering angle is not a possible number")
        elif not vehicle.is_speed_plausible:
            self._machine.trigger("vehicle fault", "its speed is not plausible")
        elif not vehicle.is_engaged and self._machine.state in ("driving", "degraded"):
            self._machine.trigger("vehicle fault")
        elif not self._limits.is_stationary(vehicle):
            self._machine.trigger("arming interrupted")

    def should_engage(self, vehicle: VehicleState) -> bool:
        """Return whether the vehicle must be engaged: it is driven or about to be driven, or it has not stopped yet.

        Call this after each physics step. After the vehicle was stationary or disarmed, only arming engages it again,
        because the driver in the car is allowed to move it after a stop.
        """
        is_disarmed = self._machine.state == "disarmed"
        is_stopping = self._was_engaged and not is_disarmed and not self._limits.is_stationary(vehicle)
        self._was_engaged = self._machine.is_active() or is_stopping
        return self._was_engaged

    def start_at_rest(self, vehicle: VehicleState, now_ns: int) -> None:
        """Drop the last command and its path, and take the present angle of the wheels as the first steering target."""
        self._epoch.command = None
        self._path.clear_path()
        self._limiter.reset(vehicle.steering_rad, now_ns)

    def set_command(self, command: Command, vehicle: VehicleState) -> None:
        """Store an accepted drive command and its path; its stamp must be known."""
        self._epoch.command = command
        self._captured_ns = self._issued_stamps.captured_ns(command.stamp_ns)
        self._path.update_odometry(vehicle)
        self._path.set_path(command.steering_rad, command.path_curvature_per_m, self._captured_ns)

    def actuation(self, vehicle: VehicleState, now_ns: int) -> Actuation:
        """Return the actuation for now: that of the last command or of the present state's stop, within all limits.

        Call this after each physics step: it updates the odometry.
        """
        self.check_vehicle(vehicle)
        self._path.update_odometry(vehicle)
        state = self._machine.state
        command = self._epoch.command if state in ("driving", "degraded") else None
        throttle, brake = (command.throttle, command.brake) if command else (0.0, self._limits.arming_brake)
        if state == "degraded":  # no throttle, and the commanded brake is not released
            throttle, brake = 0.0, max(brake, self._pedal(self._limits.degraded_deceleration_mps2))
        elif state == "safe_stop":
            throttle, brake = 0.0, self._stop_brake.pedal(vehicle, now_ns)
        elif state != "driving":
            throttle, brake = 0.0, 1.0
        if state != "safe_stop":
            self._stop_brake.reset()
        picture_age_ns = now_ns - self._captured_ns if command else None
        target = Actuation(self._steering_target_rad(vehicle, now_ns), throttle, brake)
        governed = self.speed_limit = None
        if self._governor is not None and picture_age_ns is not None:
            governed = self._governor.limit(now_ns)
            self.speed_limit = lowest(governed, self._limiter.stopping_limit(picture_age_ns))
        return self._limiter.limit(target, vehicle, now_ns, picture_age_ns, governed)

    def _steering_target_rad(self, vehicle: VehicleState, now_ns: int) -> float:
        """Return the commanded angle. In states without commands, return the angle that follows the last path.

        Without a path, and in all other states, return the last target.
        """
        if self._machine.state == "driving" and self._epoch.command is not None:
            return self._epoch.command.steering_rad
        if self._machine.state in UNCOMMANDED:
            if self._limits.is_stationary(vehicle):  # the driver can move the car from here, off the path
                self._path.clear_path()
            path_steering_rad = self._path.steering_rad(now_ns)
            if path_steering_rad is not None:
                return path_steering_rad
        return self._limiter.target_rad(vehicle)

    def _pedal(self, deceleration_mps2: float) -> float:
        return min(1.0, deceleration_mps2 / self._limiter.max_braking_mps2)
