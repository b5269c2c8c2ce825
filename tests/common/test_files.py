"""The one reader for files of strangers: what is no plain file of bounded size in its folder is refused."""

import json
import os
import socket
from pathlib import Path

import pytest

from uuvtai.common import files
from uuvtai.common.errors import UserError
from uuvtai.common.files import (
    FileError,
    open_file,
    open_new,
    open_to_append,
    parsed_json,
    read_bytes,
    read_json,
    read_lines,
    read_text,
    refuse_links_in,
    refuse_output,
    truncate,
)

# ------------------------------------------------------------------------------------------------------ input


def test_a_plain_file_is_read_with_and_without_its_folder(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    file = tmp_path / "a" / "b" / "c"
    file.write_bytes(b"content")
    assert read_bytes(file) == read_bytes(file, folder=tmp_path) == read_bytes(file, limit=7) == b"content"
    assert read_text(file) == "content"


@pytest.mark.parametrize("kind", ["a pipe", "a device", "a folder", "a socket"])
@pytest.mark.parametrize("through", ["itself", "a link"])
def test_only_plain_files_are_read_and_none_is_waited_for(tmp_path, kind, through):
    place = Path("/dev/zero") if kind == "a device" else tmp_path / "x"
    if kind != "a device":
        {"a pipe": os.mkfifo, "a folder": Path.mkdir, "a socket": bound}[kind](place)
    if through == "a link":
        (tmp_path / "link").symlink_to(place)
        place = tmp_path / "link"
    with pytest.raises(FileError, match=f"is {kind}" if kind != "a socket" else "is no plain file"):
        read_bytes(place)


def bound(place):
    one = socket.socket(socket.AF_UNIX)
    one.bind(str(place))
    one.close()


def test_a_file_may_be_as_long_as_its_limit_and_no_longer(tmp_path):
    (tmp_path / "x").write_bytes(b"12345")
    assert read_bytes(tmp_path / "x", 5) == b"12345"
    with pytest.raises(FileError, match="has 5 bytes, more than the 4"):
        read_bytes(tmp_path / "x", 4)
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 1 << 40)
    with pytest.raises(FileError, match="more than the"):
        read_bytes(tmp_path / "sparse")


def test_a_file_that_grows_while_it_is_read_stays_bounded(tmp_path, monkeypatch):
    (tmp_path / "x").write_bytes(b"12345")

    class Grows:
        def __init__(self, real):
            self.real = real

        def __enter__(self):
            with (tmp_path / "x").open("ab") as more:
                more.write(b"6" * 1000)
            return self.real.__enter__()

        def __exit__(self, *error):
            return self.real.__exit__(*error)

    monkeypatch.setattr(files, "open_file", lambda *given: Grows(open_file(*given)))
    with pytest.raises(FileError, match="more than the 8 bytes"):
        read_bytes(tmp_path / "x", 8)
    (tmp_path / "x").write_bytes(b"12345")
    with pytest.raises(FileError, match="more than 8 in all"):
        list(read_lines(tmp_path / "x", 8))


@pytest.mark.parametrize("link", ["file", "folder", "inner folder"])
def test_no_name_on_the_way_may_be_a_link(tmp_path, link):
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "b" / "c").write_text("secret")
    run = tmp_path / "run"
    (run / "a").mkdir(parents=True)
    places = {
        "file": (run / "c", tmp_path / "out/b/c"),
        "folder": (run / "d", tmp_path / "out/b"),
        "inner folder": (run / "a/b", tmp_path / "out/b"),
    }
    name, target = places[link]
    name.symlink_to(target)
    file = name if link == "file" else name / "c"
    assert read_text(file) == "secret", "without a folder a link is the user's own"
    with pytest.raises(FileError, match="is a link"):
        read_text(file, folder=run)
    with pytest.raises(FileError, match="is a link"):
        refuse_links_in(run)
    for change in (lambda: open_to_append(file, run), lambda: truncate(file, 0, run)):
        with pytest.raises(FileError, match="is a link"):
            change()
    assert read_text(tmp_path / "out" / "b" / "c") == "secret"


@pytest.mark.parametrize("name", ["../secret", "a/../../secret", "/etc/passwd", "."])
def test_a_file_lies_in_its_folder(tmp_path, name):
    (tmp_path / "run" / "a").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    with pytest.raises(FileError, match="does not lie in"):
        read_text(tmp_path / "run" / name, folder=tmp_path / "run")


def test_what_is_not_there_is_an_error_of_the_system(tmp_path):
    for folder in (None, tmp_path):
        with pytest.raises(FileNotFoundError):
            read_bytes(tmp_path / "no" / "file", folder=folder)


def test_text_is_utf_8(tmp_path):
    (tmp_path / "x").write_bytes(b"caf\xe9")
    with pytest.raises(FileError, match=r"is not UTF-8 text \(byte 3\)"):
        read_text(tmp_path / "x")


def test_lines_come_one_by_one_and_none_is_endless(tmp_path):
    (tmp_path / "x").write_bytes(b"one\ntwo\n" + b"3" * 100)
    found = read_lines(tmp_path / "x", longest=50)
    assert [next(found), next(found)] == [b"one\n", b"two\n"]
    with pytest.raises(FileError, match="has a line of more than 50 bytes"):
        next(found)


# ------------------------------------------------------------------------------------------------------- JSON


@pytest.mark.parametrize("value", [None, 3, -0.5, 2**128, "caf\u00e9 \U0001f600", [1, [2]], {"a": {"b": []}}])
def test_json_comes_back_as_it_was(tmp_path, value):
    (tmp_path / "x.json").write_text(json.dumps(value))
    assert read_json(tmp_path / "x.json") == value


@pytest.mark.parametrize("text", [
    "", "{", "[1,]", "NaN", "[Infinity]", "1e999", "-1e999", "9" * 40, "9" * 5000,
    "[" * 10_000 + "]" * 10_000, '{"a":' * 100_000,
    '"\\ud800"', "[" + "[]," * 1_000_001 + "0]", "[" + "0," * 8_000_001 + "0]",
], ids=range(14))  # fmt: skip
def test_json_that_cannot_be_used_is_refused_in_one_line(text):
    with pytest.raises(FileError, match=r"^x\.json: ") as answer:
        parsed_json(text, "x.json")
    assert "\n" not in str(answer.value) and len(str(answer.value)) < 300


# --------------------------------------------------------------------------------------------------- in place


def test_a_file_is_written_at_its_end_and_cut(tmp_path):
    for text in (b"one", b"two"):
        with open_to_append(tmp_path / "x", tmp_path) as file:
            file.write(text)
    truncate(tmp_path / "x", 4, tmp_path)
    assert (tmp_path / "x").read_bytes() == b"onet"


def test_a_new_file_replaces_nothing(tmp_path):
    with open_new(tmp_path / "x") as file:
        file.write(b"mine")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    for name in ("x", "link"):
        with pytest.raises(FileExistsError):
            open_new(tmp_path / name)
    assert (tmp_path / "x").read_bytes() == b"mine" and not (tmp_path / "nothing").exists()


@pytest.mark.parametrize("kind", ["pipe", "folder", "second name"])
def test_what_is_changed_in_place_is_a_plain_file_of_its_own(tmp_path, kind):
    place = tmp_path / "x"
    (tmp_path / "victim").write_text("mine")
    make = {"pipe": os.mkfifo, "folder": Path.mkdir}
    make.get(kind, lambda _place: place.hardlink_to(tmp_path / "victim"))(place)
    for change in (lambda: open_to_append(place, tmp_path), lambda: truncate(place, 0, tmp_path)):
        with pytest.raises(FileError, match=r"is a pipe|second name|is no plain file"):
            change()
    assert (tmp_path / "victim").read_text() == "mine"


# ----------------------------------------------------------------------------------------------------- output


def test_a_new_file_may_be_written(tmp_path):
    refuse_output(tmp_path / "new.png", [tmp_path / "log.mcap"], force=False)
    refuse_output(tmp_path / "no" / "folder" / "yet.png", [], force=False)


def test_a_file_is_replaced_with_force_only(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(UserError, match="--force"):
        refuse_output(tmp_path / "mine", [], force=False)
    refuse_output(tmp_path / "mine", [tmp_path / "other"], force=True)


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["log", "sub/../log", "hard", "soft"])
def test_an_input_is_no_output_by_whatever_name(tmp_path, name, force):
    (tmp_path / "sub").mkdir()
    log = tmp_path / "log"
    log.write_text("log")
    (tmp_path / "hard").hardlink_to(log)
    (tmp_path / "soft").symlink_to(log)
    with pytest.raises(UserError, match="is what is read here"):
        refuse_output(tmp_path / name, [tmp_path / "another", log], force)
    with pytest.raises(UserError, match="is what is read here"):
        refuse_output(log, [tmp_path / name], force)


@pytest.mark.parametrize("force", [False, True])
def test_only_plain_files_are_replaced(tmp_path, force):
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "victim")
    (tmp_path / "broken link").symlink_to(tmp_path / "nothing")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for out in ("link", "broken link", "folder", "pipe", "/dev/null"):
        with pytest.raises(UserError, match="is a "):
            refuse_output(tmp_path / out, [], force)
    assert (tmp_path / "victim").read_text() == "mine"
