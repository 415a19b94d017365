"""Vehicle, fast noise and monitor sigmas of fault-free runs (`balise calibrate`).

In: recorded runs and their site. Out: a vehicle file with uncertainties, and sigmas of the monitors.
Touches no file. It replays the runs (`pipeline.one_run`) and so stands above all stages of one run.
"""
