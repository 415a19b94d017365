"""Results for other programs: MCAP viewers and geographic information systems.

In: a run, its result and its site. Out: MCAP, GeoJSON, GPX, GeoPackage, GeoParquet.
Touches files. It computes nothing that a table does not hold.
"""

from pipeline.show.export.write import export_run

__all__ = ["export_run"]
