"""Location determination system: virtual balises, ETCS linking, travelling virtual balise."""

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.run import LdsResult, run_lds

__all__ = ["Bank", "LdsLimits", "LdsResult", "run_lds"]
