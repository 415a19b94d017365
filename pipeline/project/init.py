"""Project files written: for logs that were named (`trial`), and for what lies in a folder (`init`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline import storage
from pipeline.project.draft import project_text
from pipeline.project.found import look_around
from pipeline.project.trial import Drafted, Wanted, correction_lines
from schemas.errors import UsageError
from schemas.project import FILE_NAME


def wanted_in(folder: Path) -> Wanted:
    """What a folder offers for a project. Raises `UsageError` where there are several of what there can be one of."""
    if not folder.exists():
        return Wanted(())
    found = look_around(folder)
    several = {"sites": found.sites, "tables of balises": found.balises}
    several |= {"vehicle files": found.vehicles, "configuration files": found.configs}
    for what, paths in several.items():
        if len(paths) > 1:
            raise UsageError(
                f"holds several {what}",
                place=str(folder),
                found=", ".join(map(str, paths)),
                remedy="Move away what is not meant, or name what is: balise trial RAW... --track LINE --to FOLDER.",
            )
    vehicle = next(iter(found.vehicles), None)
    config = next(iter(found.configs), None)
    balises = None if found.sites or not found.balises else str(found.balises[0])
    return Wanted(found.logs, found.sites or found.surveys, balises, vehicle=vehicle, config=config, strict=False)


def refuse_existing(folder: Path, force: bool) -> None:
    """A project that is there stays, unless `force`."""
    file = folder / FILE_NAME
    if file.exists() and not force:
        raise UsageError("is there already", place=str(file), remedy="Edit it, or write it anew with --force.")


def write_project(drafted: Drafted, folder: Path) -> Path:
    """Write the file; returns its path as it was named."""
    file = folder / FILE_NAME
    storage.write_bytes(file, project_text(drafted).encode())
    return file


def next_command(file: Path) -> str:
    return "balise run" if file.parent.resolve() == Path.cwd() else f"balise run --project {file.parent}"


def words_of(drafted: Drafted, file: Path) -> list[str]:
    """What there is to say, and the command that comes next."""
    words = [""]
    for proposal in drafted.proposals:
        words += [f"{proposal.run_id} does not fit as recorded:", *(f"  {sentence}" for sentence in proposal.found)]
        words += [f"  {line}" for line in correction_lines(proposal.corrections)]
        fate = "accepted" if proposal.accepted else "NOT accepted: they stand in the file as comments"
        words.append(
            f"  These corrections are {fate}."
            if proposal.accepted
            else f"  These corrections are {fate}; remove the # or add --accept-corrections."
        )
    words += drafted.remarks
    words.append(f"Wrote {file}. Look at it, then")
    return [*words, f"now: {next_command(file)}"]


def answer_of(drafted: Drafted, file: Path) -> dict[str, Any]:
    """The same for programs."""
    proposals = [
        {
            "run_id": proposal.run_id,
            "found": list(proposal.found),
            "toml": correction_lines(proposal.corrections),
            "accepted": proposal.accepted,
        }
        for proposal in drafted.proposals
    ]
    return {
        "file": file,
        "logs": drafted.logs,
        "corrections": proposals,
        "remarks": drafted.remarks,
        "next": next_command(file),
    }
