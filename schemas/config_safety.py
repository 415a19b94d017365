"""Configuration of the safety budget, of calibration, and of advice."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from schemas.config_base import Positive, Probability, Settings


class ServiceLevel(Settings):
    """Hazard rate of a signal-in-space service: `integrity_risk` per `exposure_s`."""

    integrity_risk: Positive
    """Probability of an undetected wrong position in one exposure time."""
    exposure_s: Positive
    """The exposure time that the integrity risk is stated for [s]."""

    @property
    def hazard_rate_per_h(self) -> float:
        """Integrity risk per exposure time as a rate [1/h] (TVB section 5)."""
        return self.integrity_risk * 3600.0 / self.exposure_s


class SafetyConfig(Settings):
    """Safety budget (DOMAIN section 6)."""

    thr_vb_per_h: Positive = 0.67e-9
    """Tolerable hazard rate of a virtual balise [1/h].

    TVB section 3.
    """
    service_levels: dict[str, ServiceLevel] = Field(
        default={
            "npa": ServiceLevel(integrity_risk=1e-7, exposure_s=3600.0),
            "lpv200": ServiceLevel(integrity_risk=2e-7, exposure_s=150.0),
            "egnos_observed": ServiceLevel(integrity_risk=6e-8, exposure_s=150.0),
            "horizontal_sis": ServiceLevel(integrity_risk=1e-9, exposure_s=150.0),
        }
    )
    """Hazard rates of GNSS services; a table of your own adds one, with both keys.

    TVB section 5 (NPA per hour, LPV-200 and EGNOS as observed per 150 s); LOC section V (horizontal signal in
    space).
    """
    demands_per_hour: Positive = 1.0
    """Virtual balises passed per hour.

    The published budget has one; 64 to 400 at 160 km/h (DOMAIN section 6).
    """
    diagnosis_hazard_rate_per_h: Positive = 1e-9
    """Hazard rate of the diagnosis [1/h].

    None is published; SIL 4 (DOMAIN section 6).
    """

    def allowed_time_to_detect_s(self, level: str) -> float:
        """Allowed T_D [s] = THR_VB / (HR_GNSS per hour) (TVB eq. 7), per demand of the hour."""
        rate = self.service_levels[level].hazard_rate_per_h * self.demands_per_hour
        return self.thr_vb_per_h / rate * 3600.0


class CalibrationConfig(Settings):
    """What `balise calibrate` measures from."""

    least_epochs: Annotated[int, Field(strict=True, gt=0)] = 100
    """A monitor with fewer evaluated epochs is not calibrated.

    A standard deviation from so many is known to 7 % at best. Ours.
    """
    left_out_pieces: Annotated[int, Field(strict=True, ge=2)] = 8
    """Runs, or pieces of a few runs, of which one at a time is left out for the standard errors of sigmas.

    Epochs are correlated over minutes, so pieces have to be long; the sigmas themselves do not depend on it. Ours.
    """
    sigma_spread_share: Probability = 0.05
    """A stated sigma that varies by a smaller share gives a slope alone.

    Intercept and slope cannot be told apart. Ours.
    """
    least_runs: Annotated[int, Field(strict=True, ge=2)] = 2
    """`replay --calibrate` wants so many other fault-free runs for each run.

    With fewer nobody knows how far a further one may lie from them. Ours.
    """
    same_vehicle_scale: Positive = 0.01
    """Runs whose odometer scales differ by more are of different vehicles.

    A wheel wears by a tenth of this in a campaign of weeks. Ours.
    """
    runs: tuple[str, ...] = ()
    """The runs that vehicle and monitors were calibrated by.

    Filled in by `replay --calibrate`, so that the digest of the settings follows from it.
    """


class AdviceConfig(Settings):
    """From which loss on `runs.remedies` names a cure (DOMAIN section 5.4)."""

    low_availability: Probability = 0.9
    """Below this availability `runs.remedies` and `notes` name what it was lost to.

    A healthy run loses some time at its start. Ours.
    """
    lost_share: Probability = 0.02
    """Share of the moving time from which on a loss is worth a cure of its own.

    Less is the noise of short losses. Ours.
    """
