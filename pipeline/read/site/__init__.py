"""A site: survey, links, balises, route, and what is remarkable in them.

In: a folder or GeoJSON of the site. Out: `schemas.run.Site` in WGS 84, findings.
Touches files. Nothing of a run is known here, but for `survey_findings`, which asks results where a survey is off.
"""
