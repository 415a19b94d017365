"""What is printed wrongly, lost or left open in the papers, and what stands here instead."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl


@dataclass(frozen=True)
class Erratum:
    """`kind` is `misprint`, `lost` or `open`."""

    paper: str
    place: str
    kind: str
    printed: str
    used: str
    reason: str


ERRATA: tuple[Erratum, ...] = (
    Erratum(
        "TVB",
        "section 5, third allowed T_D",
        "misprint",
        "1.44 s",
        "1.675 s",
        "0.67e-9/h over 1.44e-6/h is 4.653e-4 h; 1.44 is the mantissa of the rate",
    ),
    Erratum(
        "TVB",
        "section 5, second allowed T_D",
        "misprint",
        "1.36e-4 h",
        "1.396e-4 h",
        "0.67e-9/h over 4.8e-6/h; the 0.50 s printed beside it is right",
    ),
    Erratum(
        "DIAG",
        "Table 1, orbit/clock, R(10 s)/R(0)",
        "misprint",
        "0.9987",
        "0.9972",
        "exp(-10 s / 3600 s); R(1 s)/R(0) = 0.9997 of the same row agrees with 3600 s",
    ),
    Erratum(
        "DIAG",
        "eq. 9 and 16, the set of averages",
        "lost",
        "",
        "weights 1 (raw), 0.1, 0.01, 0.001",
        "`monitors.ewma_alphas`; `balise experiment bank` compares others",
    ),
    Erratum(
        "DIAG",
        "noise of the odometer",
        "open",
        "0.05 m/s",
        "white on increments",
        "white on position is the other reading; `balise experiment diagnostics` has both",
    ),
    Erratum(
        "TVB",
        "Fig. 3b, transitions of the Markov model",
        "lost",
        "",
        "P0 to P1 and P3, P1 to P2",
        "eq. 1 fixes P0 and P1; P3 = HR_Diag/(HR_SBAS + HR_Diag) (1 - P0), P2 the rest",
    ),
    Erratum(
        "TVB",
        "eq. 1, HR_Diag",
        "open",
        "no value",
        "1e-9 /h by default",
        "at the 1e-9/h of SIL 4 odometry state P3 alone exceeds THR_VB = 0.67e-9/h",
    ),
    Erratum(
        "TVB",
        "eq. 7, demands",
        "open",
        "one virtual balise per hour",
        "demands_per_hour, 1 by default",
        "at 160 km/h a train passes 64 per hour at 2.5 km spacing and 400 at 400 m",
    ),
    Erratum(
        "LOC",
        "section VI, MTBF of the 1oo2 LDS",
        "open",
        "2.7e5 h practically meets 3e5 h",
        "not met: 90 % of it",
        "(520.8 h)^2 / 1 h = 2.71e5 h is less than the MTBF-S_ONB of 3e5 h",
    ),
)


def errata() -> tuple[Erratum, ...]:
    """The errata of the papers, those that change a figure first."""
    return ERRATA


def errata_table() -> pl.DataFrame:
    return pl.DataFrame([vars(erratum) for erratum in ERRATA])
