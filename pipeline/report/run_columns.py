"""What stands on the page of a run: columns with their titles, and drawings with what they show."""

from __future__ import annotations

FIGURES = (
    ("verdict", "verdict", ""),
    ("duration_s", "duration", "s"),
    ("distance_m", "distance", "m"),
    ("epochs", "epochs", ""),
    ("gnss_rate_hz", "GNSS rate", "Hz"),
    ("evidence", "judged by", ""),
    ("share_unknown", "share of moving time in use that cannot be judged", ""),
    ("vehicle", "scale and latency from", ""),
    ("odometer_contradicted", "gaps that the odometer does not close", ""),
    ("availability", "availability of the TVB while moving", ""),
    ("outages", "outages", ""),
    ("longest_outage_s", "longest outage", "s"),
    ("along_error_p95_m", "error along, 95 %", "m"),
    ("along_error_max_m", "error along, largest", "m"),
    ("along_error_epochs", "epochs with a known error along", ""),
    ("cross_error_p95_m", "error across, 95 %", "m"),
    ("up_error_p95_m", "error of height, 95 %", "m"),
    ("balises_on_path", "VBs passed", ""),
    ("balises_accepted", "accepted", ""),
    ("balises_rejected", "rejected", ""),
    ("balises_missed", "missed", ""),
    ("balises_not_available", "not available", ""),
    ("unsafe_accepted", "accepted despite a wrong position", ""),
    ("unproven_accepted", "accepted, and nothing says whether right", ""),
    ("location_error_p95_m", "location error, 95 %", "m"),
    ("location_error_count", "VBs with a known location error", ""),
    ("failures", "position failures in use", ""),
    ("failures_within_budget", "of these within the budget", ""),
    ("failures_beyond_budget", "of these beyond the budget", ""),
    ("missed_detections", "missed detections", ""),
    ("time_to_detect_max_s", "longest time to detect", "s"),
    ("hazardous_max_s", "longest hazardous time", "s"),
    ("alarms", "alarms", ""),
    ("false_alarms", "of these false", ""),
    ("exposure_max_s", "longest exposure", "s"),
    ("exposure_p99_s", "exposure, 99 %", "s"),
    ("mtbf_h", "time between outages", "h"),
    ("latency_s", "GNSS latency", "s"),
    ("odometer_scale", "odometer scale", ""),
    ("ambiguous_stretches", "ambiguous stretches", ""),
    ("duplicates", "duplicated epochs", ""),
    ("out_of_order", "epochs out of order", ""),
)
HAZARD_COLUMNS = (
    ("failure_mode", "ETCS failure"), ("timing", "offered"), ("size_m", "size [m]"), ("rate_mps", "rate [m/s]"),
    ("t_onset", "onset"), ("t_failure", "failure"), ("t_detected", "detected"), ("monitor", "by"),
    ("time_to_detect_s", "T_D [s]"), ("time_since_failure_s", "T_dsf [s]"), ("hazardous_s", "hazardous [s]"),
    ("hazardous_may_s", "with what is unknown [s]"), ("budget_s", "budget [s]"), ("within_budget", "within budget"),
    ("balise_ids", "VBs hit"), ("accepted_ids", "accepted despite the fault"), ("suspect", "suspect"),
    ("evidence", "evidence"),
    ("speed_mps", "speed [m/s]"), ("caused_by", "follows from"),
)  # fmt: skip
PASSAGE_COLUMNS = (
    ("kind", "kind"), ("direction", "direction"), ("t_offered", "offered"), ("t_true", "passed"),
    ("judgement", "position"), ("location_error_m", "location error [m]"), ("location_accuracy_m", "Q_LOCACC [m]"),
    ("speed_mps", "speed [m/s]"), ("window_open_m", "window opens [m]"),
    ("odometer_distance_m", "odometer [m]"), ("window_close_m", "window closes [m]"),
    ("confidence_m", "confidence [m]"), ("linking_error", "linking error"), ("reaction", "reaction"),
    ("failure_mode", "ETCS failure"), ("cause", "cause"), ("suspect_after_the_fact", "suspect after the fact"),
    ("hazard_id", "hazard"),
)  # fmt: skip
ALARM_COLUMNS = (
    ("t_start", "from"), ("t_end", "to"), ("monitors", "monitors in order of failing"),
    ("peak_ratio", "peak ratio"), ("verdict", "verdict"), ("suspect", "suspect"), ("hazard_id", "hazard"),
    ("netelement_id", "net element"), ("measure_m", "measure [m]"),
)  # fmt: skip
PLOTS = (
    ("plan", "Plan", "GNSS positions coloured by the state of the LDS; balises by what became of them; "
     "thick lines are expectation windows."),
    ("bands", "LDS mode, state, TVB and alarm", "Where nothing is drawn there was no epoch. Hazards are shaded; "
     "of the chosen one the dotted line is the onset, the solid one the detection, the dashed one the failure."),
    ("speed", "Speed", ""),
    ("along", "Error along the track", "Positive ahead of the train, drawn where it is known to 5 m; the confidence "
     "interval is dashed. Where it is never known: GNSS minus odometer."),
    ("across", "Error across the track and of height", "Without truth: residual against the surveyed track."),
    ("linking", "Distance since the last accepted balise", "Bars are the expectation windows of the balises offered, "
     "in odometer distance; markers are the offers."),
    ("exposure", "Exposure", "Time since the last linked TVB or accepted VB."),
    ("monitors-along", "Monitors along the track", "Value over threshold: beyond ±1 the monitor fails."),
    ("monitors-cross", "Monitors across the track", "Value over threshold."),
    ("monitors-up", "Monitors of height", "Value over threshold."),
    ("monitors-other", "Other monitors", "Value over threshold."),
    ("states", "State of every monitor", "Not evaluated is not the same as passed."),
    ("stanford", "Stanford diagram", "Epochs of known error: error along the track against the confidence claimed. "
     "Below the diagonal the claim was wrong."),
)  # fmt: skip
