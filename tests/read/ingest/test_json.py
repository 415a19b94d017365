"""JSON of many messages at once against JSON message by message."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.read.ingest import json_columns
from pipeline.read.ingest.json_columns import JsonDecoder, one_by_one, parse_json
from pipeline.read.ingest.layout import Columns, UndecodableError
from pipeline.read.ingest.mcap_block import Messages, Records
from pipeline.read.ingest.mcap_records import Channel
from schemas.errors import InputError

CHANNEL = Channel(1, "/x", "json", None, "x.mcap")
TYPES = {
    "a": pl.Float64(), "t.sec": pl.Int64(), "name": pl.String(), "ok": pl.Boolean(), "c[1]": pl.Float64(),
}  # fmt: skip

texts = st.text(max_size=8)
numbers = st.one_of(st.integers(-(2**70), 2**70), st.floats(allow_nan=False, allow_infinity=False), st.integers(-9, 9))
scalars = st.one_of(numbers, st.none(), st.booleans(), texts)
documents = st.fixed_dictionaries(
    {},
    optional={
        "a": st.one_of(numbers, st.none(), scalars),
        "t": st.one_of(st.fixed_dictionaries({"sec": st.integers(0, 2**40)}), scalars),
        "name": st.one_of(texts, st.none()),
        "ok": st.one_of(st.booleans(), st.none()),
        "c": st.lists(numbers, max_size=3),
        "other": scalars,
        "more": st.dictionaries(texts, scalars, max_size=2),
    },
)
styles = st.sampled_from([{}, {"separators": (",", ":")}, {"indent": 1}, {"ensure_ascii": False}])
damage = st.one_of(
    st.none(),
    st.none(),
    st.tuples(st.integers(0, 200), st.sampled_from([*'{}[]:,"0-.eE+ \\\n', "NaN", "null", "", "\t"])),
)
payloads = st.lists(st.tuples(documents, styles, damage), min_size=1, max_size=12)


def messages_of(contents: list[bytes]) -> Messages:
    """In a log, the head of its record stands before each payload."""
    lengths = np.array([len(content) for content in contents], dtype=np.int64)
    starts = np.cumsum(lengths + 1) - lengths
    data = np.frombuffer(b"".join(b"#" + content for content in contents) + b" ", dtype=np.uint8)
    return Messages(Records([data]), starts, lengths, starts)


def written(document: dict, style: dict, harm: tuple[int, str] | None) -> bytes:
    content = json.dumps(document, **style)
    if harm is not None:
        at = harm[0] % (len(content) + 1)
        content = content[:at] + harm[1] + content[at + 1 :]
    return content.encode("utf-8", "surrogatepass")


def at_once(contents: list[bytes], decoder: JsonDecoder | None = None) -> tuple[Columns, int]:
    """The columns, and how many messages were parsed one by one."""
    decoder = decoder or JsonDecoder(CHANNEL, TYPES)
    decoder.add(messages_of(contents))
    ((heads, columns),) = decoder.decoded()
    assert len(heads.ordinal) == len(contents)
    return columns, decoder.slow_messages


@settings(max_examples=70, deadline=None, derandomize=True)
@given(payloads)
def test_what_is_taken_at_once_is_what_the_parser_says(drawn):
    for content in (written(*one) for one in drawn):
        try:
            expected = one_by_one(CHANNEL, [content], [1], TYPES)
        except InputError:
            with pytest.raises(InputError):
                at_once([content])
            continue
        columns, _ = at_once([content])
        assert {path: values.to_list() for path, values in columns.items()} == {
            path: values.to_list() for path, values in expected.items()
        }


alike = st.fixed_dictionaries(
    {
        "a": st.one_of(st.floats(allow_nan=False, allow_infinity=False), numbers, st.just(0)),
        "t": st.fixed_dictionaries({"sec": st.one_of(st.integers(0, 2**40), numbers)}),
        "name": st.one_of(st.just("x"), texts),
        "ok": st.booleans(),
    }
)
ALIKE = b'{"a":0.5,"t":{"sec":7},"name":"x","ok":true}'


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.tuples(alike, styles, damage), min_size=1, max_size=4))
def test_messages_that_hold_the_same_fields_are_what_the_parser_says(drawn):
    contents = [ALIKE, *(written(*one) for one in drawn)]
    try:
        expected = one_by_one(CHANNEL, contents, range(len(contents)), TYPES)
    except InputError:
        with pytest.raises(InputError):
            at_once(contents)
        return
    columns, _ = at_once(contents)
    assert {path: values.dtype for path, values in columns.items()} == TYPES
    assert {path: values.to_list() for path, values in columns.items()} == {
        path: values.to_list() for path, values in expected.items()
    }


def test_messages_that_hold_the_same_fields_need_no_second_parser(monkeypatch):
    monkeypatch.delattr(json_columns, "_read_with_arrow")
    decoder = JsonDecoder(CHANNEL, TYPES)
    for name in ("x", "é"):
        contents = [ALIKE, b' {"ok": false, "t": {"sec": -3}, "a": 1e3, "name": "%s"}\n' % name.encode()]
        columns, slow = at_once(contents, decoder)
        assert slow == 0
        assert {path: values.to_list() for path, values in columns.items()} == {
            "a": [0.5, 1000.0], "t.sec": [7, -3], "name": ["x", name], "ok": [True, False], "c[1]": [None, None],
        }  # fmt: skip


@pytest.mark.parametrize(
    "content",
    [
        ALIKE.replace(b'"ok"', b'"a":0.5,"ok"'),
        ALIKE.replace(b'"a"', b'"\\u0061":1,"a"'),
        ALIKE.replace(b'"sec"', b'"sec":1,"sec"'),
        ALIKE.replace(b'"ok"', b'"t":{"sec":7},"ok"'),
        ALIKE.replace(b'"name"', b'"name":"","name"'),
        ALIKE + b"," + ALIKE,
        ALIKE + ALIKE,
        ALIKE + b"\n" + ALIKE,
        ALIKE.replace(b"7", b"7.5"),
        ALIKE.replace(b"7", b"9223372036854775808"),
        ALIKE.replace(b'"x"', b'"\xff"'),
        ALIKE.replace(b'"x"', b'"\t"'),
    ],
)
def test_a_bad_message_among_those_that_hold_the_same_fields_is_refused(content):
    with pytest.raises(InputError, match="log time 1 ns"):
        one_by_one(CHANNEL, [ALIKE, content], [0, 1], TYPES)
    decoder = JsonDecoder(CHANNEL, TYPES)
    at_once([ALIKE] * 2, decoder)
    with pytest.raises(InputError, match=f"log time {len(ALIKE) + 2} ns"):
        at_once([ALIKE, content], decoder)


def test_zero_keeps_its_sign():
    contents = [ALIKE, ALIKE.replace(b"0.5", b"-0"), ALIKE.replace(b"0.5", b"-0.0")]
    assert [str(value) for value in at_once(contents)[0]["a"].to_list()] == ["0.5", "-0.0", "-0.0"]


def test_good_messages_are_taken_at_once():
    contents = [
        json.dumps({"a": number / 7, "name": "Info NaN null", "t": {"sec": number}}).encode() for number in range(50)
    ]
    columns, slow = at_once(contents)
    assert slow == 0
    assert columns["a"].to_list() == [number / 7 for number in range(50)]
    assert columns["t.sec"].to_list() == list(range(50))


def test_fields_that_only_later_messages_have_are_read():
    blocks = [
        [b'{"a": 1.5, "name": "x"}', b'{"a": 2.5}'],  # these say which fields a message has
        [b'{"a": 3.5}', b'{"name": null}'],
        [b'{"a": 4.5}', b'{"a": 5.5, "ok": true}'],
        [b'{"a": 6.5, "other": 1, "t": {"sec": 7}, "c": [0, 8.5]}'],
    ]
    decoder = JsonDecoder(CHANNEL, TYPES)
    columns = [at_once(block, decoder)[0] for block in blocks]
    assert decoder.slow_messages == 0
    read = {path: [value for block in columns for value in block[path].to_list()] for path in TYPES}
    assert read == {
        "a": [1.5, 2.5, 3.5, None, 4.5, 5.5, 6.5],
        "t.sec": [None] * 6 + [7],
        "name": ["x"] + [None] * 6,
        "ok": [None] * 5 + [True, None],
        "c[1]": [None] * 6 + [8.5],
    }
    with pytest.raises(InputError, match="a name occurs twice"):
        at_once([b'{"a": 1, "a": 2}'], decoder)
    assert {path: values.dtype for path, values in columns[1].items()} == TYPES


@pytest.mark.parametrize(
    "content",
    [
        *(b'{"a": NaN}', b'{"a": -Infinity}', b'{"a": 1, "a": 2}', b'{"a": 01}', b'{"a": 1}{}', b"[1", b"\xff"),
        *(b"{", b'{"a"', b'{"a":', b'{"a": 0', b'{"a": 0,', b'{"a": 0, ', b'{"b": [', b'{"b": [1,', b'{"b": {', b"["),
    ],
)
def test_what_is_no_json_is_refused(content):
    with pytest.raises(UndecodableError):
        parse_json(content)
    with pytest.raises(InputError):
        at_once([b'{"a": 1.5}', content, b'{"a": 2.5}'])


def test_two_halves_of_a_document_are_not_one():
    halves = [b'{"a": 1.5}{"a": 2.5}', b'{"a": 3.5, "c": {}', b"}", b"{}"]
    for several in (halves[1:3], halves[:3], [*halves, b'{"a": 1}null{}']):
        with pytest.raises(InputError):
            at_once(several)
