"""The study of unnoticed errors hooks on to a ride: what the train had seen, before the judge."""

from __future__ import annotations

from pipeline.stages.ride import Ride
from pipeline.studies.undetected.columns import Diagnosis, Undetected, undetected_of
from pipeline.studies.undetected.watched import fixes_ns


def unnoticed_of(ride: Ride) -> Undetected:
    """The largest error at each epoch and passage of a ride that no monitor would have noticed."""
    prepared = ride.prepared
    lds = ride.lds
    return undetected_of(diagnosis_of(ride), lds.passages, lds.crossings, prepared.vehicle, prepared.config)


def diagnosis_of(ride: Ride) -> Diagnosis:
    """What watched the solution of a ride."""
    run = ride.prepared.run
    config = ride.prepared.config
    return Diagnosis(
        epochs=ride.solution.epochs,
        bank=ride.bank.along(),
        held=ride.lds.held,
        channel=ride.singles["channel"],
        other=ride.other,
        satellites=ride.prepared.ranges(ride.solution.name),
        fixes_ns=fixes_ns(run, ride.lds.crossings, config.lds.starts_of_mission, config.undetected),
    )
