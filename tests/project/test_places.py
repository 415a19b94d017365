"""How a project names places, on POSIX and on Windows."""

from __future__ import annotations

from pathlib import PurePath, PurePosixPath, PureWindowsPath

import pytest

from pipeline.project.opened import named_from


@pytest.mark.parametrize(
    ("path", "folder", "named"),
    [
        (PurePosixPath("/trial/week12/raw/a.ubx"), PurePosixPath("/trial/week12"), "raw/a.ubx"),
        (PurePosixPath("/trial/raw/a.ubx"), PurePosixPath("/trial/week12"), "../raw/a.ubx"),
        (PurePosixPath("/data/a.ubx"), PurePosixPath("/home/me/week12"), "/data/a.ubx"),
        (PurePosixPath("/data/a.ubx"), PurePosixPath("/week12"), "/data/a.ubx"),
        (PureWindowsPath(r"C:\trial\week12\raw\a.ubx"), PureWindowsPath(r"C:\trial\week12"), "raw/a.ubx"),
        (PureWindowsPath(r"c:\trial\raw\a.ubx"), PureWindowsPath(r"C:\Trial\week12"), "../raw/a.ubx"),
        (PureWindowsPath(r"D:\raw\a.ubx"), PureWindowsPath(r"C:\trial\week12"), "D:/raw/a.ubx"),
        (PureWindowsPath(r"\\server\share\a.ubx"), PureWindowsPath(r"C:\trial"), "//server/share/a.ubx"),
    ],
)
def test_places_are_named_so_that_folders_can_move(path: PurePath, folder: PurePath, named: str) -> None:
    assert named_from(path, folder) == named
