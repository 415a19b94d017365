"""`dask worker` whose processes are forked from one that has loaded the program: each costs two seconds otherwise."""

from __future__ import annotations

import multiprocessing
import sys
from multiprocessing import forkserver

# What a worker loads before its first run. None of it starts threads that a forked process would miss.
_LOADED = ("distributed.nanny", "pipeline.campaign.cluster", "pipeline.one_run")

if __name__ == "__main__":
    from dask.__main__ import main

    multiprocessing.set_forkserver_preload(list(_LOADED))
    forkserver.ensure_running()
    sys.exit(main())
