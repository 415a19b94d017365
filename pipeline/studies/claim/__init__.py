"""What a train localisation unit may claim: a result of `balise replay` held against published requirements.

In: the tables of a result, a profile (requirements as a versioned file), the area types of the site. Out: one row per
requirement. Truth is what the judge wrote into the tables.
Touches files only to read them: results, profiles, `areas`.
"""

from pipeline.studies.claim.areas import read_areas
from pipeline.studies.claim.claim import assess_claim, rows_for_reading
from pipeline.studies.claim.profile import load_profile

__all__ = ["assess_claim", "load_profile", "read_areas", "rows_for_reading"]
