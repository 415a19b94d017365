"""Every sentence for people about a run, keyed by the enum or the column that says the same to programs.

Words are made here, at the edge, and nothing reads them back: whatever stands here may be reworded without a figure,
a column or a verdict changing (`tests/replay/test_rewording.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from schemas.enums import LostTo, MisfitCause, MisfitPlace, Note, Reason, Remedy

BETWEEN = "; "
"""What stands between the notes of a run; no note holds it itself."""

# How many losses a sentence names; from which share on.
_NAMED = 3
_LEAST_SHARE = 0.005
_CENTIMETRE_M = 0.01

NOTES: dict[Note, str] = {
    Note.CORRECTED: "{}",
    Note.CHUNKS_WITHOUT_CRC: "{} chunks without a checksum",
    Note.FILES_WITHOUT_CRC: "without checksums: {}",
    Note.TOPICS_NOT_USED: "topics not used: {}",
    Note.MISFIT: "does not fit: {}",
    Note.MISFIT_MENDED: "does not fit: {}. `balise inspect RUN --site SITE` prints the lines that correct it",
    Note.FAULTS_INJECTED: "faults were injected: {}",
    Note.BALISES_OFF: "balises off their net element, so that no run passes them (`balise inspect SITE` says why): {}",
    Note.FAR_OFF: "{} positions left out: their time is more than a day from the others",
    Note.PLACEHOLDERS: "{} positions are placeholders (0/0, a default place, or before the first fix): epochs without "
    "a fix",
    Note.CONTRADICTING: "{} positions left out: another position with the same time lies elsewhere, and the first "
    "recorded one is used. Record two receivers of one topic as two solutions",
    Note.ODOMETER_ENDS_FIRST: "the odometer ends before the GNSS",
    Note.ODOMETER_BEGINS_LATE: "the odometer begins after the GNSS",
    Note.GNSS_ENDS_FIRST: "the GNSS ends before the odometer",
    Note.GNSS_BEGINS_LATE: "the GNSS begins after the odometer",
    Note.ODOMETER_LEAPS: "the odometer's distance jumps by more than a train can drive, {} times, first at {}: its "
    "speed is used there, and without an agreeing speed the distance is unknown",
    Note.ODOMETER_SLOW: "the odometer has only one row every {:.3g} s: where the speed changes between rows, alarms "
    "along the track may come from the odometer",
    Note.ODOMETER_REVERSED: "the odometer counts down at first, so the train reverses: the sign of "
    "gnss_antenna_ahead_m is changed",
    Note.COVARIANCE: "cov_en_m2 is impossible with its variances at {} epochs and is not used there",
    Note.AMBIGUOUS: "net element ambiguous: {}. Give the route of `--write-route` with `--route` if you know it to be "
    "true: what was lost there was lost to track doubt",
    Note.UNLINKED: "after {} outages the position could not be re-linked and was not used: {}",
    Note.UNKNOWN_TELEGRAMS: "telegrams read from balises that are not on the train's path: {}",
    Note.ROWS_SCATTER: "the odometer's rows scatter by {:.2f} m (coarse counter, or times stamped on receipt): the "
    "thresholds along the track allow for it",
    Note.ROWS_SCATTER_TOO_MUCH: "the odometer's rows scatter by more than {:.1f} m (coarse counter, or times stamped "
    "on receipt): thresholds wide enough for that would miss failures, so alarms along the track may come from the "
    "odometer",
    Note.DIGITS: "positions are rounded so much that they scatter by {:.2f} m (few decimals, or single precision): the "
    "thresholds allow for it",
    Note.READS_DISPUTED: "balise reads contradict the reference {} times: the true position is unknown there. Check "
    "both clocks",
    Note.READS_UNREACHABLE: "no train can have come from one balise read (or end of the reference) to the next {} "
    "times: the true position is unknown before, between and after them. Check the reads, and the links of the site",
    Note.NO_EVIDENCE: "no evidence: no stream can show whether a position was right or wrong",
    Note.EVIDENCE_BALISE: "evidence balise: the true position comes from balise reads, and from the odometer between "
    "them. Slip, slide and scale errors that cancel each other between two reads are not seen, and after the last read "
    "the odometer is trusted to 5 m + 5 %",
    Note.EVIDENCE_ODOMETER: "evidence odometer: the distance from the last accepted balise can show that a position "
    "was wrong, never that it was right",
    Note.UNKNOWN_SHARE: "{:.1%} of the moving time in use could not be judged",
    Note.ODOMETER_CONTRADICTED: "the odometer's distance does not fit {} gaps between known places: odometer or "
    "vehicle file is wrong there",
    Note.LEARNED: "no odometer scale in a vehicle file: scale and latency are learned in the run and widen the "
    "thresholds, so that a drift at its beginning may not be seen",
    Note.UNDIAGNOSED: "{} virtual balises accepted without a monitor along the track ({}): a jump or drift along it is "
    "not seen there",
    Note.MOVING_UNKNOWN: "for {:.0f} s it is not known whether the train moved: availability counts this time as "
    "moving without a TVB",
    Note.AVAILABLE: "available for {:.0%} of the moving time, the rest lost to: {}",
    Note.OFF_TRACK: "positions off the track, usually {:.0f} m beside it",
    Note.REMEDY: "to mend it: {}",
}

REASONS: dict[Reason, str] = {
    Reason.ACCEPTED_WRONG: "VBs accepted despite a wrong position: {unsafe_accepted}",
    Reason.FAILURE_BEYOND_BUDGET: "position failures in use for longer than allowed: {failures_beyond_budget}",
    Reason.HAZARDOUS_SUM: "wrong positions in use for {hazardous_s} s in all, more than is allowed per hour",
    Reason.ACCEPTED_UNKNOWN: "VBs accepted that nothing can check: {unproven_accepted}",
    Reason.BUDGET_UNKNOWN: "position failures of unknown length: {failures_undecided}",
    Reason.UNKNOWN_IN_USE: "positions in use without a check for {unknown_in_use_s} s while moving",
    Reason.NOT_DIAGNOSED: "positions in use without diagnosis for {share_undiagnosed} of the moving time in use",
    Reason.NOTHING_ACCEPTED: "no VB was accepted",
    Reason.EVIDENCE_DISPUTED: "the evidence contradicts itself, as the notes say",
    Reason.INPUT_DOUBTFUL: "its streams do not fit each other, as the notes say",
    Reason.CLOCK_ASSUMED: "the clock of the evidence is assumed, not measured",
}
NO_REASON = "every acceptance right, every position failure within the time allowed"

CAUSES: dict[MisfitCause, str] = {
    MisfitCause.UNIT: "in {}",
    MisfitCause.WHEEL: "a wheel diameter that is set wrongly",
    MisfitCause.PULSES: "pulses, or a unit that this program does not know",
    MisfitCause.SCALE_OF_FILE: "the vehicle file is of another vehicle or out of date, or the GNSS drifts over the "
    "whole run",
    MisfitCause.LATENCY_OF_FILE: "the vehicle file is of another vehicle or out of date, or the GNSS drifts over the "
    "whole run",
    MisfitCause.IMPOSSIBLE_SCALE: "no odometer has such a scale",
    MisfitCause.COUNTS_BACKWARDS: "the {} counts backwards",
    MisfitCause.SPEED_WITHOUT_SIGN: "it stays positive where the distance falls",
    MisfitCause.COUNTER_WITHOUT_SIGN: "a counter without sign",
    MisfitCause.SIGN_OF_SOMETHING_ELSE: "the sign follows something else than the movement",
    MisfitCause.OFFSET_OF_REFERENCE: "another datum, or a fixed offset between the two antennas",
    MisfitCause.WHOLE_SECONDS: "cut off or rounded by the recorder, so that at 40 m/s a balise may have been read 40 m "
    "away",
    MisfitCause.DATUM: "the survey is in {}, EPSG:{}, not in WGS 84",
    MisfitCause.DATUM_LIKELY: "the survey may be in {}, EPSG:{}, not in WGS 84",
    MisfitCause.MAP_SHIFT: "a datum or map shift, or an antenna far from the track's middle",
    MisfitCause.MAP_SHIFT_BY_REFERENCE: "the reference lies where they do: a datum or map shift",
    MisfitCause.HEIGHT_UNIT: "heights of the {} are in {}",
    MisfitCause.HEIGHT_ZERO: "one of the two is above the sea (geoid), the other above the ellipsoid",
    MisfitCause.HEIGHT_UNKNOWN: "another unit or another zero of the heights",
    MisfitCause.COPY: "it is a copy of the solution, which would judge itself",
    MisfitCause.OTHER_PLACE: "run and site of different places",
    MisfitCause.VELOCITY_EXCHANGED: "east and north are exchanged",
    MisfitCause.VELOCITY_SIGN: "{} of the wrong sign",
    MisfitCause.VELOCITY_FRAME: "latitude and longitude may be exchanged, or the axes are of the train",
    MisfitCause.VELOCITY_DOWN: "the vertical velocity counts down",
    MisfitCause.GPS_AS_UTC: "GPS time taken as UTC",
    MisfitCause.TAI_AS_GPS: "TAI taken as GPS time",
    MisfitCause.TAI_AS_UTC: "TAI taken as UTC",
    MisfitCause.TIME_ZONE: "a time zone or summer time: {}",
    MisfitCause.GPS_WEEK: "a roll-over of the GPS week: {}",
    MisfitCause.WRONG_WEEK: "a wrong week: {}",
    MisfitCause.WRONG_DAY: "a wrong day, or a roll-over of it: {}",
    MisfitCause.DAY_AND_MONTH: "day and month exchanged",
    MisfitCause.CONSTANT_LAG: "a constant lag: a clock that was not set",
    MisfitCause.LATENCY: "positions arrive too old",
    MisfitCause.STAMPED_LATE: "one of the two is stamped too late, or the positions are off",
    MisfitCause.STAMPED_EARLY: "one of the two is stamped too early, or the positions are off",
    MisfitCause.AXES_EXCHANGED: "latitude and longitude are exchanged",
    MisfitCause.LONGITUDE_SIGN: "longitude has the wrong sign",
    MisfitCause.LATITUDE_SIGN: "latitude has the wrong sign",
    MisfitCause.BOTH_SIGNS: "latitude and longitude have the wrong sign",
    MisfitCause.RADIANS: "positions are in radians",
    MisfitCause.MINUTES: "positions are degrees and minutes (ddmm.mm of NMEA), written as decimal degrees",
}

MISFIT_PLACES: dict[MisfitPlace, str] = {
    MisfitPlace.IN_STREAM: "in the {}",
    MisfitPlace.RATHER_IN_STREAM: "rather in the {} than in the {}",
    MisfitPlace.IN_SURVEY: "in the survey: odometer, velocity or reference fit the positions as they are",
    MisfitPlace.IN_REFERENCE: "in the reference",
    MisfitPlace.OR_VELOCITY: "or the velocity has exchanged axes or signs",
}

LOST: dict[LostTo, str] = {
    LostTo.NO_POSITION: "no position on the track",
    LostTo.NO_ODOMETER: "no odometer",
    LostTo.TRACK_AMBIGUOUS: "positions that fit more than one track",
    LostTo.CONFIDENCE: "confidence intervals over the limit",
    LostTo.ALARM: "alarms",
    LostTo.NOISE: "noise not yet known, or too large to monitor",
    LostTo.SLIP: "slip that the odometer reports",
    LostTo.RELINK: "waiting for a re-link",
}
LOST_OTHERWISE = "not validated (initialisation, short losses, monitors switched off)"

REMEDIES: dict[Remedy, str] = {
    Remedy.CALIBRATE: "measure noise and odometer on two or more other fault-free runs of this vehicle: "
    "`balise replay {run} --site {site} --out {out}{options} --calibrate 'OTHER_RUNS/*'`",
    Remedy.VEHICLE_FILE: "measure the odometer on two or more other fault-free runs of this vehicle: "
    "`balise replay {run} --site {site} --out {out}{options} --calibrate 'OTHER_RUNS/*'`",
    Remedy.REFERENCE: "add a reference to the run: `balise convert REFERENCE --to {run} --stream reference`",
    Remedy.READS_AT_ENDS: "record balise reads near both ends of the run, within 300 m of them",
    Remedy.READS_CLOSER: "record balise reads closer to each other, every 2 km",
    Remedy.ROUTE: "name the track that the train took: "
    "`balise replay {run} --site {site} --out {out}{options} --route ROUTES` "
    "(--write-route ROUTES writes what was found)",
    Remedy.CLOCK: "set the recorders to one clock: `balise inspect {run} --site {site}{options}` shows their lags",
    Remedy.ODOMETER: "record an odometer: without one nothing along the track is monitored",
    Remedy.FASTER_LOG: "log positions more often, at 10 Hz",
    Remedy.SURVEY_SIGMA: "state the survey's accuracy: column sigma_m in the track of {site}",
}


@dataclass(frozen=True)
class Remark:
    """A note with its figures or names, in the order in which its words take them."""

    note: Note
    figures: tuple[object, ...] = ()

    @property
    def words(self) -> str:
        return NOTES[self.note].format(*self.figures)


def remarks(found: Mapping[Note, object]) -> list[Remark]:
    """The notes of what there is: falsy means that there is nothing to say; a tuple holds several figures."""
    return [Remark(note, value if isinstance(value, tuple) else (value,)) for note, value in found.items() if value]


def notes_text(noted: Iterable[Remark]) -> str | None:
    """All notes as they stand in `runs.notes`."""
    return BETWEEN.join(remark.words.replace(BETWEEN, ", ") for remark in noted) or None


def notes_apart(notes: str | None) -> list[str]:
    """The same one by one, to show each on a line of its own."""
    return notes.split(BETWEEN) if notes else []


def lost_words(
    lost_to: Sequence[str] | None, shares: Sequence[float] | None, monitor: str | None, lost_share: float | None = None
) -> str:
    """What moving time was lost to, the largest first: `82 % alarms (mostly along_raw), 3 % no odometer`.

    `lost_share`: of all that was lost; what none of the causes explains is named last.
    """
    found = list(zip(lost_to or (), shares or (), strict=True))
    beside = {LostTo.ALARM: f" (mostly {monitor})"} if monitor else {}
    named = [
        f"{share:.0%} {LOST[LostTo(cause)]}{beside.get(LostTo(cause), '')}"
        for cause, share in found[:_NAMED]
        if share >= _LEAST_SHARE
    ]
    rest = 0.0 if lost_share is None else lost_share - sum(share for _, share in found)
    return ", ".join([*named, *([f"{rest:.0%} {LOST_OTHERWISE}"] if rest >= _LEAST_SHARE else [])])


def reason_words(run: Mapping[str, Any]) -> str:
    """Why a `runs` row has its verdict, one reason after the other, with its figures."""
    undecided = run["failures"] - run["failures_within_budget"] - run["failures_beyond_budget"]
    figures = {
        **{name: run[name] for name in ("unsafe_accepted", "unproven_accepted", "failures_beyond_budget")},
        "failures_undecided": undecided,
        **{name: f"{run[name] or 0.0:.3g}" for name in ("hazardous_s", "unknown_in_use_s")},
        "share_undiagnosed": f"{run['share_undiagnosed'] or 0.0:.1%}",
    }
    return "; ".join(REASONS[Reason(reason)].format(**figures) for reason in run["reasons"] or ()) or NO_REASON


def part_words(run: Mapping[str, Any]) -> str:
    """`safe from 12:00:03 to 12:41:50, 92% of the moving time`: the verdict between first and last anchor, where it is
    another than the run's.
    """
    if run["part_verdict"] in (None, run["verdict"]):
        return ""
    clock = "%H:%M:%S"
    return (
        f"{run['part_verdict']} from {run['part_from']:{clock}} to {run['part_to']:{clock}}, "
        f"{run['part_share']:.0%} of the moving time"
    )


def beside_words(run: Mapping[str, Any]) -> str:
    """What stands beside every verdict: balises accepted of those on the path, availability, proof margin."""
    accepted = f"{run['balises_accepted']} of {run['balises_on_path']} balises accepted"
    available = run["availability"]
    margin_m = run["proof_margin_m"]
    told = "the train did not move" if available is None else f"available for {available:.0%} of the moving time"
    return ", ".join([accepted, told, *([] if margin_m is None else [f"proof margin {margin_m:.1f} m"])])


NOISE_AXES: dict[str, str] = {"along": "along the track", "cross": "across it", "up": "of the height"}


def noise_words(widened: Mapping[str, tuple[float, float]]) -> str:
    """What measured noise does to the thresholds: by axis, raw threshold over the model's, and the white noise [m]."""
    told = [f"{NOISE_AXES[axis]} {ratio:.1f} times (white noise {_short(noise_m)})" for axis, (ratio, noise_m) in
            widened.items()]  # fmt: skip
    return f"raw thresholds at the end against the model's: {', '.join(told)}" if told else ""


def _short(length_m: float) -> str:
    return f"{1000.0 * length_m:.0f} mm" if length_m < _CENTIMETRE_M else f"{100.0 * length_m:.0f} cm"


PLACES: dict[str, str] = {"run": "RUN", "site": "SITE", "out": "OUT", "options": ""}
"""What a command names where nobody knows the paths."""


def remedy_words(remedy: Remedy | str, **places: str) -> str:
    """What would mend it, with the command that does; `places`: paths known where it is shown."""
    return REMEDIES[Remedy(remedy)].format(**PLACES | places)
