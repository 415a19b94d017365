"""An object store in memory whose answers go wrong: at the n-th request, or for one object until it is well again."""

from __future__ import annotations

import errno
import hashlib
from pathlib import Path
from typing import Any, ClassVar

import fsspec
from fsspec.implementations.memory import MemoryFileSystem

AILMENTS = ("error", "gone", "short", "altered")


class Flaky(MemoryFileSystem):  # type: ignore[misc]
    """`fail_at`: the number of the request that goes wrong, `lasting`: and all after it; `sick`: all for this name."""

    protocol = "flaky"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    count = 0
    fail_at = -1
    lasting = False
    ailment = "error"
    sick = ""

    @classmethod
    def well(cls) -> None:
        cls.count, cls.fail_at, cls.lasting, cls.ailment, cls.sick = 0, -1, False, "error", ""

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("flaky://")))

    @classmethod
    def _is_wrong(cls, place: str) -> bool:
        if cls.sick:
            return place.endswith(cls.sick)
        cls.count += 1
        return cls.count == cls.fail_at or (cls.lasting and 0 < cls.fail_at < cls.count)

    def _answer(self, place: str) -> bool:
        """Whether the content of this answer goes wrong; an error is raised."""
        if not self._is_wrong(place):
            return False
        if self.ailment == "error":
            raise OSError(errno.EBUSY, "Please reduce your request rate")
        if self.ailment == "gone":
            raise FileNotFoundError(place)
        return True

    def info(self, path: str, **options: Any) -> dict[str, Any]:
        self._answer(path)
        return self._tagged(super().info(path, **options))

    def ls(self, path: str, detail: bool = True, **options: Any) -> list[Any]:
        self._answer(path)
        found = super().ls(path, detail=detail, **options)
        return [self._tagged(info) for info in found] if detail else found

    def get_file(self, rpath: str, lpath: str, **_: Any) -> None:
        Path(lpath).write_bytes(self.cat_file(rpath))

    def cat_file(self, path: str, start: Any = None, end: Any = None, **options: Any) -> bytes:
        spoilt = self._answer(path)
        content = bytes(super().cat_file(path, start, end, **options))
        if not spoilt:
            return content
        return content[:-100] if self.ailment == "short" else content[:-1] + bytes([content[-1] ^ 1])

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **options: Any) -> None:
        self._answer(path)
        super().pipe_file(path, value, mode=mode, **options)

    def rm_file(self, path: str) -> None:
        self._answer(path)
        super()._rm(path)

    def call_s3(self, *_: Any, **__: Any) -> dict[str, Any]:
        """As S3 tells of an object that is not encrypted."""
        return {}

    def split_path(self, path: str) -> tuple[str, str, None]:
        return "bucket", path, None

    def _tagged(self, info: dict[str, Any]) -> dict[str, Any]:
        if info["type"] == "directory":
            return info
        digest = hashlib.md5(self.store[info["name"]].getvalue(), usedforsecurity=False).hexdigest()
        return {**info, "ETag": f'"{digest}"', "LastModified": "noon"}


fsspec.register_implementation("flaky", Flaky, clobber=True)
