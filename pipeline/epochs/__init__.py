"""How long an epoch lasts, what a gap is, when a condition held, and which monitors failed when.

In: times of epochs and flags on them. Out: shares of time, outages, the failure log with its alarm episodes.
Touches no file and knows no other room of the pipeline.
"""
