"""Measurements against the project's targets: `python -m benchmarks [NAME...]`, names as `--list` shows them."""
