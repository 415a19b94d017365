"""One solution against the evidence: judgements, failures, hazards, alarms, passages (DOMAIN sections 5.2 to 5.5).

In: a solution as it was replayed (`Solution`), `Evidence`, the odometer. Out: `Judged`, the tables of the contract.
Touches no file. Velocity, and scale and latency learned in the run, are heard for no judgement, time or verdict.
"""
