"""Known faults put into recorded fault-free runs: how soon would this bank have noticed them, on this line?

In: runs as recorded, a site, a vehicle, banks (configurations), a plan of faults. Out: tables (`schemas.experiment`),
pictures and a page. `command` is the whole: what the plan asks (`plan`), each run as it was recorded and instants drawn
where nothing was wrong (`baseline`), each fault put in and replayed, and what became of it (`outcome`), tables of all
(`tables`), pictures and the page (`page`).

What is replayed. The fault is added to positions, ranges or odometer from its instant on, and the run is cut where its
watch ends. Reading, site, odometer and evidence are those of the fault-free run and are not made again; matching,
alignment, bank and LDS run in memory, over the prefix too, so that their state is that of a replay from the start.
The error is that of the fault-free position, by its evidence, and what the fault has moved the position by.
"""
