"""Keys on disk: what is written, who may read it, and what is refused."""

import os
import stat
from pathlib import Path

import pytest
import zmq

from twin.plant.errors import InputError
from twin.rig.keys import load_pair, load_public, make_keys


def test_both_halves_belong_together_and_only_the_owner_reads_the_secret(tmp_path: Path) -> None:
    public = make_keys(tmp_path / "deep" / "keys", "rig-1")
    secret = public.with_suffix(".key_secret")
    pair = load_pair(secret)
    assert load_public(public) == pair.public == zmq.curve_public(pair.secret)
    assert load_public(secret) == pair.public
    assert pair.secret.decode() not in public.read_text()
    if os.name == "posix":
        assert stat.S_IMODE(secret.stat().st_mode) == 0o600
        assert stat.S_IMODE(public.stat().st_mode) == 0o644


def test_key_that_is_there_is_never_overwritten(tmp_path: Path) -> None:
    public = make_keys(tmp_path, "rig")
    before = public.read_bytes()
    with pytest.raises(InputError, match="there already; choose another name"):
        make_keys(tmp_path, "rig")
    assert public.read_bytes() == before


@pytest.mark.parametrize("name", ["", "../rig", "a b", "a/b", "rig.key"])
def test_name_that_could_leave_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="use letters"):
        make_keys(tmp_path / "keys", name)


@pytest.mark.skipif(os.name != "posix", reason="permissions are another matter there")
def test_secret_that_others_can_read_is_refused_with_the_remedy(tmp_path: Path) -> None:
    secret = make_keys(tmp_path, "rig").with_suffix(".key_secret")
    secret.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        load_pair(secret)


def test_what_is_no_key_is_refused(tmp_path: Path) -> None:
    public = make_keys(tmp_path, "rig")
    with pytest.raises(InputError, match="no secret key"):
        load_pair(public)
    with pytest.raises(InputError, match="no such key file"):
        load_public(tmp_path / "none.key")
    garbage = tmp_path / "garbage.key"
    garbage.write_text("hello\n")
    with pytest.raises(InputError, match="is no key file"):
        load_public(garbage)
    garbage.write_text('curve\n    public-key = "short"\n')
    with pytest.raises(InputError, match="40 characters"):
        load_public(garbage)
