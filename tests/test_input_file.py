"""Files from outside are read within bounds, and what is wrong with them is one sentence."""

import os

import pytest

from coloc_graph.errors import InputError, TracksError
from coloc_graph.input_file import parse_toml, quoted, read_bytes, read_json, read_text


def test_a_file_that_is_too_large_or_endless_is_refused_without_reading_it_all(tmp_path):
    path = tmp_path / "large"
    path.write_bytes(bytes(1001))
    assert len(read_bytes(path, "x", limit=1001)) == 1001
    with pytest.raises(TracksError, match=r"large: is larger than .* MiB; give another"):
        read_bytes(path, "give another", limit=1000, error=TracksError)
    if os.path.exists("/dev/zero"):  # noqa: PTH110
        with pytest.raises(InputError, match=r"is larger than 0\.5 MiB"):
            read_bytes(type(path)("/dev/zero"), "give another", limit=2**19)


def test_a_path_that_cannot_be_read_is_one_sentence(tmp_path):
    for path in (tmp_path, tmp_path / "none", tmp_path / "zero\0byte"):
        with pytest.raises(InputError, match=r"cannot be read .*; give another"):
            read_bytes(path, "give another")


def test_encodings_are_named(tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfone\ntwo")
    assert read_text(path, "x") == "one\ntwo"
    for data, says in ((b"\xff\xfea\0", "is text in UTF-16"), (b"one\ntwo \xe4", "line 2: is not UTF-8 text")):
        path.write_bytes(data)
        with pytest.raises(InputError, match=says):
            read_text(path, "x")


@pytest.mark.parametrize("text", ["[" * 100_000, "1" * 5000, "{", '{"a": ' * 5000])
def test_hostile_json_is_one_sentence(tmp_path, text):
    path = tmp_path / "summary.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"summary.json: is damaged \(.*\); solve it again") as refusal:
        read_json(path, "solve it again")
    assert len(str(refusal.value)) < 1000


def test_long_keys_are_refused_and_long_arrays_and_strings_are_not(tmp_path):
    assert parse_toml(tmp_path, "a.b.c = 1\nx = [" + "0.5, " * 1000 + ']\ny = "1.2.3.4"')["a"] == {"b": {"c": 1}}
    with pytest.raises(InputError, match="line 2: a key has more than 32 parts"):
        parse_toml(tmp_path, "a = 1\n" + ".".join("a" * 40) + " = 1")


def test_values_are_quoted_short():
    assert quoted("x" * 100) == f"`{'x' * 60}...`" and quoted("x") == "`x`" and quoted(3) == "3"
    assert quoted(10**400) == "a number of 1329 bits" and quoted([[1] * 9] * 2) == "a list of 2"
    assert quoted({"a": 1}) == "a table"
