"""`OUT/manifest.json`: which files made a result, by which program, and the digest of every file of it.

What a run was made from stands in the metadata of its `runs` table (its marker), written together with it, and so do
the digests of its other tables. The manifest gathers that, so that it is whole after any number of calls, whoever ended
them. The names of configuration and vehicle files, and the digests of pages, are kept by the manifest alone.
"""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import to_json

from pipeline import storage
from pipeline.results import packs, store
from pipeline.results.marker import sha256
from pipeline.storage import FileDigest, files
from pipeline.storage.address import Address, join, redacted
from schemas.errors import UsageError
from schemas.tables import CONTRACT_VERSION, TABLES
from schemas.version import SOFTWARE

NAME = "manifest.json"
FORMAT = 1

T = TypeVar("T")
Manifest = dict[str, Any]
_DIGESTS = TypeAdapter(dict[str, str])
_LISTING = TypeAdapter(list[tuple[str, int, str]])

SettingsFiles = Mapping[str, Any]
"""The `configuration` and the `vehicle` file of a call; None where the defaults served."""


class _Strict(BaseModel):
    """Models of the file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", strict=True)


class _File(_Strict):
    """A file with its size and digest."""

    name: str = ""
    bytes: int
    sha256: str


class _Run(_Strict):
    """What one run was made from."""

    status: str | None
    software: str | None
    software_digest: str | None
    config_digest: str | None
    log: list[_File]
    raw: list[_File] = []
    site: str
    route_sha256: str | None
    tables: dict[str, str | None]


class _Form(_Strict):
    """The manifest as it is written."""

    manifest: Literal[1]
    program: dict[str, Any]
    platform: dict[str, str]
    settings: dict[str, list[dict[Literal["configuration", "vehicle"], _File | None]]]
    files: dict[str, _File]
    sites: dict[str, list[_File]]
    runs: dict[str, _Run]
    pages: dict[str, _File] = {}


def settings_files(configuration: Path | None = None, vehicle: Path | None = None) -> SettingsFiles:
    """Names, sizes and digests of the settings files that were given."""
    paths = {"configuration": configuration, "vehicle": vehicle}
    return {name: None if path is None else _file_entry(storage.file_digests(path)[0]) for name, path in paths.items()}


def file_list_text(listed: Iterable[tuple[str, int, str]]) -> str:
    """Files with name, size [bytes] and SHA-256 as they stand in the metadata of a run."""
    return json.dumps([list(file) for file in listed])


def note_settings(out: Address, config_digest: str, settings: SettingsFiles) -> None:
    """Keep the names of this call's settings files, before any run is made with them."""
    manifest = earlier_manifest(out)
    known = manifest["settings"].setdefault(config_digest, [])
    if settings not in known:
        known.append(settings)
        _write(out, manifest)


def note_pages(out: Address, pages: Mapping[str, bytes]) -> None:
    """Keep the digests of the pages of this result, by their names in `OUT/report`, where it has a manifest."""
    manifest = earlier_manifest(out)
    if manifest["runs"]:
        _write(out, manifest | {"pages": {name: _content_entry(content) for name, content in sorted(pages.items())}})


def write_manifest(out: Address, made: Collection[str] = (), found: RunsFound | None = None) -> None:
    """Gather the manifest from all complete runs and write it; `made`: those that this call replayed; `found`: what
    all of them say, where it was read already.

    A run that was changed since without being replayed keeps its entry, so that `balise verify` goes on to see it.
    """
    before = earlier_manifest(out)
    manifest = gather_manifest(out, before, found)
    for run, there in manifest["runs"].items():
        named = before["runs"].get(run)
        if run not in made and _is_altered(named, there):
            manifest["runs"][run] = named
    _write(out, manifest)


def unaltered_metadata(out: Address, runs: Sequence[str]) -> dict[str, dict[str, str]]:
    """Metadata of each complete run among these whose marker is as it was written."""
    if not runs:
        return {}
    named = earlier_manifest(out)["runs"]
    found = ((marker, marker.metadata) for marker in store.markers(out, runs))
    return {
        marker.run_id: metadata
        for marker, metadata in found
        if not _is_altered(named.get(marker.run_id), _run_entry(metadata, marker.sha256))
    }


def digests_in_marker(metadata: Mapping[str, str]) -> dict[str, str]:
    """The digests of the other tables that stand in a marker."""
    return _parse_metadata(_DIGESTS, metadata.get("tables"), {})


def _is_altered(named: Mapping[str, Any] | None, found: Mapping[str, Any]) -> bool:
    """Other tables of the same sources, settings and program: the same content always gives the same bytes."""
    if named is None:
        return False
    return named["tables"] != found["tables"] and {**named, "tables": None} == {**found, "tables": None}


class RunsFound(NamedTuple):
    """What the marker of each complete run says, in the form of the manifest; the files of each site by its digest."""

    runs: dict[str, Any]
    sites: dict[str, Any]

    @property
    def digests(self) -> list[tuple[str, str]]:
        """Each run with the SHA-256 of its marker, which holds those of its other tables."""
        return [(run, found["tables"]["runs"]) for run, found in self.runs.items()]


def runs_found(out: Address) -> RunsFound:
    """Read the markers of all complete runs, in the order of their ids."""
    found = RunsFound({}, {})
    for marker in store.markers(out):
        metadata = marker.metadata
        site = metadata.get("site_digest", "").partition(" ")[0]
        found.sites[site] = _file_entries(metadata.get("site_files"))
        found.runs[marker.run_id] = _run_entry(metadata, marker.sha256)
    return found


def gather_manifest(out: Address, before: Manifest, found: RunsFound | None = None) -> Manifest:
    """The manifest as the files of the result say; of the one before what no file says."""
    runs, sites = runs_found(out) if found is None else found
    used = {run["config_digest"] for run in runs.values()}
    pages = {"pages": before["pages"]} if before.get("pages") else {}
    return {
        **_manifest_frame(),
        "settings": {digest: files for digest, files in sorted(before["settings"].items()) if digest in used},
        "files": _own_files(out),
        "sites": dict(sorted(sites.items())),
        "runs": runs,
        **pages,
    }


def read_manifest(out: Address) -> Manifest | None:
    """The manifest of a result; None where it has none. Raises `UsageError` for one that cannot be read."""
    address = join(out, NAME)
    content = storage.content_of(address)
    if content is None:
        return None
    try:
        _Form.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(
            "is not a manifest of this program",
            place=redacted(str(address)),
            found=": ".join([".".join(map(str, first["loc"])), first["msg"]]).lstrip(": "),
            remedy="`balise replay` writes one.",
        ) from None
    return dict(json.loads(content))


def anchor(out: Address) -> tuple[str, int]:
    """SHA-256 of the manifest as it lies there, and of how many runs it is: what a signed report can name.

    Whoever keeps it elsewhere finds any later change of the result. Raises `UsageError` as `read_manifest`.
    """
    manifest = read_manifest(out)
    content = storage.content_of(join(out, NAME))
    if manifest is None or content is None:
        remedy = "Results of an earlier version have none: replay them again."
        raise UsageError(f"has no {NAME}", place=redacted(str(out)), remedy=remedy)
    return sha256(content), len(manifest["runs"])


def anchor_words(digest: str, runs: int) -> str:
    """The line that a campaign prints: by it a manifest can be recognised later."""
    return f"{NAME}: sha256 {digest} of {runs} {'run' if runs == 1 else 'runs'}"


def earlier_manifest(out: Address) -> Manifest:
    """The manifest as earlier calls left it; one that cannot be read is written anew."""
    try:
        return read_manifest(out) or _manifest_frame()
    except UsageError:
        return _manifest_frame()


def own_file_names(out: Address) -> list[str]:
    """What belongs to no single run, from the result's folder on: settings, list of packs, tables of the campaign."""
    campaign = join(out, "campaign")
    there = files.list_dir(campaign) if files.exists(campaign) else []
    settings = ["config.toml", *(["vehicle.toml"] if files.exists(join(out, "vehicle.toml")) else [])]
    packed = [packs.LIST] if files.exists(join(out, packs.LIST)) else []
    return [*settings, *packed, *(f"campaign/{name}" for name in there if re.fullmatch(r"\w+\.parquet", name))]


def _manifest_frame() -> Manifest:
    """What does not come from runs."""
    return {
        "manifest": FORMAT,
        "program": {"software": SOFTWARE, "contract": CONTRACT_VERSION, "packages": dict(_package_versions())},
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
def _package_versions() -> Mapping[str, str]:
    """Versions of the packages that the program needs."""
    try:
        needed = [re.split(r"[^\w.-]", line)[0] for line in requires("balise") or [] if "extra ==" not in line]
    except PackageNotFoundError:
        needed = []
    return MappingProxyType({name: version(name) for name in sorted(needed, key=str.lower)})


def _run_entry(metadata: Mapping[str, str], runs_sha256: str) -> dict[str, Any]:
    """What one run was made from, and the digests of its tables."""
    digests = digests_in_marker(metadata) | {"runs": runs_sha256}
    site, _, route = metadata.get("site_digest", "").partition(" ")
    return {
        "status": metadata.get("status"),
        "software": metadata.get("software"),
        "software_digest": metadata.get("software_digest"),
        "config_digest": metadata.get("config_digest"),
        "log": _file_entries(metadata.get("log_files")),
        **({"raw": raw} if (raw := _file_entries(metadata.get("raw_files"))) else {}),
        "site": site,
        "route_sha256": route or None,
        "tables": {name: digests.get(name) for name in TABLES},
    }


def _file_entries(listed: str | None) -> list[dict[str, Any]]:
    """Files that a run's metadata lists, in the form of the manifest."""
    return [_file_entry(FileDigest(*file)) for file in _parse_metadata(_LISTING, listed, [])]


def _parse_metadata(kind: TypeAdapter[T], text: str | None, default: T) -> T:
    """What stands in the metadata of a run; the default for text that this program did not write."""
    try:
        return default if text is None else kind.validate_json(text)
    except ValidationError:
        return default


def _file_entry(file: FileDigest) -> dict[str, Any]:
    """A file in the form of the manifest."""
    return {"name": file.name, "bytes": file.size_bytes, "sha256": file.sha256}


def _own_files(out: Address) -> dict[str, dict[str, Any]]:
    """Size and digest of the files that the campaign itself wrote."""
    contents = {name: storage.content_of(join(out, name)) for name in own_file_names(out)}
    return {name: _content_entry(content) for name, content in contents.items() if content is not None}


def _content_entry(content: bytes) -> dict[str, Any]:
    """Size and digest of a content."""
    return {"bytes": len(content), "sha256": sha256(content)}


def _write(out: Address, manifest: Manifest) -> None:
    """Write the manifest, if it changed."""
    # What `json.dumps` writes, which takes ten times as long where it indents.
    content = to_json(manifest, indent=1) + b"\n"
    if storage.content_of(join(out, NAME)) != content:
        storage.write_bytes(join(out, NAME), content)
