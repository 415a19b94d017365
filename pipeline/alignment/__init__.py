"""The odometer at each GNSS epoch's time of validity, with scale and latency known or learned.

`align` adds it to the epochs, over the increments of `increments`; `learning` runs the filter of `odometer_filter`
along the run and holds it under alarm; `odometer` is the recorded stream as distance over time.
"""
