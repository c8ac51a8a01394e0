"""Storing and loading compiled code, and the use of the second thread."""

import hashlib
import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import tightrope
from tightrope.control.engine.compiled import cache
from tightrope.control.engine.compiled.threads import ThreadChoice

COMPILER = ("numba.np.linalg", "numba.np.arrayobj", "numba.np.random.generator_core", "numba.cpython.unicode")
SOURCES = (str(Path(tightrope.__file__).parents[1]), str(Path(__file__).parent))
START = """
import hashlib
import sys
import numpy as np
import torch

def memory():
    status = open("/proc/self/status").read() if sys.platform == "linux" else "VmHWM: 0 kB"
    return int(status.split("VmHWM:")[1].split()[0]) / 1024

before = memory()
from tightrope.control.engine.compiled_engine import CompiledEngine
from tightrope.control.engine.compiled import infer
needed = memory() - before
import engine_cases
x = np.arange(12, dtype=np.float64).reshape(3, 4)
no, yes, out = np.zeros(x.shape, bool), np.ones(x.shape, bool), np.empty_like(x)
infer.gae_batch(x, x + 1, x + 2, no, no, yes, 0.99, 0.95, out)
policy, optimiser, settings = engine_cases.make()
batch, rng = engine_cases.make_batch(policy), np.random.default_rng(0)
metrics = CompiledEngine(policy, optimiser, 1).update(batch, settings, rng)
weights = [p.detach().numpy().tobytes() for p in policy.parameters()]
result = hashlib.sha256(b"".join([out.tobytes(), repr(metrics).encode(), *weights]))
print(result.hexdigest(), needed, *sorted(sys.modules))
"""


def start(caches):
    """What a process that makes the engine from this cache computes, the memory it needed, and its
    modules."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(caches), "PYTHONPATH": os.pathsep.join(SOURCES)}
    run = subprocess.run(
        [sys.executable, "-c", START], env=environment, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    bits, memory, *modules = run.stdout.split()
    return bits, float(memory), modules


@pytest.fixture
def warm(tmp_path):
    """A cache directory with a copy of all compiled code."""
    from tightrope.control.engine import compiled_engine  # noqa: F401  (compiles missing functions)

    folder = cache.cache_folder()
    if folder is None or cache.compilation_due():
        pytest.skip("the cache is switched off")
    shutil.copytree(folder, tmp_path / "tightrope" / "numba" / folder.name)
    return tmp_path / "tightrope" / "numba" / folder.name


def test_cache_lies_in_the_users_cache_directory_and_is_private(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(cache.SWITCH, raising=False)
    folder = cache.cache_folder()
    assert folder is not None and folder.parent == tmp_path / "tightrope" / "numba"
    assert folder.stat().st_mode & 0o777 == 0o700 and folder.parent.stat().st_mode & 0o777 == 0o700
    assert cache.compilation_due()
    cache.mark_complete()
    assert not cache.compilation_due()


@pytest.mark.parametrize("word", ["off", "OFF", "0"])
def test_cache_can_be_switched_off(word, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(cache.SWITCH, word)
    assert cache.cache_folder() is None and cache.compilation_due()
    assert not list(tmp_path.iterdir())


def test_numbas_own_setting_is_not_changed():
    import numba

    assert "tightrope" not in str(numba.config.CACHE_DIR)


def test_a_warm_start_needs_no_compiler(warm):
    _, _, modules = start(warm.parents[2])
    assert "tightrope.control.engine.compiled.update" in modules
    assert not [name for name in (*COMPILER, "scipy.linalg") if name in modules]


def test_damaged_and_foreign_entries_are_compiled_again_to_the_same_bits(warm):
    expected, memory, _ = start(warm.parents[2])
    entry, other = (
        warm / f"tightrope.control.engine.compiled.{name}"
        for name in ("infer.gae_batch", "update.run_epochs")
    )
    sound, data = entry.read_bytes(), bytearray(entry.read_bytes())
    data[len(data) // 2] ^= 1
    entry.write_bytes(data)
    foreign = pickle.dumps(("another", "program"))
    other.write_bytes(hashlib.sha256(foreign).digest() + foreign)
    bits, with_compiler, modules = start(warm.parents[2])
    assert bits == expected and set(COMPILER) <= set(modules)
    assert (
        sys.platform != "linux" or memory < with_compiler - 20
    )  # MB; what numba needs to compile is about 40
    assert len(entry.read_bytes()) > len(sound) // 2 and entry.read_bytes() != data
    assert entry.stat().st_mode & 0o777 == 0o600
    bits, _, modules = start(warm.parents[2])  # they have been replaced
    assert bits == expected and not set(COMPILER) & set(modules)
    assert not list(warm.glob("tmp*"))


@pytest.mark.parametrize("content", [b"", b"x", b"x" * 100])
def test_what_is_no_entry_is_not_loaded(content, tmp_path):
    def function():
        pass

    cache._file(tmp_path, function).write_bytes(content)
    assert cache.load_entry(tmp_path, function) is None


def test_folders_long_out_of_use_are_removed(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(cache.SWITCH, raising=False)
    root = cache.cache_folder().parent
    ages = {"0" * 16: 100, "1" * 16: 80, "not-ours": 100, "2" * 16: 100}
    for name, days in ages.items():
        (root / name / "below").mkdir(parents=True)
        if name != "2" * 16:
            (root / name / "complete").touch()
            os.utime(root / name / "complete", (time.time() - days * 86400,) * 2)
    os.utime(root / ("2" * 16), (time.time() - 100 * 86400,) * 2)
    cache.mark_complete()
    assert {path.name for path in root.iterdir()} - {cache.cache_folder().name} == {"1" * 16, "not-ours"}


def test_scipys_linear_algebra_works_after_only_its_blas_was_loaded():
    code = (
        "import tightrope.control.engine.compiled.primitives\n"
        "import scipy.linalg, scipy.linalg.cython_blas as b, numpy\n"
        "from scipy.linalg import cython_blas as c\n"
        "from numba.extending import get_cython_function_address as address\n"
        "assert b is c and address('scipy.linalg.cython_blas', 'dgemm')\n"
        "assert numpy.allclose(scipy.linalg.solve([[2.0, 1], [1, 3]], [3, 4]), 1)"
    )
    environment = {**os.environ, "PYTHONPATH": SOURCES[0]}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_wrong_arguments_are_refused():
    from tightrope.control.engine.compiled import infer

    with pytest.raises(TypeError, match="No matching definition"):
        infer.value_batch(np.zeros(3), 1, 2, 3, 4, 5)


def test_choice_takes_the_quicker_way_and_tries_the_other_again():
    choice, seconds = ThreadChoice(both=True), {True: 3.0, False: 1.0}
    choices = []
    for _ in range(2 * ThreadChoice.RETRY):
        choices.append(choice.choose())
        choice.record(choices[-1], seconds[choices[-1]], 1)
    assert choices[:2] == [True, False]
    assert sum(choices) == 2  # once at first, once for the retry
    seconds[True] = 0.5
    for _ in range(2 * ThreadChoice.RETRY):
        last = choice.choose()
        choice.record(last, seconds[last], 1)
    assert last is True


def test_choice_without_a_second_thread():
    choice = ThreadChoice(both=False)
    assert not choice.choose()
    choice.record(False, 1.0, 1)
    assert not choice.choose()


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a\x00b", b"../none", None])
def test_a_list_of_entries_that_is_none_means_that_compilation_is_due(content, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    place = cache.cache_folder() / "complete"
    place.mkdir() if content is None else place.write_bytes(content)
    assert cache.compilation_due()
