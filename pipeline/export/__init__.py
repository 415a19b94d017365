"""Results for other programs: MCAP viewers and geographic information systems."""

from pipeline.export.write import export_run

__all__ = ["export_run"]
