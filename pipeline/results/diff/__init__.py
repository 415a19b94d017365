"""What changed between two tables, and between two results.

In: two results. Out: differences by run, hazard and value, with the tolerance of each column.
Touches files to read them. It judges nothing: it says what is not the same.
"""

from pipeline.results.diff.hazards import compare_hazards
from pipeline.results.diff.results import diff_results
from pipeline.results.diff.tables import compare_tables

__all__ = ["compare_hazards", "compare_tables", "diff_results"]
