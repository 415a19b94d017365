"""Position types of NovAtel's receivers, as its binary logs and ROS messages number them.

OEM7 commands and logs reference manual, "Position or velocity type".
"""

from __future__ import annotations

from schemas.enums import Fix

# Services (OmniSTAR, CDGPS, PPP of any kind) count as differential; a velocity alone (8) is no position, and one
# that was typed in (1) was not measured.
FIX_BY_CODE = {
    code: kind
    for kind, codes in {
        Fix.AUTONOMOUS: (2, 16, 53, 70, 71, 72),
        Fix.DIFFERENTIAL: (17, 20, 54, 57, 58, 59, 64, 65, 66, 68, 69, 73, 74, 75, 76, 77, 78, 79, 80),
        Fix.SBAS: (18, 52),
        Fix.ESTIMATED: (19, 67),
        Fix.RTK_FLOAT: (4, 32, 33, 34, 35, 55),
        Fix.RTK_FIXED: (5, 6, 46, 47, 48, 49, 50, 51, 56),
    }.items()
    for code in codes
}
