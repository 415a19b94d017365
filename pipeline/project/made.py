"""What a project has made, of which content and settings: `.balise/made.json` beside its file."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, TypeAdapter, ValidationError

from pipeline import storage
from pipeline.project.opened import RECORD, named_from
from pipeline.results.software import software_digest
from pipeline.storage.address import is_url
from pipeline.storage.noted import NO_DIGEST, digest_now, noting
from schemas.config import Settings
from schemas.errors import UsageError
from schemas.frozen import frozen

_NAME = "made.json"


class _Made(BaseModel):
    """SHA-256 of the settings that a product was made with, of what was read for it, and of each of its files.

    `begun`: nobody knows whether it is whole.
    """

    of: str
    read: dict[str, str] = {}
    files: dict[str, str]
    begun: bool = False


_RECORD = TypeAdapter(dict[str, _Made])


@frozen
class Product:
    """What a step makes: a file or a folder of files, and the SHA-256 over the settings that decide them."""

    name: str
    place: Path
    settings: str

    @property
    def above(self) -> Path:
        """The folder from which its files are noted."""
        return self.place.parent


class Brought(NamedTuple):
    """Whether a product was made by this call.

    `undigested`: inputs that changed while they were read, or cannot be digested, so that the next call makes it again.
    """

    made: bool
    undigested: tuple[str, ...] = ()


class Record:
    """Knows which products are as they were made; written after each, so that an interrupted call loses one at most."""

    def __init__(self, folder: Path, force: bool = False) -> None:
        self._folder = folder.absolute()
        self._file = folder / RECORD / _NAME
        self._force = force
        try:
            self._made = _RECORD.validate_json(storage.content_of(self._file) or b"{}")
        except ValidationError:
            self._made = {}

    def make_if_changed(self, product: Product, make: Callable[[], Sequence[Path]]) -> Brought:
        """Make a product unless it is up to date: unless settings, all that was read for it, and its files are equal.

        Raises `UsageError` where its files are there and this project did not make them, or they were changed since.
        """
        known = self._made.get(product.name)
        if not self._force:
            if known is not None and self._is_up_to_date(product, known):
                return Brought(made=False)
            if known is None or not known.begun:
                _refuse_foreign(product, known)
        before = _file_digests(product.above, _file_names(product))
        # Whoever is killed now leaves files that the next call must not take for somebody else's.
        self._write_entry(product, _Made(of=product.settings, files={} if known is None else known.files, begun=True))
        try:
            with noting() as noted:
                files = make()
        except Exception:
            if _file_digests(product.above, _file_names(product)) == before:
                self._write_entry(product, known)
            raise
        names = [file.relative_to(product.above).as_posix() for file in files]
        read = {self._noted_name(place): digest for place, digest in sorted(noted.digests().items())}
        self._write_entry(product, _Made(of=product.settings, read=read, files=_file_digests(product.above, names)))
        return Brought(True, tuple(place for place, digest in read.items() if digest == NO_DIGEST))

    def _is_up_to_date(self, product: Product, known: _Made) -> bool:
        """What cannot be digested has no equal."""
        if known.begun or known.of != product.settings or known.files != _file_digests(product.above, known.files):
            return False
        return NO_DIGEST not in known.read.values() and all(
            digest_now(self._noted_place(name)) == digest for name, digest in known.read.items()
        )

    def _noted_name(self, place: str) -> str:
        """The name under which an input is noted."""
        return place if is_url(place) else named_from(Path(place), self._folder)

    def _noted_place(self, name: str) -> str:
        """The place of an input by the name under which it is noted."""
        return name if is_url(name) else os.path.normpath(self._folder / name)

    def _write_entry(self, product: Product, made: _Made | None) -> None:
        """Note what a product was made of, or that it is gone, and write the file."""
        self._made.pop(product.name, None)
        if made is not None:
            self._made[product.name] = made
        content = _RECORD.dump_json(dict(sorted(self._made.items())), indent=1, exclude_defaults=True)
        storage.write_bytes(self._file, content)


def _refuse_foreign(product: Product, known: _Made | None) -> None:
    """Refuse what somebody else made, changed or added. What is gone is made again."""
    there = _file_digests(product.above, _file_names(product))
    if known is None:
        if there:
            raise UsageError(
                "is there, and this project did not make it",
                place=str(product.place),
                remedy="Name another place in balise.toml, move it away, or replace it with --force.",
            )
        return
    for name, digest in there.items():
        if name in known.files and digest != known.files[name]:
            raise UsageError(
                "was changed since this project made it",
                place=str(product.above / name),
                remedy="To keep the change, delete the table that makes it from balise.toml and name the result "
                "(`site`, or `runs` under [replay]); to make it again, use --force.",
            )
    for name in there.keys() - known.files.keys():
        raise UsageError(
            "was added since this project made what is beside it",
            place=str(product.above / name),
            remedy="Name the log that it comes from in balise.toml, with its `stream`, and move the file away; "
            "--force removes it.",
        )


def _file_names(product: Product) -> list[str]:
    """The file of a product, or those in its folder, as they are noted."""
    place = product.place
    files = [place] if place.is_file() else [file for file in sorted(place.rglob("*")) if file.is_file()]
    return [file.relative_to(product.above).as_posix() for file in files]


def _file_digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The SHA-256 of files below a folder; empty where a file is gone."""
    places = {name: folder / name for name in sorted(names)}
    return {name: storage.file_digests(path)[0].sha256 if path.is_file() else "" for name, path in places.items()}


def digest_over(*settings: Settings | Sequence[str]) -> str:
    """SHA-256 over settings, names of inputs, and the build of the program."""
    plain = [one.model_dump(mode="json") if isinstance(one, Settings) else list(one) for one in settings]
    text = json.dumps([software_digest(), *plain], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
