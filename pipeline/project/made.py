"""What a project has made, of which content and settings: `.balise/made.json` beside its file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, TypeAdapter, ValidationError

from pipeline import storage
from pipeline.project.opened import RECORD
from pipeline.results.software import software_digest
from schemas.errors import UsageError

_NAME = "made.json"


class _Made(BaseModel):
    """SHA-256 of what a product was made of, and of each of its files. `begun`: nobody knows whether it is whole."""

    of: str
    files: dict[str, str]
    begun: bool = False


_RECORD = TypeAdapter(dict[str, _Made])


@dataclass(frozen=True)
class Product:
    """What a step makes: a file or a folder of files, and the SHA-256 over all that decides them."""

    name: str
    place: Path
    made_of: str

    @property
    def above(self) -> Path:
        """Files are noted as seen from here."""
        return self.place.parent


class Record:
    """Knows which products are as they were made; written after each, so that an interrupted call loses one at most."""

    def __init__(self, folder: Path, force: bool = False) -> None:
        self._file = folder / RECORD / _NAME
        self._force = force
        try:
            self._made = _RECORD.validate_json(storage.content_of(self._file) or b"{}")
        except ValidationError:
            self._made = {}

    def bring(self, product: Product, make: Callable[[], Sequence[Path]]) -> bool:
        """Make a product unless it is up to date; whether it was made.

        Raises `UsageError` where its files are there and this project did not make them, or they were changed since.
        """
        known = self._made.get(product.name)
        if not self._force:
            if (
                known is not None
                and not known.begun
                and known.of == product.made_of
                and _digests(product.above, known.files) == known.files
            ):
                return False
            self._refuse_foreign(product, known)
        before = _state(product.place)
        # Whoever is killed now leaves files that the next call must not take for somebody else's.
        self._note(product, _Made(of=product.made_of, files={} if known is None else known.files, begun=True))
        try:
            files = make()
        except Exception:
            if _state(product.place) == before:
                self._note(product, known)
            raise
        names = [file.relative_to(product.above).as_posix() for file in files]
        self._note(product, _Made(of=product.made_of, files=_digests(product.above, names)))
        return True

    def _note(self, product: Product, made: _Made | None) -> None:
        self._made.pop(product.name, None)
        if made is not None:
            self._made[product.name] = made
        content = _RECORD.dump_json(dict(sorted(self._made.items())), indent=1, exclude_defaults=True)
        storage.write_bytes(self._file, content)

    def _refuse_foreign(self, product: Product, known: _Made | None) -> None:
        if known is None and _is_there(product.place):
            raise UsageError(
                "is there, and this project did not make it",
                place=str(product.place),
                remedy="Name another place in balise.toml, move it away, or replace it with --force.",
            )
        if known is not None and not known.begun:
            there = {name: digest for name, digest in _digests(product.above, known.files).items() if digest}
            changed = [name for name, digest in there.items() if digest != known.files[name]]
            if changed:
                raise UsageError(
                    "was changed since this project made it",
                    place=str(product.above / changed[0]),
                    remedy="To keep the change, delete the table that makes it from balise.toml and name the result "
                    "(`site`, or `runs` under [replay]); to make it again, use --force.",
                )


def _is_there(place: Path) -> bool:
    return place.is_file() or (place.is_dir() and any(place.iterdir()))


def _state(place: Path) -> str:
    return storage.digest_of_files(_all_files(place))


def _digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The SHA-256 of files below a folder (`.`: itself a file); empty where a file is gone."""
    contents = {name: folder / name for name in sorted(names)}
    return {name: _digest(path) if path.is_file() else "" for name, path in contents.items()}


def _digest(path: Path) -> str:
    return storage.file_digests(path)[0].sha256


def digest_over(settings: object, files: Iterable[Path]) -> str:
    """SHA-256 over settings, the content of files and folders, and the build of the program."""
    parts = [json.dumps(settings, sort_keys=True, default=str), software_digest()]
    parts += [f"{path.name} {storage.digest_of_files(_all_files(path))}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _all_files(path: Path) -> list[storage.FileDigest]:
    if path.is_file():
        return list(storage.file_digests(path))
    inside = (file for file in sorted(path.rglob("*")) if file.is_file())
    return [storage.file_digests(file)[0]._replace(name=file.relative_to(path).as_posix()) for file in inside]
