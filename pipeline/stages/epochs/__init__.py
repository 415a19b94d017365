"""How long an epoch lasts, what a gap is, when a condition held, what monitors say, and which failed when.

In: times of epochs, flags on them, values of monitors. Out: shares of time, outages, verdicts, the failure log.
Touches no file and knows no other room of the pipeline.

How long, and under which condition: `clock`. When a place is passed: `passing`. Value, threshold, state and reason of a
monitor: `verdicts`. First fails and alarm episodes: `failure_log`.
"""
