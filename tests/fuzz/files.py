"""Damage what no checksum of the container covers: messages and schemas of logs, tables, networks and settings.

    python -m tests.fuzz.files --count 5000

Messages and schemas are changed inside a log that is written anew, so that its checksums are right, and what is read
is held against the stock decoders. Of Parquet, what is read must be what was written. CSV, GeoJSON and TOML may say
anything; they must be read or refused by one error, in 2 s. `--first N --count 1` repeats case N alone.
"""

from __future__ import annotations

import argparse
import io
import json
import secrets
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.speed.ingest import run_of
from datasets.mcap_log import Encoding, write_mcap
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from pipeline.storage.parquet import parquet_bytes
from schemas.config import Configuration, IngestConfig, load_settings, to_toml
from schemas.errors import BaliseError
from schemas.run import RunLog
from tests.fuzz.ingest import MUTATIONS, FuzzReport, Random

_SLOWEST_S = 2.0
# Names and statistics in the footer of Parquet have no checksum: damage there may pass.
_UNDETECTED_SHARE = 0.01
_BYTES = ("flip", "cut", "overwrite", "insert")
_TRACK = "netelement_id,measure_m,latitude_deg,longitude_deg,height_m,sigma_m\n" + "".join(
    f"a,{100 * number},50.{number},4.0,100.0,0.1\n" for number in range(9)
)
_BALISES = "balise_id,netelement_id,measure_m,kind,location_accuracy_m,linked\nVB1,a,150.0,virtual,5.0,true\n"
_WORDS = (
    b"1e308",
    b"-1",
    b"[" * 5000,
    b"{" * 5000,
    b"9" * 5000,
    b"null",
    b"nan",
    b'"',
    b"\n",
    b",",
    b"\xff",
    b"=",
    b"0x" + b"f" * 900,
)

Case = Callable[[Random, Path], str]


def mutated(content: bytes, random: Random) -> bytes:
    """Some bytes changed, or a word put in that programs stumble over."""
    if random.random() < 0.4:
        at = int(random.integers(len(content) + 1))
        return content[:at] + _WORDS[random.integers(len(_WORDS))] + content[at + int(random.integers(20)) :]
    if len(content) < 1000:
        content = content + b" " * (1000 - len(content))
    return MUTATIONS[_BYTES[random.integers(len(_BYTES))]](content, random, content)


def log_case(encoding: Encoding, run: RunLog) -> Case:
    """A message or a schema of a log changed, the log written anew."""
    stream = io.BytesIO()
    write_mcap(run, stream, encoding, "none")

    def case(random: Random, folder: Path) -> str:
        path = folder / "case.mcap"
        path.write_bytes(_rewritten(stream.getvalue(), random))
        log = read_run(path, IngestConfig())
        expected = _stock_positions(path)
        if expected is None:
            return "unjudged"
        found = log.gnss.select("latitude_deg", "longitude_deg").rows()
        left = iter(expected)
        return (
            "whole"
            if all(row in left for row in found)
            else f"WRONG {len(found)} positions are not the stock decoder's"
        )

    return case


def _rewritten(content: bytes, random: Random) -> bytes:
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    messages = list(make_reader(io.BytesIO(content)).iter_messages(log_time_order=False))
    chosen, in_schema = int(random.integers(len(messages))), bool(random.random() < 0.3)
    target = io.BytesIO()
    writer = Writer(target, compression=CompressionType.NONE)
    writer.start()
    ids: dict[int, int] = {}
    for number, (schema, channel, message) in enumerate(messages):
        if channel.id not in ids:
            mine = in_schema and channel.id == messages[chosen][1].id
            old = schema.data if schema else b""
            data = mutated(old, random) if mine else old
            name, kind = (schema.name, schema.encoding) if schema else ("", "")
            schema_id = writer.register_schema(name, kind, data)
            ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
        payload = mutated(message.data, random) if number == chosen and not in_schema else message.data
        writer.add_message(ids[channel.id], message.log_time, payload, message.publish_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return target.getvalue()


def _stock_positions(path: Path) -> list[tuple[float | None, float | None]] | None:
    """Latitude and longitude of every position by the stock decoders; none where they refuse the schema itself.

    They hold names to the conventions of ROS, which a reader of positions need not.
    """
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    factories = (ProtobufFactory(), Ros2Factory())
    rows = []
    for schema, channel, message in make_reader(io.BytesIO(path.read_bytes())).iter_messages(topics=["/gnss"]):
        if channel.message_encoding == "json":
            value = json.loads(message.data)
            rows.append((value.get("latitude_deg"), value.get("longitude_deg")))
            continue
        try:
            decoders = [factory.decoder_for(channel.message_encoding, schema) for factory in factories]
        except Exception:
            return None
        decode = next(decoder for decoder in decoders if decoder is not None)
        rows.append(_place_of(decode(message.data)))
    return rows


def _place_of(message: Any) -> tuple[float | None, float | None]:
    own = hasattr(message, "latitude_deg")
    names = ("latitude_deg", "longitude_deg") if own else ("latitude", "longitude")
    present = [not own or not hasattr(message, "HasField") or message.HasField(name) for name in names]
    latitude, longitude = (
        getattr(message, name) if there else None for name, there in zip(names, present, strict=True)
    )
    return latitude, longitude


def parquet_case(gnss: pl.DataFrame) -> Case:
    """Bytes of a stream changed."""
    content = parquet_bytes(gnss)

    def case(random: Random, folder: Path) -> str:
        (folder / "run").mkdir(exist_ok=True)
        (folder / "run/gnss.parquet").write_bytes(mutated(content, random))
        return "whole" if read_run(folder / "run", IngestConfig()).gnss.equals(gnss) else "undetected"

    return case


def site_case(names: dict[str, bytes]) -> Case:
    """One of the files of a site changed."""

    def case(random: Random, folder: Path) -> str:
        place = folder / "site"
        place.mkdir(exist_ok=True)
        for old in place.iterdir():
            old.unlink()
        chosen = list(names)[random.integers(len(names))]
        for name, content in names.items():
            (place / name).write_bytes(mutated(content, random) if name == chosen else content)
        read_site(place)
        return "whole"

    return case


def settings_case(random: Random, folder: Path) -> str:
    """The default configuration as TOML, changed."""
    (folder / "config.toml").write_bytes(mutated(to_toml(Configuration()).encode(), random))
    load_settings(folder / "config.toml", Configuration)
    return "whole"


def cases() -> dict[str, Case]:
    run = run_of(0.002)
    line = {"type": "LineString", "coordinates": [[4.0, 50.0 + number / 1000, 100.0] for number in range(9)]}
    network = {
        "type": "FeatureCollection",
        "features": [{"type": "Feature", "properties": {"id": "a", "sigma_m": 0.1}, "geometry": line}],
    }
    return {
        "cdr": log_case("cdr", run),
        "protobuf": log_case("protobuf", run),
        "json": log_case("json", run),
        "parquet": parquet_case(run.gnss),
        "csv": site_case({"track.csv": _TRACK.encode(), "balises.csv": _BALISES.encode()}),
        "geojson": site_case({"track.geojson": json.dumps(network).encode()}),
        "toml": settings_case,
    }


def fuzz(count: int, seed: int = 1, first: int = 0, chosen: Mapping[str, Case] | None = None) -> FuzzReport:
    """Run cases `first` to `first + count`, of these kinds."""
    report = FuzzReport(seed, first, count, Counter(), Counter())
    known = cases() if chosen is None else chosen
    with tempfile.TemporaryDirectory() as name:
        for number in range(first, first + count):
            random = np.random.default_rng((seed, number))
            kind = list(known)[random.integers(len(known))]
            begin = time.perf_counter()
            outcome = _outcome(known[kind], random, Path(name))
            taken_s = time.perf_counter() - begin
            report.slowest_s = max(report.slowest_s, taken_s)
            if taken_s > _SLOWEST_S:
                outcome = f"WRONG took {taken_s:.1f} s"
            word, _, finding = outcome.partition(" ")
            report.outcomes[word] += 1
            report.mutations[f"{kind}: {word}"] += 1
            if word == "WRONG":
                report.failures.append((number, kind, finding))
    undetected, tried = (
        report.outcomes["undetected"],
        sum(n for name, n in report.mutations.items() if name.startswith("parquet")),
    )
    if undetected > max(2, _UNDETECTED_SHARE * tried):
        report.failures.append((-1, "parquet", f"{undetected} of {tried} changes were read without a word"))
    return report


def _outcome(case: Case, random: Random, folder: Path) -> str:
    try:
        return case(random, folder)
    except BaliseError:
        return "error"
    except BaseException as error:
        return f"WRONG {type(error).__name__}: {error}"[:300]


def main(about: str | None = __doc__, chosen: Mapping[str, Case] | None = None, count: int = 5000) -> int:
    """The command line of this benchmark, and of the others on its frame; without a seed a fresh one is drawn."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    seed = secrets.randbits(32) if given.seed is None else given.seed
    print(f"seed {seed}", flush=True)
    report = fuzz(given.count, seed, given.first, chosen)
    for name, number in sorted(report.mutations.items()):
        print(f"{name:25s} {number:7d}")
    for failure in report.failures[:20]:
        print("WRONG", *failure)
    print(f"{given.count} cases, {len(report.failures)} wrong, slowest {report.slowest_s:.2f} s")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
