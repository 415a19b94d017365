"""Messages whose layout is learnt from one of them: arrays, messages like no other, messages that do not fit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import polars as pl
import pytest
from google.protobuf.descriptor_pb2 import SourceCodeInfo
from mcap_ros2._dynamic import serialize_dynamic

from pipeline.read.ingest import layout_decoder
from pipeline.read.ingest.layout import Layout
from pipeline.read.ingest.layout_decoder import LayoutDecoder
from pipeline.read.ingest.mcap_block import Messages, Records
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.protobuf import layout_by
from pipeline.read.ingest.ros_message import layout_of_cdr, parse_definitions
from schemas.errors import InputError

CHANNEL = Channel(1, "/x", "protobuf", None, "x.mcap")


def rows_of(contents: list[bytes], walk: Callable[[bytes], Layout]) -> tuple[list[tuple[object, ...]], int]:
    """The rows in order of their messages, each behind the number of its message; messages without a kept layout."""
    lengths = np.array([len(content) for content in contents])
    starts = np.cumsum(lengths) - lengths
    records = Records([np.frombuffer(b"".join(contents), dtype=np.uint8)])
    messages = Messages(records, starts, lengths, np.arange(len(contents)))
    decoder = LayoutDecoder(CHANNEL, walk)
    decoder.add(messages)
    parts = [
        pl.DataFrame({"message": heads.log_time, **{path: pl.Series(columns[path]) for path in sorted(columns)}})
        for heads, columns in decoder.decoded()
        if len(heads.ordinal)
    ]
    assert (decoder.waiting, [*decoder.decoded()]) == (0, [])
    return pl.concat(parts).sort("message", maintain_order=True).rows(), decoder.slow_messages


def places(*paths: list[int], comment: str = "") -> bytes:
    info = SourceCodeInfo(location=[SourceCodeInfo.Location(path=path) for path in paths])
    info.location[0].leading_comments = comment
    return info.SerializeToString()


PLACES = {
    "location[0].path[1]": pl.Int64(),
    "location[1].path[0]": pl.Float64(),
    "location[0].leading_comments": pl.String(),
}
WALK = layout_by(SourceCodeInfo.DESCRIPTOR, PLACES)


def test_elements_of_protobuf_arrays() -> None:
    """Numbers packed side by side, of any width, and messages; null beyond their end."""
    contents = [places([1, 300], [-2]), places([1]), places([70_000, 5, 6], [1 << 30, 2], comment="é")]
    assert rows_of(contents, WALK)[0] == [(0, "", 300, -2.0), (1, "", None, None), (2, "é", 5, float(1 << 30))]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (places([1, 2])[:-1], "runs past its message"),
        (places([1, 2], [3], comment="e").replace(b"e", b"\xff"), "a text is not UTF-8"),
        (b"\x0a\x06\x1a\x01e\x1a\x01e", "the field leading_comments occurs twice"),
        (b"\x0a\x02\x1d\x01", "runs past its message"),
        (b"\x0a\x05\x1d\x01\x01\x01\x01", "written as another type"),
        (b"\x0b\x0c", "a group"),
    ],
)
def test_a_protobuf_message_that_does_not_fit_is_named(content: bytes, reason: str) -> None:
    with pytest.raises(InputError, match=rf"/x: the message recorded at log time 1 ns cannot be decoded: .*{reason}"):
        rows_of([places([1, 2], [3], comment="e"), content], WALK)


def test_texts_of_one_length_that_change() -> None:
    """Always the same, another from some message on, and another in each message, beside messages of other layouts."""
    for comments in (["a"] * 6, ["a"] * 3 + ["b"] * 3, [*"abcdef"], ["a", "bc"] * 3, ["a", "", "é", "bc", "a", "d"]):
        contents = [places([1, number * 100], [number], comment=comment) for number, comment in enumerate(comments)]
        rows, slow = rows_of(contents, WALK)
        assert rows == [(number, comment, number * 100, float(number)) for number, comment in enumerate(comments)]
        assert slow == 0


def test_a_text_that_differs_in_a_later_block_alone() -> None:
    decoder = LayoutDecoder(CHANNEL, WALK)
    decoded = []
    for comment in "aabba":
        content = places([1, 2], [3], comment=comment)
        records = Records([np.frombuffer(content, dtype=np.uint8)])
        decoder.add(Messages(records, np.array([0]), np.array([len(content)]), np.array([7])))
        if comment == "a":
            ((_, columns),) = decoder.decoded()
            decoded.append([*columns["location[0].leading_comments"]])
    assert decoded == [["a"], ["a"], ["b", "b", "a"]]


def test_messages_like_no_other_are_walked_for_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    contents = [places([1, number], [number], comment="c" * (number % 7)) for number in range(0, 40_000, 800)]
    whole, slow = rows_of(contents, WALK)
    assert [row[2] for row in whole] == [*range(0, 40_000, 800)]
    assert slow == 0
    monkeypatch.setattr(layout_decoder, "_MOST_LAYOUTS", 3)
    again, slow = rows_of(contents, WALK)
    assert again == whole
    assert 3 < slow < len(contents)


TEXT = "uint32 epoch\nSat[] sats\nstring end\n===\nMSG: a/Sat\nuint8 id\nfloat64 snr\nbool used\n"
CDR = partial(layout_of_cdr, (parse_definitions("a/msg/Sky", TEXT), "a/Sky"))


def sky(epoch: int, count: int, end: str = "") -> bytes:
    sats = [{"id": number, "snr": number / 2, "used": number == 1} for number in range(count)]
    return bytes(serialize_dynamic("a/msg/Sky", TEXT)["a/msg/Sky"]({"epoch": epoch, "sats": sats, "end": end}))


def test_each_element_of_a_cdr_array_makes_a_row() -> None:
    types = {"id": pl.Int64(), "snr": pl.Float64(), "used": pl.Boolean(), "epoch": pl.Int64()}
    contents = [sky(7, 2), sky(8, 0), sky(9, 2), sky(10, 1)]
    assert rows_of(contents, partial(CDR, types, "sats"))[0] == [
        (0, 7, 0, 0.0, False),
        (0, 7, 1, 0.5, True),
        (2, 9, 0, 0.0, False),
        (2, 9, 1, 0.5, True),
        (3, 10, 0, 0.0, False),
    ]


def test_elements_and_texts_of_cdr() -> None:
    """Null beyond the end of a sequence; an empty text with its closing zero and without."""
    types = {"sats[1].snr": pl.Float64(), "end": pl.String()}
    bare = sky(1, 0, "")[:-5] + bytes(4)
    contents = [sky(1, 2, "x"), sky(1, 1, ""), bare]
    assert rows_of(contents, partial(CDR, types, ""))[0] == [(0, "x", 0.5), (1, "", None), (2, "", None)]
    with pytest.raises(InputError, match="log time 0 ns cannot be decoded: a text has no closing zero"):
        rows_of([sky(1, 0, "ab")[:-1] + b"c"], partial(CDR, types, ""))
