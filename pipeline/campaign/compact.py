"""`balise compact`: the tables of many runs in few files, while no campaign writes them."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.campaign import resume
from pipeline.campaign.lock import hold_output
from pipeline.results import packs, store
from pipeline.results.manifest import write_manifest
from pipeline.results.outcome import RunOutcome
from pipeline.results.packing import RUNS_PER_PACK, pack_runs, unpack
from pipeline.results.workers import tell
from pipeline.storage.address import Address, is_url
from schemas.frozen import frozen


@frozen
class Compaction:
    """How a result lies now: runs in packs, packs, runs with files of their own; `left_out`: these with the reason."""

    packed: int
    packs: int
    own: int
    left_out: Mapping[str, str]

    @property
    def sentence(self) -> str:
        """What was packed, and what stays in files of its own, for people."""
        files = "1 file" if self.packs == 1 else f"{self.packs} files"
        return f"{self.packed} runs lie in {files} per table, {self.own} in files of their own"


def compact(out: Address, runs_per_pack: int = RUNS_PER_PACK, jobs: int = 1) -> Compaction:
    """Pack all complete runs. Ended at any instant, it has lost nothing, and the next call does the rest.

    Raises `UsageError` without a complete run, `OutputError` while a campaign writes there.
    """
    store.complete_runs(out)
    left_out: dict[str, str] = {}
    done = 0
    with hold_output(out):
        store.sweep(out)
        known = {} if is_url(out) else resume.outcomes_in_place(str(out))
        for packed, total in pack_runs(out, runs_per_pack, jobs):
            left_out |= packed.left_out
            done += len(packed.runs) + len(packed.left_out)
            tell(done, total)
        return _finish_compaction(out, left_out, known)


def undo(out: Address) -> Compaction:
    """Give every run files of its own again, with the bytes that they had."""
    store.complete_runs(out)
    total = len(packs.find_packed(out))
    done = 0
    with hold_output(out):
        store.sweep(out)
        known = {} if is_url(out) else resume.outcomes_in_place(str(out))
        for runs in unpack(out, packs.read_list(out)):
            done += runs
            tell(done, total)
        return _finish_compaction(out, {}, known)


def _finish_compaction(out: Address, left_out: Mapping[str, str], known: Mapping[str, RunOutcome]) -> Compaction:
    """Write what follows from where runs lie; `known`: outcomes of runs that need not be looked into again."""
    write_manifest(out)
    if known:
        resume.keep_in_place(str(out), known)
    own = len(store.own_runs(out))
    return Compaction(len(store.run_ids(out)) - own, len(packs.read_list(out)), own, left_out)
