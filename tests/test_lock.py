import os
import signal
import subprocess
import sys

import pytest

from porrima.errors import InputError
from porrima.lock import locked, token_of

HOLD = "import sys, time, pathlib, porrima.lock as l; c = l.locked(pathlib.Path(sys.argv[1])); print(c.__enter__(), flush=True); time.sleep(60)"  # noqa: E501


def test_the_holder_is_named_and_the_file_goes_with_the_lock(tmp_path):
    with locked(tmp_path) as token:
        assert token_of(tmp_path) == token
        with pytest.raises(
            InputError, match=rf"output: is being written by process {os.getpid()} on .*, got "
        ):
            locked(tmp_path).__enter__()
        assert token_of(tmp_path) == token
    assert token_of(tmp_path) is None
    assert not list(tmp_path.iterdir())


def test_the_lock_of_a_killed_process_is_none(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True)
    token = process.stdout.readline().strip()
    assert token_of(tmp_path) == token
    with pytest.raises(InputError, match=f"is being written by process {process.pid}"):
        locked(tmp_path).__enter__()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert token_of(tmp_path) == token
    with locked(tmp_path) as mine:
        assert token_of(tmp_path) == mine != token
    assert not list(tmp_path.iterdir())


def test_where_there_are_no_locks_the_user_is_told(tmp_path, monkeypatch):
    def none(handle, how):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("porrima.lock.fcntl.flock", none)
    with pytest.warns(UserWarning, match="cannot be locked"), locked(tmp_path) as token:
        assert token_of(tmp_path) == token


def test_a_folder_without_a_lock_has_no_token(tmp_path):
    assert token_of(tmp_path / "absent") is None
    (tmp_path / ".lock").write_text("one line")
    assert token_of(tmp_path) is None
