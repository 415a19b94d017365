"""The surveyed track as geometry: net elements, network, legs, path, in metres on the ellipsoid.

In: tables of a site. Out: `Track`, `Network`, `TravelledPath`.
Touches no file and knows no position: matching, evidence and judge all stand on it.

`survey`: elements as arrays. `network`: which lead on to which. `chords`: how far its chords lie off its curves.
`path`: elements in order with one coordinate, one search for all of them. `segments`, `geodesy`: nearest places, legs,
metres.
"""
