"""Position types of NovAtel's receivers, as binary logs and ROS messages number them and texts name them.

OEM7 commands and logs reference manual, "Position or velocity type".
"""

from __future__ import annotations

from schemas.enums import Fix

# Number, a stroke for each word there is for it. Services (OmniSTAR, CDGPS, PPP of any kind) count as differential; a
# velocity alone is no position, and one that was typed in (FIXEDPOS) was not measured. Some numbers have no word.
_TYPES: dict[Fix, str] = {
    Fix.NONE: "0/NONE 1/FIXEDPOS 8/DOPPLER_VELOCITY",
    Fix.AUTONOMOUS: "2/FIXEDHEIGHT 16/SINGLE 53/INS_PSRSP 70/OPERATIONAL 71/WARNING 72/OUT_OF_BOUNDS",
    Fix.DIFFERENTIAL: "17/PSRDIFF 20/OMNISTAR 54/INS_PSRDIFF 57/INS_OMNISTAR 58/INS_OMNISTAR_HP 59/INS_OMNISTAR_XP "
    "64/OMNISTAR_HP 65/OMNISTAR_XP 66/CDGPS 68/PPP_CONVERGING 69/PPP 73/INS_PPP_CONVERGING 74/INS_PPP 75 76 "
    "77/PPP_BASIC_CONVERGING 78/PPP_BASIC 79/INS_PPP_BASIC_CONVERGING 80/INS_PPP_BASIC",
    Fix.SBAS: "18/WAAS/SBAS 52/INS_SBAS",
    Fix.ESTIMATED: "19/PROPAGATED 67/EXT_CONSTRAINED",
    Fix.RTK_FLOAT: "4/FLOATCONV 32/L1_FLOAT 33/IONOFREE_FLOAT 34/NARROW_FLOAT 35 55/INS_RTKFLOAT",
    Fix.RTK_FIXED: "5/WIDELANE 6/NARROWLANE 46 47 48/L1_INT 49/WIDE_INT 50/NARROW_INT 51/RTK_DIRECT_INS "
    "56/INS_RTKFIXED",
}
_NAMED = [(kind, told.split("/")) for kind, types in _TYPES.items() for told in types.split()]
FIX_BY_CODE = {int(names[0]): kind for kind, names in _NAMED if kind is not Fix.NONE}
FIX_BY_WORD = {word: kind for kind, names in _NAMED for word in names[1:]}
