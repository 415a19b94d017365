"""Monitors: GNSS against odometer and track (DIAG eq. 1-17), Doppler, ranges, a second solution.

In: aligned epochs of one solution, satellites, another solution. Out: value, threshold, state, reason of each monitor.
Touches no file. Causal, and blind to any truth; the LDS restarts the bank.

`bank` is asked by the LDS, epoch by epoch. Which epochs are compared on each axis: `series`. The increments and their
thresholds: `axis`, by the recursions of `recursion` and the noise measured in the run (`noise`). Monitors without
memory: `single`, of which ranges are in `pseudorange` (geometry: `sight`).
"""
