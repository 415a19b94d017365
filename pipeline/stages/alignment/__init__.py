"""The odometer at each position, at its time of validity, with scale and latency known or learned.

In: positions of one solution, the odometer, vehicle file, configuration. Out: `schemas.stages.AlignedEpochs`.
Touches no file. Causal: at an epoch only earlier epochs count. For thresholds only: nothing that judges asks here.

`align` makes the columns. Scale and latency in use: `learning`, held under alarm, by the filter of `odometer_filter`.
"""
