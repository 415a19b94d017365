"""How long an epoch lasts, what a gap is, when a condition held, what monitors say, and which failed when.

In: times of epochs, flags on them, values of monitors. Out: shares of time, outages, verdicts, the failure log.
Touches no file and knows no other package of the pipeline.

How long, under which condition, and when a place is passed: `clock`. Value, threshold, state and reason of a monitor,
first fails and alarm episodes, and all that the train itself knew of its epochs, in one class: `verdicts`.
"""
