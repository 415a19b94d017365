"""Project files written: for logs that were named (`trial`), and for what lies in a folder (`init`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline import storage
from pipeline.project.draft import project_text
from pipeline.project.found import Kind, look_around
from pipeline.project.trial import Drafted, Wanted, correction_lines
from pipeline.read.ingest.parts import drafts_of
from schemas.errors import UsageError
from schemas.project import FILE_NAME

_ONE_OF: dict[Kind, str] = {
    "sites": "sites",
    "balises": "tables of balises",
    "vehicles": "vehicle files",
    "configs": "configuration files",
}


def wanted_of_folder(folder: Path) -> Wanted:
    """What a folder offers for a project. Raises `UsageError` where there are several of what there can be one of."""
    if not folder.exists():
        return Wanted(())
    found = look_around(folder)
    for kind, what in _ONE_OF.items():
        if len(found[kind]) > 1:
            raise UsageError(
                f"holds several {what}",
                place=str(folder),
                found=", ".join(map(str, found[kind])),
                remedy="Move away what is not meant, or name what is: balise trial RAW... --track LINE --to FOLDER.",
            )
    sites, balises, vehicle, config = (next(iter(found[kind]), None) for kind in _ONE_OF)
    listed = None if sites or balises is None else str(balises)
    track = found["sites"] or found["surveys"]
    return Wanted(found["logs"], track, listed, vehicle=vehicle, config=config, strict=False)


def refuse_existing(folder: Path, force: bool) -> None:
    """Refuse to write over a project that is there, unless `force`."""
    file = folder / FILE_NAME
    if file.exists() and not force:
        raise UsageError("is there already", place=str(file), remedy="Edit it, or write it anew with --force.")


def write_project(drafted: Drafted, folder: Path) -> Path:
    """Write the file; returns its path as it was named."""
    file = folder / FILE_NAME
    storage.write_bytes(file, project_text(drafted).encode())
    return file


def next_command(file: Path) -> str:
    """What to type next."""
    return "balise run" if file.parent.resolve() == Path.cwd() else f"balise run --project {file.parent}"


def result_lines(drafted: Drafted, file: Path) -> list[str]:
    """Lines on what was written and left out, and the command that comes next."""
    words = [""]
    for proposal in drafted.proposals:
        words += [f"{proposal.run_id} does not fit as recorded:", *(f"  {sentence}" for sentence in proposal.found)]
        words += [f"  {line}" for line in correction_lines(proposal.corrections)]
        how = "accepted." if proposal.accepted else f"NOT accepted: {_UNACCEPTED}"
        words.append(f"  These corrections are {how}")
    drafts = drafts_of(drafted.parts)
    if drafts:
        words += [_DRAFTS, *(f"  {line}" for line in drafts)]
    return [*words, *drafted.remarks, f"Wrote {file}. Look at it, then", f"now: {next_command(file)}"]


_DRAFTS = (
    "Topics that feed nothing. To read one, save its lines without # as config.toml, and add --config config.toml:"
)
_UNACCEPTED = "they stand in the file as comments; remove the # or add --accept-corrections."


def json_answer(drafted: Drafted, file: Path) -> dict[str, Any]:
    """What `balise init --json` prints."""
    proposals = [vars(proposal) | {"toml": correction_lines(proposal.corrections)} for proposal in drafted.proposals]
    fields = ("run_id", "found", "toml", "accepted")
    return {
        "file": file,
        "logs": drafted.logs,
        "corrections": [{name: proposal[name] for name in fields} for proposal in proposals],
        "parts": [vars(part) for part in drafted.parts],
        "remarks": drafted.remarks,
        "next": next_command(file),
    }
