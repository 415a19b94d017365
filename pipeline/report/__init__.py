"""Results as pages that open offline."""

from pipeline.report.write import page_name, write_report

__all__ = ["page_name", "write_report"]
