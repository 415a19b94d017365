"""What of a run does not fit, in words beside its figures."""

from __future__ import annotations

from pipeline.plausibility.fit import Fit

_WHERE = "`balise inspect RUN --site SITE` prints the lines that correct it"


def fit_notes(fit: Fit) -> tuple[str, ...]:
    """One note per misfit, the impossible first."""
    return tuple(f"does not fit: {check.sentence}" + (f"; {_WHERE}" if check.lines else "") for check in fit.misfits)
