"""Nothing that is read is ever executed: no unpickling, no evaluated text, no module named by a file."""

from __future__ import annotations

import ast

import pytest
from source_tree import ROOT, SRC, files, imports, module_of, name_of, sources

UNPICKLERS = {
    "pickle",
    "cPickle",
    "_pickle",
    "cloudpickle",
    "dill",
    "joblib",
    "shelve",
    "marshal",
    "jsonpickle",
}
RUNNERS = {"eval", "exec", "compile", "__import__"}
LOADERS = {
    ("torch", "load"),
    ("hub", "load"),
    ("jit", "load"),
    ("os", "system"),
    ("os", "popen"),
    ("yaml", "load"),
    ("yaml", "unsafe_load"),
    ("yaml", "full_load"),
    ("runpy", "run_path"),
    ("runpy", "run_module"),
}
KEYWORDS = {"allow_pickle", "trust_remote_code", "shell"}
NAMED_ALONE = {
    "read_pickle",
    "Unpickler",
    "load_module",
    "import_module",
    "exec_module",
    "spec_from_file_location",
}
DISTRUSTED = {"from_pretrained", "from_config"}  # of transformers: they may run code unless that is disabled

# The allowed places, with reasons. Nothing else is allowed, and an unneeded entry fails.
TRANSPORT = "multiprocessing hands the user's own live factory to a worker when it starts"
CACHE = "numba's compile cache, in the user's cache directory, 0700, can be switched off"
NAMED_BY_THE_USER = "--env-module: code named on the command line"
REWARD_NAMED_BY_THE_USER = "--reward FILE.py:function: code named on the command line"
OWN_NAMES = "imports the package's own modules, whose names stand in its source"
SCIPY = "loads scipy's own BLAS extension from where scipy is installed"
EXCEPTIONS = {
    ("control/environments/processes.py", "CloudpickleWrapper"): TRANSPORT,
    ("control/environments/processes.py", "multiprocessing"): TRANSPORT,
    ("control/engine/compiled/cache.py", "pickle"): CACHE,
    ("control/engine/compiled/primitives.py", "exec_module"): SCIPY,
    ("cli/train_commands.py", "import_module"): NAMED_BY_THE_USER,
    ("cli/train_commands.py", "exec_module"): NAMED_BY_THE_USER,
    ("cli/train_commands.py", "spec_from_file_location"): NAMED_BY_THE_USER,
    ("language/reward/functions.py", "exec_module"): REWARD_NAMED_BY_THE_USER,
    ("language/reward/functions.py", "spec_from_file_location"): REWARD_NAMED_BY_THE_USER,
    ("__init__.py", "import_module"): OWN_NAMES,
    ("language/__init__.py", "import_module"): OWN_NAMES,
}


SHOWN = {
    ("benchmarks/speed_peers.py", "import_module"): "the peers that the benchmark itself names",
    ("benchmarks/packages.py", "import_module"): "the packages that the benchmark itself names",
    ("benchmarks/families.py", "multiprocessing"): "rows of the benchmark's own processes",
    ("benchmarks/families.py", "from_pretrained"): "an adapter that the benchmark has just written, in PEFT",
}


def findings(module: ast.Module, name: str = "tightrope.x") -> set[tuple[int, str]]:
    """Line and word of every place where data could become code."""
    found = set()
    for line, full in imports(module, name):
        parts = full.split(".")
        found |= {(line, part) for part in parts[:1] if part in UNPICKLERS | {"multiprocessing"}}
        if parts[-1] == "CloudpickleWrapper":
            found.add((line, "CloudpickleWrapper"))
        if tuple(parts) in LOADERS or full == "torch.hub.load":
            found.add((line, ".".join(parts[-2:])))
        if parts[0] == "importlib" and parts[-1] in ("import_module", "spec_from_file_location"):
            found.add((line, parts[-1]))
    called = {id(node.func) for node in ast.walk(module) if isinstance(node, ast.Call)}
    for node in ast.walk(module):
        if isinstance(node, ast.Call):
            found |= {(node.lineno, word) for word in _called(node)}
        elif isinstance(node, ast.Attribute) and node.attr in DISTRUSTED and id(node) not in called:
            found.add((node.lineno, node.attr))  # passed on: its caller may pass any text
        elif isinstance(node, ast.Name) and node.id in RUNNERS - {"compile"}:
            found.add((node.lineno, node.id))  # also passed on: map(eval, texts)
    return found


def _called(call: ast.Call) -> list[str]:
    function, words = call.func, []
    if isinstance(function, ast.Name):
        words += [function.id] if function.id in RUNNERS else []
    elif isinstance(function, ast.Attribute):
        last = ast.unparse(function.value).rpartition(".")[2]
        if (last, function.attr) in LOADERS or (last == "builtins" and function.attr in RUNNERS):
            words.append(f"{last}.{function.attr}")
        words += [function.attr] if function.attr in NAMED_ALONE else []
        words += [function.attr] if function.attr in DISTRUSTED and not _distrusts(call) else []
    for keyword in call.keywords:
        constant = keyword.value.value if isinstance(keyword.value, ast.Constant) else "something"
        if keyword.arg in KEYWORDS and constant is not False:
            words.append(f"{keyword.arg}={constant}")
        if keyword.arg == "weights_only" and constant is not True:
            words.append("weights_only")
        if keyword.arg == "cache" and constant is not False:
            words.append("cache=")
    return words


def _distrusts(call: ast.Call) -> bool:
    return any(
        keyword.arg == "trust_remote_code"
        and isinstance(keyword.value, ast.Constant)
        and keyword.value.value is False
        for keyword in call.keywords
    )


def test_what_is_shown_is_as_careful():
    """Also in examples, demos and benchmarks; they may start a command, but never through a shell."""
    found = [
        f"{name_of(path)}:{line} {word}"
        for folder in ("examples", "demos", "benchmarks")
        for path in files(".py", under=ROOT / folder)
        for line, word in findings(ast.parse(path.read_text()))
        if (name_of(path), word) not in SHOWN
    ]
    assert not found, "\n".join(found)


def test_data_never_becomes_code():
    found, used = [], set()
    for path in sources():
        for line, word in findings(ast.parse(path.read_text()), module_of(path)):
            place = (path.relative_to(SRC).as_posix(), word)
            if place in EXCEPTIONS:
                used.add(place)
            else:
                found.append(f"{name_of(path)}:{line} {word}")
    assert not found, "\n".join(found)
    assert used == set(EXCEPTIONS), f"no longer needed: {set(EXCEPTIONS) - used}"


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from cloudpickle import loads",
        "def f():\n    import joblib.numpy_pickle",
        "from torch import load",
        "torch.load(path)",
        "torch.load(path, weights_only=True)",
        "torch.hub.load(path)",
        "eval(text)",
        "list(map(eval, texts))",
        "run = exec",
        "compile(text, '', 'exec')",
        "builtins.eval(text)",
        "import dill",
        "import shelve",
        "import marshal",
        "from _pickle import loads",
        "yaml.unsafe_load(file)",
        "numpy.lib.format.read_array(file, allow_pickle=True)",
        "pandas.read_pickle(path)",
        "torch.jit.load(path)",
        "os.system(text)",
        "subprocess.run(text, shell=True)",
        "AutoModel.from_pretrained(path)",
        "AutoModel.from_config(config)",
        "AutoModel.from_pretrained(path, trust_remote_code=flag)",
        "make(AutoModel.from_pretrained, path)",
        "datasets.load_dataset(name, trust_remote_code=True)",
        "exec(text)",
        "builtins.exec(text)",
        "__import__(name)",
        "yaml.load(file)",
        "numpy.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=flag)",
        "AutoModel.from_pretrained(path, trust_remote_code=True)",
        "importlib.import_module(name)",
        "from importlib import import_module",
        "numba.njit(cache=True)(f)",
        "from multiprocessing import Pipe",
    ],
)
def test_the_lint_sees_it(code: str):
    assert findings(ast.parse(code))


@pytest.mark.parametrize(
    "code",
    [
        "model.eval()",
        "numpy.load(path, allow_pickle=False)",
        "re.compile(text)",
        "from safetensors.torch import load",
        "AutoModel.from_pretrained(path, trust_remote_code=False)",
        "subprocess.run(words, shell=False)",
    ],
)
def test_the_lint_lets_pass(code: str):
    assert not findings(ast.parse(code))
