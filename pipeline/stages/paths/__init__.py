"""Which paths through the network positions do not reject: the confidence set behind matching and reference.

In: places with their sigma, network, distance by an odometer or none. Out: `PathSet`: the hypotheses of a run, which of
them live at each step, and which live to the end. Touches no file and knows no solution.

`candidates`: the nearest place on every net element within reach. `path_steps`: means of a second, and how a train got
from one place on the network to another. `path_tests`: can residuals across a path be those of a train on it.
`path_set`: the paths, and the return of positions off the network; `growth`: grown over relations until refuted.
"""
