"""`OUT/manifest.json`: which files made a result, by which program, and the digest of every table.

What a run was made from stands in the metadata of its `runs` table, written together with it, and so do the digests of
its other tables. The manifest gathers that, so that it is whole after any number of calls, whoever ended them. Names of
configuration and vehicle files are no part of a result: the manifest alone keeps them, from call to call.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.results import catalogue, store
from pipeline.storage import FileDigest, files
from pipeline.storage.address import Address, is_url, join, redacted
from schemas.errors import UsageError
from schemas.tables import CONTRACT_VERSION, TABLES
from schemas.version import SOFTWARE

NAME = "manifest.json"
FORMAT = 1
_AT_ONCE = 500

Manifest = dict[str, Any]


SettingsFiles = Mapping[str, Any]
"""The `configuration` and the `vehicle` file of a call; None where the defaults served."""


def settings_files(configuration: Path | None = None, vehicle: Path | None = None) -> SettingsFiles:
    """The files as they were given."""
    given = {"configuration": configuration, "vehicle": vehicle}
    return {name: None if path is None else _file(storage.file_digests(path)[0]) for name, path in given.items()}


def listing(listed: Iterable[tuple[str, int, str]]) -> str:
    """Files with name, size [bytes] and SHA-256 as they stand in the metadata of a run."""
    return json.dumps([list(file) for file in listed])


def note_settings(out: Address, config_digest: str, given: SettingsFiles) -> None:
    """Keep the names of this call's settings files, before any run is made with them."""
    found = _earlier(out)
    known = found["settings"].setdefault(config_digest, [])
    if given not in known:
        known.append(given)
        _write(out, found)


def write_manifest(out: Address) -> Manifest:
    """Gather the manifest from all complete runs and write it; those that did not change since are not read again."""
    states = catalogue.states(out) or {}
    earlier = _earlier(out)
    runs = _unchanged(out, earlier, states)
    sites = {run["site"]: earlier["sites"].get(run["site"], []) for run in runs.values()}
    for run_id, content in _markers(out, [run for run in store.run_ids(out) if run not in runs]):
        metadata = store.metadata_of(content)
        site = metadata.get("site_digest", "").partition(" ")[0]
        sites[site] = _files(metadata.get("site_files"))
        runs[run_id] = _run(metadata, content)
    used = {run["config_digest"] for run in runs.values()}
    manifest = {
        **_frame(),
        "settings": {digest: files for digest, files in sorted(earlier["settings"].items()) if digest in used},
        "files": _own_files(out),
        "sites": dict(sorted(sites.items())),
        "runs": dict(sorted(runs.items())),
    }
    _write(out, manifest)
    # Runs that changed while they were read must not pass for what was read.
    if states and states == catalogue.states(out):
        catalogue.keep(out, NAME, pl.DataFrame({"of": [_sha256(_content(manifest))]}), states)
    return manifest


def _unchanged(out: Address, earlier: Manifest, states: Mapping[str, str]) -> dict[str, Any]:
    """The runs of the manifest as it was gathered last whose files are as they were then."""
    kept, known = catalogue.kept(out, NAME)
    if kept.rows() != [(_sha256(storage.content_of(join(out, NAME)) or b""),)]:
        return {}
    return {run: earlier["runs"][run] for run, state in states.items() if known.get(run) == state}


def read_manifest(out: Address) -> Manifest | None:
    """The manifest of a result; None where it has none. Raises `UsageError` for one that cannot be read."""
    address = join(out, NAME)
    content = storage.content_of(address)
    if content is None:
        return None
    try:
        found = json.loads(content)
        known = isinstance(found, dict) and found["manifest"] == FORMAT
    except (ValueError, KeyError):
        known = False
    if not known:
        raise UsageError(
            "is not a manifest of this program", place=redacted(str(address)), remedy="`balise replay` writes one."
        )
    return dict(found)


def _earlier(out: Address) -> Manifest:
    """The manifest as earlier calls left it; one that cannot be read tells nothing and is written anew."""
    try:
        return read_manifest(out) or _frame()
    except UsageError:
        return _frame()


def own_file_names(out: Address) -> list[str]:
    """What belongs to no single run: the settings and the campaign's tables, from the result's folder on."""
    campaign = join(out, "campaign")
    there = files.list_dir(campaign) if files.exists(campaign) else []
    settings = ["config.toml", *(["vehicle.toml"] if files.exists(join(out, "vehicle.toml")) else [])]
    return [*settings, *(f"campaign/{name}" for name in there if re.fullmatch(r"\w+\.parquet", name))]


def contents_of(places: list[str]) -> dict[str, bytes]:
    """The content of each of these files of one result, in one go where it lies in a store; missing ones left out."""
    if places and is_url(places[0]):
        return storage.read_many(places)
    found = {place: storage.content_of(place) for place in places}
    return {place: content for place, content in found.items() if content is not None}


def _frame() -> Manifest:
    """What does not come from runs."""
    return {
        "manifest": FORMAT,
        "program": {"software": SOFTWARE, "contract": CONTRACT_VERSION, "packages": dict(_packages())},
        "platform": {
            "python": platform.python_version(),
            "system": platform.system(),
            "machine": platform.machine(),
        },
        "settings": {},
        "files": {},
        "sites": {},
        "runs": {},
    }


@cache
def _packages() -> Mapping[str, str]:
    """Versions of the libraries that this program needs."""
    try:
        needed = [re.split(r"[^\w.-]", line)[0] for line in requires("balise") or [] if "extra ==" not in line]
    except PackageNotFoundError:
        needed = []
    return MappingProxyType({name: version(name) for name in sorted(needed, key=str.lower)})


def _run(metadata: Mapping[str, str], marker: bytes) -> dict[str, Any]:
    """What one run was made from, and the digests of its tables."""
    digests = {**json.loads(metadata.get("tables", "{}")), "runs": _sha256(marker)}
    site, _, route = metadata.get("site_digest", "").partition(" ")
    return {
        "status": metadata.get("status"),
        "software": metadata.get("software"),
        "software_digest": metadata.get("software_digest"),
        "config_digest": metadata.get("config_digest"),
        "log": _files(metadata.get("log_files")),
        "site": site,
        "route_sha256": route or None,
        "tables": {name: digests.get(name) for name in TABLES},
    }


def _files(listed: str | None) -> list[dict[str, Any]]:
    return [_file(FileDigest(*file)) for file in json.loads(listed or "[]")]


def _file(file: FileDigest) -> dict[str, Any]:
    return {"name": file.name, "bytes": file.size_bytes, "sha256": file.sha256}


def _own_files(out: Address) -> dict[str, dict[str, Any]]:
    found = {}
    for name in own_file_names(out):
        content = storage.content_of(join(out, name))
        if content is not None:
            found[name] = {"bytes": len(content), "sha256": _sha256(content)}
    return found


def _markers(out: Address, runs: Sequence[str]) -> Iterable[tuple[str, bytes]]:
    """The `runs` table of each of these runs as it lies there, some at a time."""
    for first in range(0, len(runs), _AT_ONCE):
        some = {str(store.table_address(out, "runs", run)): run for run in runs[first : first + _AT_ONCE]}
        contents = contents_of(list(some))
        yield from ((run, contents[place]) for place, run in some.items() if place in contents)


def _write(out: Address, manifest: Manifest) -> None:
    content = _content(manifest)
    if storage.content_of(join(out, NAME)) != content:
        storage.write_bytes(join(out, NAME), content)


def _content(manifest: Manifest) -> bytes:
    return (json.dumps(manifest, indent=1, ensure_ascii=False) + "\n").encode()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
