"""A project as text, for people to read and edit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files

import tomli_w

from pipeline.project.trial import Drafted, Proposal, correction_lines
from schemas.config import Settings
from schemas.errors import visible
from schemas.project import ConvertEntry

_HEAD = (
    "# A project of balise: `balise run` in this folder brings everything up to date.\n"
    "# Paths are relative to this file. docs/project.md explains every key; the end of this file lists them all.\n"
)
_NO_SITE = (
    "# The line is still missing. Name a survey to make a site of, or a folder that is a site:\n"
    '# track.survey = ["line.gpx"]\n# track.balises = "every 1000"\n# site = "site"\n'
)
_NO_BALISES = (
    "# No balises are named: the replay ends with matching and monitors. For virtual balises every kilometre:\n"
)
_NO_RUNS = "# No logs were found. Each run of receiver's logs is a table like this:\n"
_ONE_RUN = '# [[convert]]\n# to = "runs/monday"\n# [[convert.logs]]\n# files = ["raw/monday.ubx"]\n'


def project_text(drafted: Drafted) -> str:
    """The file; what was left out or not accepted stands in it as a comment."""
    project = drafted.opened.project
    site_is_there = (drafted.opened.folder / project.site).exists()
    parts = [_HEAD, _settings_text(project, without=("track", "convert", "replay"))]
    if project.track is not None:
        parts.append(
            "# The site is made of a survey, as `balise site` does.\n"
            + tomli_w.dumps({"track": _set_keys(project.track)})
        )
        if project.track.balises is None:
            parts.append(_NO_BALISES + '# balises = "every 1000"\n')
    elif not site_is_there:
        parts.insert(1, _NO_SITE)
    if not project.convert and not project.replay.runs:
        parts.append(_NO_RUNS + _ONE_RUN)
    parts += [_entry_text(entry, drafted) for entry in project.convert]
    if project.replay.runs:
        head = "# Runs that need no conversion.\n"
        parts.append(head + tomli_w.dumps({"replay": _set_keys(project.replay)}))
    parts += ["".join(f"# {line}\n" for line in _as_one_line(drafted.remarks))] if drafted.remarks else []
    keys = (files("pipeline.project") / "keys.txt").read_text(encoding="utf-8")
    return "\n".join([*filter(None, parts), keys])


def _entry_text(entry: ConvertEntry, drafted: Drafted) -> str:
    """One run, with what its logs feed in front and corrections that were not accepted behind."""
    rows = drafted.logs.filter(drafted.logs["run_id"] == entry.run_id).drop("run_id").iter_rows(named=True)
    head = [f"# {row['log']}: {row['rows']} rows of {row['feeds']}, {row['from']} to {row['to']}\n" for row in rows]
    own = [proposal for proposal in drafted.proposals if proposal.run_id == entry.run_id]
    behind = [line for proposal in own if not proposal.accepted for line in _proposal_lines(proposal)]
    reasons = [
        f"# corrected: {sentence}\n"
        for proposal in own
        if proposal.accepted
        for sentence in _as_one_line(proposal.found)
    ]
    return "".join([*map(visible, head), *reasons, tomli_w.dumps({"convert": [_set_keys(entry)]}), *behind])


def _proposal_lines(proposal: Proposal) -> Iterator[str]:
    """Corrections that were not accepted, as comments of the file."""
    yield f"# {proposal.run_id} does not fit as recorded. Remove the # to accept these corrections:\n"
    yield from (f"# {sentence}\n" for sentence in _as_one_line(proposal.found))
    yield from (f"#{line}\n" for line in correction_lines(proposal.corrections))


def _as_one_line(texts: Sequence[str]) -> list[str]:
    """Each text in one line, control characters made visible."""
    return [visible(" ".join(text.split())) for text in texts]


def _set_keys(settings: Settings) -> dict[str, object]:
    """Keys that are not at their default."""
    return settings.model_dump(exclude_defaults=True)


def _settings_text(settings: Settings, without: Sequence[str]) -> str:
    """Settings as TOML, but for those left out."""
    return tomli_w.dumps({name: value for name, value in _set_keys(settings).items() if name not in without})
