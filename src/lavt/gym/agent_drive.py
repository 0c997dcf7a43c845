"""One drive of an agent in virtual time: the whole loop of a run, which stops at each picture that the client sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

from lavt.domain import NS_PER_S, GroundTruth, Now
from lavt.errors import WorkError
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.run import CONFIG, compute_result, config_text
from lavt.experiment.runs.virtual_run import AFTER_ENDING_NS, ARMING_LIMIT_NS, RUN_LIMIT_NS, build_loop
from lavt.nodes.agent_driver import AgentDriverNode, AgentView
from lavt.nodes.payloads import Admission, AgentAction, Route


class DriveWatcher:
    """A recorder that keeps what the environment needs of a drive."""

    channels: ClassVar[frozenset[str]] = frozenset({"lane", "truth", "admission", "route"})

    def __init__(self) -> None:
        self.has_view = False
        """Whether the client has seen a picture since this value was last set to False."""
        self.truths: list[GroundTruth] = []
        """The ground truth since the list was last cleared, 50 times a second."""
        self.applied: Admission | None = None
        """The newest accepted command."""
        self.first_applied: Admission | None = None
        """The first accepted command from the newest picture of which a command was accepted."""
        self.rejections = 0
        """The number of rejected commands since the client knows that the vehicle is armed."""
        self.rejection = ""
        """The reason of the newest rejection."""
        self.route: Route | None = None

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Keep an entry if it is needed."""
        if topic == "lane":
            self.has_view = True
        elif topic == "truth":
            self.truths.append(payload)
        elif topic == "admission":
            if payload.verdict == "accepted":
                if self.applied is None or payload.stamp_ns != self.applied.stamp_ns:
                    self.first_applied = payload
                self.applied = payload
            else:
                self.rejections += 1
                self.rejection = payload.reason
        elif topic == "route":
            self.route = payload


Action = tuple[float, float]
"""The wanted angle of the road wheels (rad) and the wanted speed (m/s)."""


def neutral(_view: AgentView) -> Action:
    """Return the action of a driver who waits: straight wheels, and no speed."""
    return 0.0, 0.0


class AgentDrive:
    """A drive that waits for an action at each picture that the client sees; virtual time stands still meanwhile.

    The drive is recorded into the run directory `out`; nothing is recorded if it is None. The constructor drives until
    the vehicle is armed and the client has seen the next picture. Until then, `waiting` decides. The vehicle executes
    none of these actions, except that the last one is repeated from the arming until the next picture.

    Raises `UserError` for an invalid config, and `WorkError` if the vehicle was never armed.
    """

    def __init__(
        self, planned: PlannedRun, out: Path | None, *, waiting: Callable[[AgentView], Action] = neutral
    ) -> None:
        self.planned = planned
        self._out = out
        self._watcher = DriveWatcher()
        self._loop = build_loop(planned, out, watcher=self._watcher)
        driver = self._loop.client.driver
        if not isinstance(driver, AgentDriverNode):
            raise TypeError("the planned run is not driven by an agent")
        self._driver = driver
        self._is_closed = self._is_too_long = False
        try:
            if out is not None:
                (out / CONFIG).write_text(config_text(planned))
            self._arm(waiting)
        except BaseException:
            self._close_loop()
            raise
        self.began_ns = self._loop.runtime.true_ns
        """The virtual time at the end of the constructor."""

    def _arm(self, waiting: Callable[[AgentView], Action]) -> None:
        """Drive until the client sees a picture and knows that the vehicle is armed."""
        session = self._driver.session
        while self._run(ARMING_LIMIT_NS) and self._watcher.has_view:
            if session.phase == "driving":
                self._watcher.rejections = 0
                return
            if session.phase == "stopped":
                break
            self._deliver(*waiting(self.view))
        rejection = self._watcher.rejection
        reason = session.reason or (
            f"commands were rejected: {rejection}" if rejection else "the client saw no picture"
        )
        raise WorkError(f"the vehicle was never armed: {reason}")

    @property
    def view(self) -> AgentView:
        """What the client knew when it saw the newest picture."""
        view = self._driver.view
        if view is None:
            raise RuntimeError("the client has not seen a picture")  # the constructor waits for one
        return view

    @property
    def ending(self) -> str | None:
        """How the drive has ended, `timeout` also after an hour of virtual time; None: it goes on."""
        return "timeout" if self._is_too_long else self._loop.observer.ending

    @property
    def time_s(self) -> float:
        """The virtual time since the end of the constructor."""
        return (self._loop.runtime.true_ns - self.began_ns) / NS_PER_S

    @property
    def route(self) -> Route | None:
        """The centre of the driven lane, if the vehicle has a road."""
        return self._watcher.route

    @property
    def wheelbase_m(self) -> float:
        """The wheelbase of the vehicle."""
        actuator = self._loop.server.actuator
        return self.planned.config.controller.wheelbase_m if actuator is None else actuator.gate.limiter.wheelbase_m

    def act(self, steering_rad: float, speed_mps: float) -> None:
        """Command an angle of the road wheels and a speed, and drive until the next picture or until the ending."""
        self._deliver(steering_rad, speed_mps)
        self._is_too_long = not self._run(RUN_LIMIT_NS)

    def take_truths(self) -> Sequence[GroundTruth]:
        """Return the ground truth since the last call, and at least the newest one; empty before the first one."""
        truths = tuple(self._watcher.truths)
        self._watcher.truths = list(truths[-1:])
        return truths

    def latencies(self) -> dict[str, float]:
        """Return the true latencies in s, NaN where there is none yet.

        `picture_age_s`: now minus the stamp of the newest picture. `video_s`: tau_v of this picture. `control_s`: tau_c
        of the newest accepted command that was the first one from its picture. `loop_s`: from the stamp of that picture
        until this command was applied.
        """
        hosts, true_ns, view = self._loop.runtime.hosts, self._loop.runtime.true_ns, self.view
        server, client = hosts["server"].clock.now_at(true_ns), hosts["client"].clock.now_at(true_ns)
        ahead_ns = server.wall_ns - client.wall_ns
        latencies_ns = {
            "picture_age_s": server.wall_ns - view.stamp_ns,
            "video_s": view.read_wall_ns + ahead_ns - view.stamp_ns,
            "control_s": float("nan"),
            "loop_s": float("nan"),
        }
        applied = self._watcher.first_applied
        if applied is not None and applied.applied_mono_ns is not None:
            latencies_ns["control_s"] = applied.received_wall_ns - ahead_ns - applied.sent_wall_ns
            waited_ns = applied.applied_mono_ns - applied.received_mono_ns
            latencies_ns["loop_s"] = applied.received_wall_ns + waited_ns - applied.stamp_ns
        return {name: latency_ns / NS_PER_S for name, latency_ns in latencies_ns.items()}

    def vehicle_status(self) -> dict[str, Any]:
        """Return what the vehicle does now: safety state, sequence number and limits of the applied command."""
        actuator, applied = self._loop.server.actuator, self._watcher.applied
        return {
            "safety": "" if actuator is None else actuator.gate.state,
            "applied_sequence": -1 if applied is None else applied.sequence,
            "limited": "" if applied is None else applied.limited,
            "rejected_commands": self._watcher.rejections,
        }

    def close(self) -> None:
        """End the drive; if it was recorded, complete the records and write `result.json`."""
        if self._is_closed:
            return
        runtime = self._loop.runtime
        if self._out is not None and self.ending is not None:
            runtime.run(runtime.true_ns + AFTER_ENDING_NS, lambda: False)
        runtime.close()
        self._close_loop()
        if self._out is not None:
            compute_result(self._out, self.planned.identity, self._loop.digest.hexdigest())

    def _close_loop(self) -> None:
        self._is_closed = True
        self._loop.close()

    def _deliver(self, steering_rad: float, speed_mps: float) -> None:
        # No time has passed since the picture was seen, so the action comes before what has arrived since then.
        action = AgentAction(self.view.stamp_ns, steering_rad, speed_mps)
        self._loop.runtime.deliver_first("client", "agent_action", action)

    def _run(self, limit_ns: int) -> bool:
        """Run until the client sees a picture or the drive ends; return False if the limit was reached before."""
        watcher, observer = self._watcher, self._loop.observer
        watcher.has_view = False
        return self._loop.runtime.run(limit_ns, lambda: watcher.has_view or observer.ending is not None)
