"""The results of the round trips: percentiles, stages, summaries over rounds, ratios, tables and goals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from benchmarks.round_trip.carriers import CARRIERS

from lavt.errors import WorkError

PACE_LABELS: Final = {"at_50_hz": "50 Hz", "back_to_back": "back to back"}
PERCENTILES: Final = (50, 95, 99)
STAGES: Final = {
    "encode": "encode the command (msgpack), before the round trip",
    "sign": "gateway: sign, twice",
    "carry": "carrier, twice: until the listening thread has the message",
    "send": "... of which in the sending call",
    "in_zenoh": "... of which between Zenoh's stamps for sending and receiving",
    "woken": "... of which from Zenoh's stamp for receiving until Python's thread runs",
    "verify": "gateway: filter and verify, twice",
    "hand_over": "from the listening thread to the node's thread, twice",
    "decode": "decode the command, after the echo",
}
MAX_UDP_RATIO: Final = 3.0
"""The goal for the embedded routers."""

PaceResults = dict[str, dict[str, float]]
"""For each pace, percentiles of the round trip in microseconds and the number of lost echoes. `stages` has the medians
of the stages in microseconds."""


def run_results(carrier: str, asked: Mapping[str, Any], echoed: Mapping[str, Mapping[str, int]]) -> PaceResults:
    """Return the results of one run from the stamps of both processes."""
    results: PaceResults = {
        pace: percentiles(carrier, [None if one is None else one["handed"] - one["encoded"] for one in asked[pace]])
        for pace in PACE_LABELS
    }
    pairs = [(one, echoed[str(one["sequence"])]) for one in asked["at_50_hz"] if one and str(one["sequence"]) in echoed]
    stages = [message_stages(one, other) for one, other in pairs]
    results["stages"] = {
        stage: round(float(np.median([message[stage] for message in stages])) / 1000, 1) if stages else 0.0
        for stage in STAGES
    }
    return results


def message_stages(asked: Mapping[str, int], echoed: Mapping[str, int]) -> dict[str, int]:
    """Return the durations in nanoseconds of the stages of one round trip, both directions together.

    The sum of sign, carry, verify and hand-over is the round trip.
    """
    return {
        "encode": asked["encoded"] - asked["begin"],
        "sign": asked["signed"] - asked["encoded"] + echoed["signed"] - echoed["handed"],
        "carry": echoed["arrived"] - asked["signed"] + asked["arrived"] - echoed["signed"],
        "send": asked["sent"] - asked["signed"] + echoed["sent"] - echoed["signed"],
        "in_zenoh": asked["in_zenoh"] + echoed["in_zenoh"],
        "woken": asked["woken"] + echoed["woken"],
        "verify": echoed["verified"] - echoed["arrived"] + asked["verified"] - asked["arrived"],
        "hand_over": echoed["handed"] - echoed["verified"] + asked["handed"] - asked["verified"],
        "decode": echoed["decode"],
    }


def percentiles(carrier: str, times_ns: Sequence[int | None]) -> dict[str, float]:
    """Return percentiles of the round trip in microseconds and the number of lost echoes, which are None in `times_ns`.

    Raise `WorkError` if all echoes were lost.
    """
    received_ns = [time_ns for time_ns in times_ns if time_ns is not None]
    if not received_ns:
        raise WorkError(f"{carrier} lost every echo")
    values = np.percentile(received_ns, PERCENTILES) / 1000
    named = {f"p{rank}_us": round(float(value), 1) for rank, value in zip(PERCENTILES, values, strict=True)}
    return {**named, "lost": len(times_ns) - len(received_ns)}


def summary(rounds: Mapping[str, Sequence[PaceResults]]) -> dict[str, Any]:
    """Return medians and ranges over the rounds by carrier and pace, and ratios to raw UDP if it was measured.

    A ratio is the median over the ratios within one round, because a shared host changes its speed between rounds.
    """
    medians: dict[str, Any] = {}
    for carrier, carrier_rounds in rounds.items():
        medians[carrier] = {pace: _pace_summary(pace, carrier_rounds, rounds.get("udp", [])) for pace in PACE_LABELS}
        stages = [results["stages"] for results in carrier_rounds if "stages" in results]
        if stages:
            medians[carrier]["stages"] = {stage: _median(one[stage] for one in stages) for stage in STAGES}
    return medians


def _pace_summary(pace: str, rounds: Sequence[PaceResults], udp_rounds: Sequence[PaceResults]) -> dict[str, Any]:
    values: dict[str, Any] = {name: _median(results[pace][name] for results in rounds) for name in rounds[0][pace]}
    values["lost"] = sum(results[pace]["lost"] for results in rounds)
    for rank in PERCENTILES:
        name = f"p{rank}_us"
        times = [results[pace][name] for results in rounds]
        values[f"p{rank}_range_us"] = [min(times), max(times)]
        ratios = [time / udp[pace][name] for time, udp in zip(times, udp_rounds, strict=False)]
        if ratios:
            values[f"p{rank}_ratio"] = round(_median(ratios), 2)
    return values


def _median(values: Iterable[float]) -> float:
    return round(float(np.median(list(values))), 3)


def cell(values: Mapping[str, Any], rank: int) -> str:
    """Return a percentile with its range and its ratio to raw UDP."""
    low, high = values.get(f"p{rank}_range_us", (None, None))
    spread = "" if low is None else f" ({low:.0f} to {high:.0f})"
    ratio = values.get(f"p{rank}_ratio")
    return f"{values[f'p{rank}_us']:.0f}{spread}" + ("" if ratio is None else f", {ratio:.2f} x")


def carriers_table(medians: Mapping[str, Any]) -> str:
    """Return the table of carriers: median (range over the rounds), ratio to raw UDP."""
    heads = ["round trip in us", *(f"{label}: p{rank}" for label in PACE_LABELS.values() for rank in (50, 99)), "lost"]
    rows = [
        [
            CARRIERS[carrier].label,
            *(cell(by_pace[pace], rank) for pace in PACE_LABELS for rank in (50, 99)),
            f"{sum(by_pace[pace]['lost'] for pace in PACE_LABELS):.0f}",
        ]
        for carrier, by_pace in medians.items()
    ]
    return markdown(heads, rows)


def stages_table(medians: Mapping[str, Any]) -> str:
    """Return the table of stages at 50 Hz, of the carriers that were measured."""
    names = [
        name
        for name in ("udp", "embedded", "embedded_stamps", "embedded_secure", "separate")
        if "stages" in medians.get(name, {})
    ]
    rows = [
        [label, *(f"{value:.1f}" if (value := medians[name]["stages"][stage]) else "" for name in names)]
        for stage, label in STAGES.items()
    ]
    return markdown(["stage at 50 Hz, median in us", *(CARRIERS[name].label for name in names)], rows)


def variants_table(medians: Mapping[str, Any]) -> str:
    """Return the differences of the variants from the embedded routers; empty without them."""
    base = medians.get("embedded")
    variants = [name for name in medians if CARRIERS[name].is_variant or name == "separate"]
    if base is None or not variants:
        return ""
    heads = [
        "difference in us from embedded routers",
        *(f"{label}: p50" for label in PACE_LABELS.values()),
        "50 Hz: p99",
    ]
    columns = [("at_50_hz", "p50_us"), ("back_to_back", "p50_us"), ("at_50_hz", "p99_us")]
    rows = [
        [CARRIERS[name].label, *(f"{medians[name][pace][rank] - base[pace][rank]:+.0f}" for pace, rank in columns)]
        for name in variants
    ]
    return markdown(heads, rows)


def goals(medians: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each goal: ahead of CycloneDDS, and at most 3 x raw UDP, at 50 Hz."""
    embedded = medians.get("embedded")
    if embedded is None:
        return ["goals: embedded routers were not measured"]
    sentences = []
    for rank in (50, 99):
        own, name = embedded["at_50_hz"], f"p{rank}_us"
        if "cyclonedds" in medians:
            other = medians["cyclonedds"]["at_50_hz"][name]
            verdict = "met" if own[name] < other else "missed"
            sentences.append(f"p{rank}: {own[name]:.0f} us, CycloneDDS {other:.0f} us: {verdict}")
        if "udp" in medians:
            ratio = own[f"p{rank}_ratio"]
            verdict = "met" if ratio <= MAX_UDP_RATIO else "missed"
            sentences.append(f"p{rank}: {ratio:.2f} x raw UDP, at most {MAX_UDP_RATIO:.0f} x: {verdict}")
        if "udp_direct" in medians:
            ratio = own[name] / medians["udp_direct"]["at_50_hz"][name]
            sentences.append(f"p{rank}: {ratio:.2f} x raw UDP read without a second thread")
    return [f"goal at 50 Hz, {sentence}" for sentence in sentences]


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))
