"""Tests of Delta in virtual time, where the true times of both hosts' clocks are known to the nanosecond."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.experiment.analysis.metrics import RunMeasurement, measure
from lavt.experiment.analysis.results import run_result
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import VirtualLoop, build_loop, drive
from lavt.recording.record import read_record
from lavt.runtime.virtual import HostClock, VirtualHost, modelled_clock_source
from lavt.transport.clock_sync.clock_report import ClockReport, unknown_clock

Change = Callable[[VirtualLoop], None]
CLOCK_ERRORS = ("clocks.offset_ms=250.0", "clocks.drift_ppm=30.0")


def drive_with(
    out: Path, *changes: str, change: Change = lambda _: None
) -> tuple[RunMeasurement, dict[str, Any], HostClock]:
    """Drive without pixels; return the measurement, `result.json`, and the server's clock (the client's is true)."""
    planned = plan_run(
        load_config(RunConfig, shipped("configs/demo.yaml"), ("fidelity=geometry", *CLOCK_ERRORS, *changes))
    )
    loop = build_loop(planned, out)
    change(loop)
    drive(loop)
    server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
    result = run_result(planned.identity, server, client)
    return measure(server, client), result, loop.runtime.hosts["server"].clock


def errors_ms(measured: RunMeasurement, offset: ClockOffset | None, server: HostClock) -> tuple[Any, Any]:
    """Return the absolute error of Delta every 10 ms of the drive, and the bound of Delta at the same times."""
    assert offset is not None
    began_ns, ended_ns = measured.clocks.client_wall_ns.tolist()
    client_wall_ns = np.arange(began_ns, ended_ns, 10 * NS_PER_MS)
    true_ns = client_wall_ns - server.wall_start_ns
    truth_ns = np.array([server.now_at(at_ns).wall_ns for at_ns in true_ns.tolist()]) - client_wall_ns
    delta_error_ns = np.abs(offset.at(client_wall_ns) - truth_ns)
    return delta_error_ns / NS_PER_MS, offset.bound_at(client_wall_ns) / NS_PER_MS


def remove_time_sources(loop: VirtualLoop) -> None:
    def install(host: VirtualHost) -> None:
        def unknown(true_ns: int) -> ClockReport:
            return unknown_clock(host.clock.now_at(true_ns), host.side, "chrony", "chrony is not installed")

        host.clock_source = unknown

    for host in loop.runtime.hosts.values():
        install(host)


def test_both_estimates_are_within_their_bounds(tmp_path: Path) -> None:
    """With a server clock 250 ms ahead that drifts by 30 ppm, both clock estimates are within their bounds."""
    measured, result, server = drive_with(tmp_path / "run")
    for offset in (measured.clocks.offset, measured.clocks.probe):
        delta_error_ms, bound_ms = errors_ms(measured, offset, server)
        assert (delta_error_ms <= bound_ms).all()
        assert delta_error_ms.max() < 1.0
        assert bound_ms.max() < 2.0
    delta = result["delta"]
    assert delta["source"] == "model"
    assert delta["ms"] == pytest.approx(250.0, abs=1.0)
    assert delta["drift_ppm"] == pytest.approx(30.0, abs=0.1)
    assert delta["bound_ms"] == result["tau_v_ms"]["bound"] == result["tau_c_ms"]["bound"]
    assert result["valid"], result["invalid_reasons"]


def test_the_probe_alone_with_injected_delay(tmp_path: Path) -> None:
    """Without time sources and under L5, the probe's Delta is within its bound, and tau_v and tau_c are correct."""
    _, with_sources, _ = drive_with(tmp_path / "sources", "network.condition=L5")
    measured, result, server = drive_with(tmp_path / "probe", "network.condition=L5", change=remove_time_sources)
    delta_error_ms, bound_ms = errors_ms(measured, measured.clocks.offset, server)
    assert (delta_error_ms <= bound_ms).all()
    assert bound_ms.max() <= 2.0
    assert result["delta"]["source"] == "probe"
    assert result["valid"], result["invalid_reasons"]
    for name in ("tau_v_ms", "tau_c_ms"):
        assert result[name]["p50"] == pytest.approx(with_sources[name]["p50"], abs=result[name]["bound"])


def test_a_wrong_time_source_is_contradicted_by_the_probe(tmp_path: Path) -> None:
    """A time source that is wrong by 37.5 ms contradicts the probe, and the run is invalid.

    NTP makes such an error if one direction is delayed by 75 ms.
    """

    def use_wrong_source(loop: VirtualLoop) -> None:
        host = loop.runtime.hosts["client"]
        host.clock_source = modelled_clock_source(host.clock, "virtual-client", 0.0375, 0.0001)

    _, result, _ = drive_with(tmp_path / "run", change=use_wrong_source)
    (reason,) = result["invalid_reasons"]
    assert reason["code"] == "clock_disagreement"
    offset_ms = float(reason["text"].partition("clocks: ")[2].split()[0])
    assert offset_ms == pytest.approx(250 + 37.5, abs=1.0)


def test_a_probe_without_answers_makes_the_run_invalid(tmp_path: Path) -> None:
    """If a firewall blocks the probe, Delta is unchecked, and the run is invalid."""

    def block(loop: VirtualLoop) -> None:
        loop.runtime.links["probe_reply"].open = False

    _, result, _ = drive_with(tmp_path / "run", change=block)
    (reason,) = result["invalid_reasons"]
    assert reason["code"] == "clock_unchecked"
    assert (result["delta"]["probe_ms"], result["delta"]["probe_bound_ms"]) == (None, None)


@pytest.mark.parametrize("has_time_sources", [True, False])
@pytest.mark.parametrize("side", ["client", "server"])
def test_a_clock_step_has_one_reason(tmp_path: Path, side: str, has_time_sources: bool) -> None:
    """If a wall clock steps by 1 s during the drive, the step is the only reason why the run is invalid."""

    def step(loop: VirtualLoop) -> None:
        if not has_time_sources:
            remove_time_sources(loop)
        loop.runtime.hosts[side].clock.steps = [(10 * NS_PER_S, NS_PER_S)]

    _, result, _ = drive_with(tmp_path / "run", change=step)
    (reason,) = result["invalid_reasons"]
    assert reason["code"] == "clock_step"
    assert f"the {side} stepped by +1000.0 ms" in reason["text"]
