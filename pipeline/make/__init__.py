"""What makes inputs: runs out of receivers' files, surveys out of maps and traces.

In: receivers' logs, lines of track, balise lists. Out: runs and sites by the contract.
Touches files.
"""
