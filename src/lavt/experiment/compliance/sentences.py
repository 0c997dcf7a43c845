"""The sentences of the compliance report: what was judged, what was found, and what the numbers mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.compliance.tables import Content, format_bounds, format_share

NO_CERTIFICATION = (
    "This page is a measurement. It is no certification, and it does not say whether a law or a standard is met."
)
VERDICTS = {
    "within": "within: even the upper bound of the value is at most the threshold",
    "above": "above: even the lower bound of the value is above the threshold",
    "not decided": "not decided: the threshold lies between the two bounds, or one of them is unknown",
}


def finding_sentences(content: Content) -> list[str]:
    """Return the findings as sentences: the verdict, the drives that count, and each criterion's value."""
    everything = content["fleet"][0]
    limit = f"{content['limit_ms']:g} ms"
    verdict = everything["verdict"]
    if everything["drives"] == 1:
        summary = f"The drive is {_verdict(content['verdict'])}."
    else:
        summary = (
            f"Verdicts on {everything['drives']} drives: {verdict['within']} within all thresholds, {verdict['above']} "
            f"above at least one, {verdict['not_decided']} not decided."
        )
    sentences = [
        summary,
        (
            f"The frame age was above {limit} for {format_share(everything['above_share'])} of the commanded time"
            f"{_longest_text(everything, content['drives'])}."
        ),
        (
            f"The two-way latency was above {limit} for {format_share(everything['two_way_above_share'])} of the "
            "commanded time."
        ),
        _outage_sentence(everything),
        _manoeuvre_sentence(everything),
        f"The car was faster than the latency allowed for {format_share(everything['too_fast_share'])} of the time.",
    ]
    return [*sentences, *_exclusion_sentences(content)]


def _verdict(verdict: str) -> str:
    return {
        "within": "within all thresholds",
        "above": "above at least one threshold",
        "not decided": "not decided: no value is certainly above its threshold, but not all are certainly within",
    }[verdict]


def _longest_text(everything: Mapping[str, Any], drives: Sequence[Mapping[str, Any]]) -> str:
    bounds = everything["longest_above_s"]
    if bounds[1] == 0:
        return ""
    longest = max(drives, key=lambda drive: (drive["longest_above_s"][0], drive["longest_above_s"][1] or 1e9))
    began = longest["longest_above_began_s"]
    where = f", from {began:.2f} s of the drive {longest['run']} on" if began is not None else ""
    return f". The longest stretch took {format_bounds(bounds, digits=2)} s{where}"


def _outage_sentence(everything: Mapping[str, Any]) -> str:
    if not everything["outages"]:
        return "There was no outage."
    return (
        f"There {_were(everything['outages'], 'outage')} of {everything['outage_s']:.2f} s in total; the longest took "
        f"{everything['longest_outage_s']:.2f} s."
    )


def _manoeuvre_sentence(everything: Mapping[str, Any]) -> str:
    if not everything["manoeuvres"]:
        return "There was no minimal-risk manoeuvre."
    length = format_bounds(everything["longest_manoeuvre_s"], digits=2)
    return f"There {_were(everything['manoeuvres'], 'minimal-risk manoeuvre')}; the longest took {length} s."


def _were(count: int, noun: str) -> str:
    return f"was 1 {noun}" if count == 1 else f"were {count} {noun}s"


def _exclusion_sentences(content: Content) -> list[str]:
    count = len(content["excluded"])
    if not count:
        return []
    return [f"{count} more {'drive does' if count == 1 else 'drives do'} not count; the table below has the reasons."]


def setting_sentences(content: Content) -> list[str]:
    """Return what was judged: kinds of time, fidelity, from where the age counts, and where speeds come from."""
    drives = content["drives"]
    sentences = []
    times = Counter(str(drive["time"]) for drive in drives)
    kinds = " and ".join(f"{count} in {kind} time" for kind, count in sorted(times.items()))
    sentences.append(f"Drives: {kinds}.")
    without_pictures = sum(drive["fidelity"] == "geometry" for drive in drives)
    if without_pictures:
        sentences.append(
            f"{without_pictures} had no pictures (fidelity geometry): their latencies are those of the same "
            "stages without an encoder."
        )
    from_stamp = sum(drive["age_from"] == "stamp" for drive in drives)
    if from_stamp:
        camera_ms = content["camera_ms"]
        known = (
            "The time before the stamp is unknown, so nothing can be within the limit: give --camera-ms."
            if camera_ms is None
            else f"The time before the stamp is assumed to be between 0 and {camera_ms:g} ms."
        )
        sentences.append(
            f"The camera of {from_stamp} of the drives did not report the exposure of every frame. {known}"
        )
    sources = sorted({str(drive["speed_source"]) for drive in drives})
    sentences.append(f"The speed is {' or '.join(source or 'unknown' for source in sources)}.")
    nominal = sorted({round(drive["nominal_kmh"], 1) for drive in drives})
    speeds = f"{nominal[0]:g}" if len(nominal) == 1 else f"{nominal[0]:g} to {nominal[-1]:g}"
    sentences.append(f"The nominal speed is {speeds} km/h.")
    later = sum(drive["drives_in_record"] > 1 for drive in drives)
    if later:
        sentences.append(f"The records of {later} drives have further drives, which are not judged: only the first is.")
    return sentences


def terms(content: Content) -> list[tuple[str, str]]:
    """Return the terms of the page with their meanings."""
    limit = f"{content['limit_ms']:g} ms"
    return [
        (
            "Frame age",
            "at a moment, the time since the exposure of the frame from which the command in force was made.",
        ),
        (
            "Two-way latency",
            "of the command in force: from the exposure of its frame until the driver had the frame, plus from the "
            "sending of the command until it was applied. The driver's own time is left out. In an outage, in which "
            "nothing arrives, it is the frame age.",
        ),
        (
            "Commanded time",
            "the time of the drive in which the vehicle followed the driver's commands (states driving and degraded). "
            "All shares are of this time.",
        ),
        (
            "Outage",
            f"no command from a newer frame arrived for more than {content['outage_ms']:g} ms. It lasts from the last "
            "such command to the next, or to the end of the commanded time.",
        ),
        (
            "Minimal-risk manoeuvre",
            "a safe stop or an emergency stop of a commanded vehicle, until standstill.",
        ),
        ("Blind distance", "speed x frame age: how far the car drove since the frame was exposed."),
        (
            "Faster than allowed",
            f"the speed is above the nominal speed or, while the frame age is above {limit}, above nominal speed x "
            f"{limit} / frame age. Then the blind distance is longer than the limit nominal speed x {limit}.",
        ),
        (
            "Bounds",
            "a single number is exact: between commands, the frame age grows by 1 s in a second, so nothing is "
            "sampled, and no clock offset is needed. The speed is known at its reports only; between them it changes "
            "by at most 10 m/s².",
        ),
        *((name, meaning.partition(": ")[2] + ".") for name, meaning in VERDICTS.items()),
        (
            "95 % interval",
            "for drives like these; its unit is the drive. Drives of one route, vehicle or network are alike, so it is "
            "too narrow for others.",
        ),
    ]
