"""Damage well-formed logs at random and read them: an error or correct data, never anything else.

    python -m tests.fuzz.ingest --count 10000 --seed 1

Each case is one mutation of one log, both drawn from a generator seeded by (seed, number of the case),
so that `--first N --count 1` repeats case N alone.
"""

from __future__ import annotations

import argparse
import io
import json
import resource
import secrets
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.speed.ingest import run_of
from datasets.mcap_log import Encoding, write_mcap
from pipeline.read.ingest import read_run
from pipeline.show.export.mcap_file import Compression
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import RunLog

Random = np.random.Generator
Mutation = Callable[[bytes, Random, bytes], bytes]

_MAGIC_SIZE = 8
_HEAD = struct.Struct("<BQ")
_SLOWEST_S = 2.0
_MOST_GROWTH_MB = 300.0


@dataclass
class FuzzReport:
    """What the cases came to; `failures` lists number, mutation and finding of each that is wrong."""

    seed: int
    first: int
    count: int
    outcomes: Counter[str] = field(default_factory=Counter)
    mutations: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, str, str]] = field(default_factory=list)
    slowest_s: float = 0.0
    memory_growth_mb: float = 0.0


@dataclass(frozen=True)
class Subject:
    """A well-formed log with what it holds."""

    name: str
    content: bytes
    expected: RunLog


def subjects(folder: Path) -> list[Subject]:
    """All encodings and compressions, with checksums (without them a flipped number cannot be told)."""
    encodings: tuple[Encoding, ...] = ("json", "protobuf", "cdr")
    compressions: tuple[Compression, ...] = ("zstd", "lz4", "none")
    found = []
    for encoding in encodings:
        for compression in compressions:
            stream = io.BytesIO()
            write_mcap(run_of(0.002), stream, encoding, compression, chunk_size=8000)
            found.append(_subject(f"{encoding} {compression}", stream.getvalue(), folder))
    return found


def _subject(name: str, content: bytes, folder: Path) -> Subject:
    path = folder / "subject.mcap"
    path.write_bytes(content)
    return Subject(name, content, read_run(path, IngestConfig()))


def _records(content: bytes) -> list[tuple[int, int]]:
    """Start and end of every record."""
    found, at = [], _MAGIC_SIZE
    while at < len(content) - _MAGIC_SIZE:
        end = at + _HEAD.size + _HEAD.unpack_from(content, at)[1]
        found.append((at, end))
        at = end
    return found


def _flip(content: bytes, random: Random, _: bytes) -> bytes:
    changed = bytearray(content)
    for at in random.integers(0, len(content), random.integers(1, 5)):
        changed[at] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _cut(content: bytes, random: Random, _: bytes) -> bytes:
    return content[: random.integers(len(content))]


def _length_edit(content: bytes, random: Random, _: bytes) -> bytes:
    """Another length for one record, sometimes a length inside it."""
    start, end = _records(content)[random.integers(len(_records(content)))]
    changed = bytearray(content)
    old = _HEAD.unpack_from(content, start)[1]
    values = [0, 1, old - 1, old + 1, old * 2, 2**31, 2**40, 2**63, 2**64 - 1, int(random.integers(2**20))]
    value = max(0, values[random.integers(len(values))])
    if random.random() < 0.5 or end - start < 24:
        struct.pack_into("<Q", changed, start + 1, value)
    else:
        at = int(random.integers(start + _HEAD.size, end - 8))
        struct.pack_into("<I", changed, at, value % 2**32)
    return bytes(changed)


def _splice(content: bytes, random: Random, other: bytes) -> bytes:
    """A record taken out, doubled, moved, or taken from another log."""
    records = _records(content)
    start, end = records[random.integers(len(records))]
    to = records[random.integers(len(records))][0]
    kind = random.integers(4)
    if kind == 0:
        return content[:start] + content[end:]
    piece = content[start:end]
    if kind == 1:
        return content[:to] + piece + content[to:]
    if kind == 2:
        rest = content[:start] + content[end:]
        to = min(to, len(rest))
        return rest[:to] + piece + rest[to:]
    strange = _records(other)[random.integers(len(_records(other)))]
    return content[:start] + other[strange[0] : strange[1]] + content[end:]


def _overwrite(content: bytes, random: Random, _: bytes) -> bytes:
    """A stretch of zeros, noise, or of the log itself."""
    size = int(random.integers(1, 400))
    at = int(random.integers(0, len(content) - size))
    source = int(random.integers(0, len(content) - size))
    pieces = [bytes(size), random.bytes(size), content[source : source + size]]
    return content[:at] + pieces[random.integers(3)] + content[at + size :]


def _insert(content: bytes, random: Random, _: bytes) -> bytes:
    at = int(random.integers(0, len(content) + 1))
    return content[:at] + random.bytes(int(random.integers(1, 40))) + content[at:]


MUTATIONS: dict[str, Mutation] = {
    "flip": _flip,
    "cut": _cut,
    "length edit": _length_edit,
    "splice": _splice,
    "overwrite": _overwrite,
    "insert": _insert,
}


def judge(path: Path, expected: RunLog) -> tuple[str, str]:
    """Outcome (`error`, `whole`, `partial`, or `WRONG`) and the finding."""
    try:
        log = read_run(path, IngestConfig())
    except InputError:
        return "error", ""
    except BaseException as error:
        return "WRONG", f"{type(error).__name__}: {error}"
    cut = log.notes.partial_until_ns is not None
    lost = log.notes.damage is not None and "that are declared" in log.notes.damage
    partial = cut or lost
    for name in ("gnss", "odometer"):
        found, whole = log.stream(name), expected.stream(name)
        if whole is None and found is None:  # a twist that no mapping names
            continue
        if whole is None:
            return "WRONG", f"{name} out of nothing"
        if found is None and partial:
            continue
        if found is None or not found.equals(_kept(whole, found, lost) if partial else whole):
            return "WRONG", f"{name} differs{' (partial)' if partial else ''}"
    return ("partial" if partial else "whole"), ""


def _kept(whole: pl.DataFrame, found: pl.DataFrame, lost: bool) -> pl.DataFrame:
    """The rows that a log of which a part is missing should hold: where chunks are lost those of the others."""
    return whole.filter(pl.col("t").is_in(found["t"].implode())) if lost else whole.head(found.height)


def fuzz(count: int, seed: int = 1, first: int = 0) -> FuzzReport:
    """Run cases `first` to `first + count`."""
    report = FuzzReport(seed, first, count)
    with tempfile.TemporaryDirectory() as name:
        logs = subjects(Path(name))
        path = Path(name) / "case.mcap"
        before_mb = _peak_mb()
        for number in range(first, first + count):
            _case(report, logs, number, path)
        report.memory_growth_mb = _peak_mb() - before_mb
    if report.memory_growth_mb > _MOST_GROWTH_MB:
        report.failures.append((-1, "all", f"memory grew by {report.memory_growth_mb:.0f} MB"))
    return report


def _case(report: FuzzReport, logs: list[Subject], number: int, path: Path) -> None:
    random = np.random.default_rng((report.seed, number))
    subject, other = (logs[random.integers(len(logs))] for _ in range(2))
    name = list(MUTATIONS)[random.integers(len(MUTATIONS))]
    path.write_bytes(MUTATIONS[name](subject.content, random, other.content))
    start = time.perf_counter()
    outcome, finding = judge(path, subject.expected)
    taken_s = time.perf_counter() - start
    report.slowest_s = max(report.slowest_s, taken_s)
    if taken_s > _SLOWEST_S:
        outcome, finding = "WRONG", f"took {taken_s:.1f} s"
    report.outcomes[outcome] += 1
    report.mutations[f"{name}: {outcome}"] += 1
    if outcome == "WRONG":
        report.failures.append((number, f"{name} of {subject.name}", finding))


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("bench-out/fuzz_ingest.json"))
    arguments = parser.parse_args()
    seed = secrets.randbits(32) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    report = fuzz(arguments.count, seed, arguments.first)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(vars(report), indent=2, sort_keys=True) + "\n")
    for name, number in sorted(report.mutations.items()):
        print(f"{name:25s} {number:7d}")
    print(f"slowest {report.slowest_s:.3f} s, memory grew by {report.memory_growth_mb:.0f} MB")
    for failure in report.failures[:20]:
        print("WRONG", *failure)
    print(f"{arguments.count} cases, {len(report.failures)} wrong")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
