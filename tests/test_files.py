"""The one way in and out for files of strangers: what is not a plain file of a bounded size inside its folder is refused at once."""

import os

import pytest

from uuvtai.errors import UserError
from uuvtai.files import refuse_output

# ------------------------------------------------------------------------------------------------------------------ output


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
@pytest.mark.parametrize("kind", ["link", "broken link", "folder", "pipe", "device"])
def test_only_plain_files_are_replaced(tmp_path, kind, force):
    out = tmp_path / "out"
    (tmp_path / "victim").write_text("mine")
    make = {
        "link": lambda: out.symlink_to(tmp_path / "victim"),
        "broken link": lambda: out.symlink_to(tmp_path / "nothing"),
        "folder": out.mkdir,
        "pipe": lambda: os.mkfifo(out),
        "device": lambda: None,
    }
    make[kind]()
    with pytest.raises(UserError, match="is a "):
        refuse_output(out if kind != "device" else type(out)("/dev/null"), [], force)
    assert (tmp_path / "victim").read_text() == "mine"
