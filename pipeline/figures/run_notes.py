"""What the reader of a `runs` row should know beside its figures, in words."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

import polars as pl

from pipeline.ingest.clean import StreamCounts
from pipeline.lds.relink import UNLINKED
from pipeline.lds.run import LdsResult
from pipeline.matching import Match
from pipeline.matching.fixes import contradictory_covariances
from pipeline.odometry import Odometry
from pipeline.plausibility.fit import Fit
from pipeline.site.checks import BALISE_PLACE
from schemas.arrays import NS_PER_S
from schemas.config import Vehicle
from schemas.run import RunLog, Site

_SHOWN = 5


def run_notes(
    run: RunLog,
    site: Site,
    counts: StreamCounts,
    fixes: pl.DataFrame,
    found: Match,
    lds: LdsResult,
    vehicle: Vehicle,
    odometry: Odometry | None,
    straight_s: float,
    fit: Fit,
) -> tuple[str, ...]:
    """Notes on what went in and what matching and the LDS made of it.

    `counts`, `fixes`: the GNSS of this solution. `straight_s`: rows of an odometer may be so far apart [s].
    """
    return (
        *_misfits(fit),
        *_injected(run),
        *_off_the_track(site),
        *_stamps(counts),
        *_extents(run),
        *_odometer(odometry, straight_s),
        *_positions(fixes, found, vehicle),
        *_ambiguous(found),
        *_linking(lds),
    )


def _misfits(fit: Fit) -> Iterator[str]:
    """What of the run does not fit, the impossible first."""
    for check in fit.misfits:
        where = "; `balise inspect RUN --site SITE` prints the lines that correct it" if check.lines else ""
        yield f"does not fit: {check.sentence}{where}"


def _injected(run: RunLog) -> Iterator[str]:
    if run.faults is not None and run.faults.height:
        yield "faults were injected: " + ", ".join(sorted(set(run.faults["kind"].to_list())))


def _off_the_track(site: Site) -> Iterator[str]:
    """Balises that the site places where there is no track."""
    names = [item.place.removeprefix(BALISE_PLACE) for item in site.findings if item.severity == "error"]
    if names:
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        few = ", ".join(names[:_SHOWN]) + more
        yield f"balises off their net element, so that no run passes them (`balise inspect SITE` says why): {few}"


def _stamps(counts: StreamCounts) -> Iterator[str]:
    """Positions that were left out for their time."""
    if counts.far_off:
        yield f"{counts.far_off} positions left out: their time is more than a day from the others"
    if counts.placeholders:
        yield (
            f"{counts.placeholders} positions are placeholders (0/0, a default place, or before the first fix): epochs "
            "without a fix"
        )
    if counts.contradicting:
        yield (
            f"{counts.contradicting} positions left out: another position with the same time lies elsewhere, and the "
            "first recorded one is used. Record two receivers of one topic as two solutions"
        )


def _extents(run: RunLog) -> Iterator[str]:
    """Where GNSS and odometer do not cover the same time."""
    if run.odometer is None:
        return
    (gnss_begin, gnss_end), (odometer_begin, odometer_end) = _extent_ns(run.gnss), _extent_ns(run.odometer)
    apart_ns = {
        "the odometer ends before the GNSS": gnss_end - odometer_end,
        "the odometer begins after the GNSS": odometer_begin - gnss_begin,
        "the GNSS ends before the odometer": odometer_end - gnss_end,
        "the GNSS begins after the odometer": gnss_begin - odometer_begin,
    }
    yield from (text for text, apart in apart_ns.items() if apart > NS_PER_S)


def _odometer(odometry: Odometry | None, straight_s: float) -> Iterator[str]:
    """What the odometer's rows cannot tell."""
    if odometry is None:
        return
    if odometry.leaps_ns:
        first = datetime.fromtimestamp(odometry.leaps_ns[0] // NS_PER_S, UTC)
        yield (
            f"the odometer's distance jumps by more than a train can drive, {len(odometry.leaps_ns)} times, first at "
            f"{first:%H:%M:%S}: its speed is used there, and without an agreeing speed the distance is unknown"
        )
    if odometry.period_s > straight_s:
        yield (
            f"the odometer has only one row every {odometry.period_s:.3g} s: where the speed changes between rows, "
            "alarms along the track may come from the odometer"
        )


def _extent_ns(stream: pl.DataFrame) -> tuple[int, int]:
    begin, end = stream["t"].to_physical()[[0, -1]]
    return begin, end


def _positions(fixes: pl.DataFrame, found: Match, vehicle: Vehicle) -> Iterator[str]:
    if found.odometer_sign < 0 and vehicle.gnss_antenna_ahead_m:
        yield "the odometer counts down at first, so the train reverses: the sign of gnss_antenna_ahead_m is changed"
    contradictory = contradictory_covariances(fixes)
    if contradictory:
        yield f"cov_en_m2 is impossible with its variances at {contradictory} epochs and is not used there"


def _ambiguous(found: Match) -> Iterator[str]:
    """Parts of the run where another path is nearly as likely."""
    clock = "%H:%M:%S"
    stretches = [
        f"{one} ({probability:.2f}) or {other} from {start:{clock}} to {end:{clock}} (told apart by {told_by})"
        for one, other, start, end, probability, told_by in found.ambiguous.select(
            "netelement_id", "other_netelement_id", "t_start", "t_end", "probability", "told_by"
        ).iter_rows()
    ]
    if stretches:
        yield "net element ambiguous: " + ", ".join(stretches)


def _linking(lds: LdsResult) -> Iterator[str]:
    reasons = lds.epochs["link_distance_reason"]
    if unlinked := int(reasons.str.starts_with(UNLINKED).sum()):
        given = set(reasons.filter(reasons.str.starts_with(UNLINKED).fill_null(False)))
        why = ", ".join(sorted(reason.removeprefix(UNLINKED) for reason in given))
        yield f"after {unlinked} outages the position could not be re-linked and was not used: {why}"
    if lds.unknown_reads.height:
        names = sorted(set(lds.unknown_reads["balise_id"].to_list()))
        yield "telegrams read from balises that are not on the train's path: " + ", ".join(names)
