"""Monitors: GNSS against odometer and track (DIAG eq. 1-17), Doppler, ranges, a second solution.

In: aligned epochs of one solution, satellites, another solution. Out: value, threshold, state, reason of each monitor.
Touches no file. Causal, and blind to any truth; the LDS restarts the bank.

`bank` is asked by the LDS, epoch by epoch. Which epochs are compared on each axis: `axes`. The increments, their
recursions and thresholds: `axis`, with the noise measured in the run (`noise`). Monitors without memory: `single`, of
which ranges and their geometry are in `pseudorange`.
"""
