"""Every sentence for people about a run (`words.toml`), keyed by the enum or the column that says the same to programs.

Words are made here, at the edge, and nothing reads them back: whatever stands there may be reworded without a figure,
a column or a verdict changing (`tests/replay/test_rewording.py`).
"""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from importlib.resources import files
from string import Formatter
from typing import Any, TypeVar

from schemas.enums import Evidence, LostTo, MisfitCause, MisfitPlace, Note, NotShown, Reason, Remedy, RunVerdict
from schemas.frozen import frozen

Code = TypeVar("Code", bound=StrEnum)
BETWEEN = "; "
"""What stands between the notes of a run; no note holds it itself."""

# How many losses a sentence names; from which share on.
_NAMED = 3
_LEAST_SHARE = 0.005

WORDS: dict[str, Any] = tomllib.loads((files("schemas") / "words.toml").read_text(encoding="utf-8"))
"""Sections of `words.toml` by name."""


def say(section: str, name: str, /, *figures: object, **named: object) -> str:
    """The words of a section under a name, with their figures: `say("hazards", "in_use", 3.0, 0.5)`.

    Args:
        section: section of `words.toml`.
        name: key in it.
        figures: by place.
        named: figures by name.

    Returns:
        The sentence.
    """
    return str(WORDS[section][name]).format(*figures, **named)


_OPTIONAL = re.compile(r"\[([^\[\]]*)\]")


def say_of(section: str, name: str, figures: Mapping[str, object]) -> str:
    """The words of a section with figures by name; a part in [brackets] stands only where its first figure does.

    A figure stands where it is neither null nor zero.

    Args:
        section: section of `words.toml`.
        name: key in it.
        figures: by name.

    Returns:
        The sentence.
    """

    def part(match: re.Match[str]) -> str:
        """A part of a sentence; nothing where its figure is zero or not known."""
        first = next(field for _, field, _, _ in Formatter().parse(match[1]) if field)
        return match[1] if figures[first] else ""

    return _OPTIONAL.sub(part, str(WORDS[section][name])).format_map(figures)


def _sentences_by_code(kind: type[Code], section: str) -> dict[Code, str]:
    """The sentence of each code of an enumeration."""
    return {code: WORDS[section][code.value] for code in kind}


NOTES = _sentences_by_code(Note, "notes")
REASONS = _sentences_by_code(Reason, "reasons")
CAUSES = _sentences_by_code(MisfitCause, "causes")
MISFIT_PLACES = _sentences_by_code(MisfitPlace, "misfit_places")
LOST = _sentences_by_code(LostTo, "lost")
NOT_SHOWN = _sentences_by_code(NotShown, "not_shown")
REMEDIES = _sentences_by_code(Remedy, "remedies")
EVIDENCE_LIMITS = _sentences_by_code(Evidence, "evidence_limits")
JUDGES: Mapping[str, str] = {kind.value: words for kind, words in _sentences_by_code(Evidence, "judges").items()}


@frozen
class Remark:
    """A note with its figures or names, in the order in which its words take them."""

    note: Note
    figures: tuple[object, ...] = ()

    @property
    def words(self) -> str:
        """The note as a sentence."""
        return NOTES[self.note].format(*self.figures)


def remarks(noted: Mapping[Note, object]) -> list[Remark]:
    """The notes of what there is.

    Args:
        noted: figures by note; falsy means that there is nothing to say, a tuple holds several figures.

    Returns:
        What there is to say, in the order given.
    """
    return [Remark(note, value if isinstance(value, tuple) else (value,)) for note, value in noted.items() if value]


def notes_text(noted: Iterable[Remark]) -> str | None:
    """All notes as they stand in `runs.notes`.

    Args:
        noted: what there is to say.

    Returns:
        One text, or None for nothing.
    """
    return BETWEEN.join(remark.words.replace(BETWEEN, ", ") for remark in noted) or None


def notes_apart(notes: str | None) -> list[str]:
    """The same one by one, to show each on a line of its own.

    Args:
        notes: `runs.notes`.

    Returns:
        One text per note.
    """
    return notes.split(BETWEEN) if notes else []


def lost_words(
    lost_to: Sequence[str] | None, shares: Sequence[float] | None, monitor: str | None, lost_share: float | None = None
) -> str:
    """What moving time was lost to, the largest first: `82 % alarms (mostly along_raw), 3 % no odometer`.

    Args:
        lost_to: causes of the losses, the largest first.
        shares: of the moving time, one per cause [1].
        monitor: the monitor that gave most alarms.
        lost_share: of all that was lost [1]; what none of the causes explains is named last.

    Returns:
        The words, empty without losses.
    """
    losses = list(zip(lost_to or (), shares or (), strict=True))
    details = {LostTo.ALARM: f" (mostly {monitor})"} if monitor else {}
    named = [
        f"{share:.0%} {LOST[LostTo(cause)]}{details.get(LostTo(cause), '')}"
        for cause, share in losses[:_NAMED]
        if share >= _LEAST_SHARE
    ]
    rest = 0.0 if lost_share is None else lost_share - sum(share for _, share in losses)
    return ", ".join([*named, *([f"{rest:.0%} {say('lost', 'otherwise')}"] if rest >= _LEAST_SHARE else [])])


def reason_words(run: Mapping[str, Any]) -> str:
    """Why a `runs` row has its verdict, one reason after the other, with its figures.

    Args:
        run: a `runs` row.

    Returns:
        Reasons with their figures, separated by semicolons.
    """
    undecided = run["failures"] - run["failures_within_budget"] - run["failures_beyond_budget"]
    figures = {name: 0 if value is None else value for name, value in run.items()} | {"failures_undecided": undecided}
    reasons = [REASONS[Reason(reason)].format_map(figures) for reason in run["reasons"] or ()]
    return "; ".join(reasons) or say("reasons", "none")


def part_words(run: Mapping[str, Any]) -> str:
    """`safe from 12:00:03 to 12:41:50, 92% of the moving time`: the verdict between first and last anchor, where it is
    another than the run's.

    Args:
        run: a `runs` row.

    Returns:
        The words, or nothing.
    """
    if run["part_verdict"] in (None, run["verdict"]):
        return ""
    return say("verdicts", "part", *(run[f"part_{name}"] for name in ("verdict", "from", "to", "share")))


def verdict_figures_words(run: Mapping[str, Any]) -> str:
    """What is said next to every verdict: balises accepted of those on the path, availability, proof margin; and next
    to a safe one what it rests on by declaration alone.

    Args:
        run: a `runs` row, or figures of several runs with `odometer_origins`, those of the safe ones.

    Returns:
        The words, separated by commas.
    """
    share, margin_m = run["availability"], run["proof_margin_m"]
    once, times = accepted_words(run)
    accepted = say("verdicts", "accepted", once) + times
    available = say("verdicts", "no_motion") if share is None else say("verdicts", "available", share)
    margin = [] if margin_m is None else [say("verdicts", "margin", margin_m)]
    return ", ".join([accepted, available, *margin, *_provided(run)])


def accepted_words(run: Mapping[str, Any]) -> tuple[str, str]:
    """`7 of 9`: balises accepted of those passed, each once; and how often, where that is not the same.

    Args:
        run: a `runs` row, or figures of several runs.

    Returns:
        `7 of 9`, and how often or nothing.
    """
    once = run["balises_found"], run["balises_passed"]
    times = run["balises_accepted"], run["balises_on_path"]
    return say("verdicts", "of", *once), say("verdicts", "times", *times) if times != once else ""


def _provided(run: Mapping[str, Any]) -> list[str]:
    """No statistic of a run tells every odometer of the GNSS from a wheel (DOMAIN section 5.0)."""
    own = [run["odometer_origin"]] if run.get("verdict") == RunVerdict.SAFE and run["odometer_origin"] else []
    named = [say("origins", origin) for origin in run.get("odometer_origins", own)]
    return [say("verdicts", "provided", " or ".join(named))] if named else []


def unnoticed_words(largest_m: float | None, beyond_share: float | None = None) -> str:
    """How large an error may stay unnoticed.

    Args:
        largest_m: the largest unnoticed error while in use [m]; None where it was not computed.
        beyond_share: of the epochs in use, with one beyond the failure limit [1].

    Returns:
        The words.
    """
    if largest_m is None:
        return say("verdicts", "unnoticed_not_known")
    return say("verdicts", "unnoticed", largest_m) + (
        say("verdicts", "unnoticed_beyond", beyond_share) if beyond_share else ""
    )


def remedy_words(remedy: Remedy | str, gain: float = 0.0, **places: str) -> str:
    """What would mend it, how, and which share of the moving time that would win back or prove at most.

    Args:
        remedy: what would help.
        gain: share of the moving time that it would win back or prove at most [1].
        places: paths known where it is shown (`run`, `site`, `out`, `config`, `project`); with `project` the keys of
            that file stand in place of a command, without any words for readers inside and outside a project.

    Returns:
        The sentence.
    """
    section = "remedies_of_project" if "project" in places else "remedies_by_command" if places else "remedies_anywhere"
    how = WORDS[section].get(Remedy(remedy).value, "")
    plain = ("options", "of_project", "again", "how_sigma", "how_complete")
    named = {"run": "RUN", "site": "the site", "out": "OUT", "options": ""}
    named |= {name: text if name in plain else shlex.quote(text) for name, text in places.items()}
    won = say("remedies", "gain", gain) if gain >= _LEAST_SHARE else ""
    return REMEDIES[Remedy(remedy)].format(how=how.format(**named), **named) + won
