"""Results as pages that open offline.

In: a result and its site. Out: HTML with its scripts and styles.
Touches files. It shows what the tables hold, the verdict first; it judges nothing itself.
"""

from pipeline.show.report.write import page_name, write_report

__all__ = ["page_name", "write_report"]
