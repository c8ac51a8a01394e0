"""Where compiled code is kept, and when the second thread helps."""

import pytest

from tightrope.control.engine import compiled
from tightrope.control.engine.threads import Pace


def test_cache_lies_in_the_users_cache_directory_and_is_private(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    folder = compiled.cache_folder()
    assert folder is not None and folder.parent == tmp_path / "tightrope" / "numba"
    assert folder.stat().st_mode & 0o777 == 0o700 and folder.parent.stat().st_mode & 0o777 == 0o700
    assert compiled.compilation_due()
    compiled.mark_complete()
    assert not compiled.compilation_due()


@pytest.mark.parametrize("word", ["off", "OFF", "0"])
def test_cache_can_be_switched_off(word, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(compiled.SWITCH, word)
    assert compiled.cache_folder() is None and compiled.compilation_due()
    assert not list(tmp_path.iterdir())


def test_numbas_own_setting_is_left_alone():
    import numba

    assert "tightrope" not in str(numba.config.CACHE_DIR)


def test_pace_takes_the_quicker_way_and_tries_the_other_again():
    pace, seconds = Pace(both=True), {True: 3.0, False: 1.0}
    choices = []
    for _ in range(2 * Pace.RETRY):
        choices.append(pace.choose())
        pace.book(choices[-1], seconds[choices[-1]], 1)
    assert choices[:2] == [True, False]
    assert sum(choices) == 2  # once to begin with, once to try again
    seconds[True] = 0.5
    for _ in range(2 * Pace.RETRY):
        last = pace.choose()
        pace.book(last, seconds[last], 1)
    assert last is True


def test_pace_without_a_second_thread():
    pace = Pace(both=False)
    assert not pace.choose()
    pace.book(False, 1.0, 1)
    assert not pace.choose()
