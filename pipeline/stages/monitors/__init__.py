"""Monitors: GNSS against odometer and track (DIAG eq. 1-17), Doppler, ranges, a second solution.

In: aligned epochs of one solution, satellites, another solution. Out: value, threshold, state, reason of each monitor.
Touches no file. Causal, and blind to any truth; the LDS restarts the bank.
"""
