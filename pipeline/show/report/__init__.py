"""Results as pages that open offline.

In: a result and its site. Out: HTML with its scripts and styles.
Touches files. It shows what the tables hold, the verdict first; it judges nothing itself.

`write` writes the pages that changed. What stands on them: `run_page`, `campaign_page`, `site_page`; verdict, facts and
tiles: `headline`. Tables: `columns`, `balises`, `route_found`. Drawings: `series` (over time), `ground` (from above);
both are thinned by `decimate`. HTML: `markup`; words: `words`.
"""

from pipeline.show.report.write import MOST_PAGES, page_name, write_against, write_page, write_report

__all__ = ["MOST_PAGES", "page_name", "write_against", "write_page", "write_report"]
