"""Whether an outcome matches the record: bit for bit on a matching machine, else within a tolerance.

Everything recorded must exist and be equal; new metrics and settings are allowed. Text, whole numbers, truth
values and lengths must be equal everywhere; only floats may have a tolerance.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

import torch

from tightrope.runs import versions

LIBRARIES = (*versions.VERSIONED, "tokenizers", "llvmlite")
# Some 15 times what was seen with AVX2 and plain SSE2, other kernels of MKL and OpenBLAS, another target of
# numba, transformers 5.0, numpy 2.3 and gymnasium 1.2: at most 2e-5 of a number + 2e-6. In runs as
# short as these rounding cannot grow.
RELATIVE, ABSOLUTE = 3e-4, 3e-5
SHOWN = 8


def machine() -> dict[str, str]:
    """Everything that affects the bits here: libraries, Python, the processor's type and instructions."""
    for name in LIBRARIES:
        importlib.import_module(name)
    from llvmlite import binding

    found = {name: value for name, value in versions.known().items() if name != "tightrope"}
    for name in LIBRARIES:
        found[name] = str(importlib.import_module(name).__version__)
    try:
        features = sorted(name for name, there in binding.get_host_cpu_features().items() if there)
    except RuntimeError:  # older versions do not know them on every processor
        features = ["unknown features"]
    found["processor type"] = f"{binding.get_host_cpu_name()} with {' '.join(features)}"
    return found


class How(NamedTuple):
    """The comparison to use, and the reason."""

    bits: bool
    why: str

    @property
    def label(self) -> str:
        """For the name of a test."""
        return "to the bit" if self.bits else f"within {RELATIVE:g}"

    def __str__(self) -> str:
        return f"compared {self.label}, because {self.why}"


def how(recorded: dict[str, str], here: dict[str, str], *, language: bool = True) -> How:
    """Bit for bit if ``here`` matches the recording machine in everything that affects the bits.

    Control uses none of the libraries of language.
    """
    names = {*recorded, *here} - (set() if language else {"transformers", "tokenizers"})
    changed = [name for name in sorted(names) if recorded.get(name) != here.get(name)]
    said = (f"{name} {recorded.get(name)} -> {here.get(name)}" for name in changed)
    return How(not changed, ", ".join(said) or "versions and processor are as they were")


def differences(recorded: Any, found: Any, bits: bool, where: str = "") -> list[str]:
    """The differences of ``found`` from the record, one line each; JSON values, or tensors in a dict."""
    if isinstance(recorded, dict) and isinstance(found, dict):
        lost = [f"{where}: {name!r} is not there any more" for name in recorded if name not in found]
        inside = [name for name in recorded if name in found]
        return lost + [x for n in inside for x in differences(recorded[n], found[n], bits, f"{where}/{n}")]
    if isinstance(recorded, list) and isinstance(found, list):
        if len(recorded) != len(found):
            return [f"{where}: {len(found)} items, recorded are {len(recorded)}"]
        pairs = enumerate(zip(recorded, found, strict=True))
        return [line for i, (a, b) in pairs for line in differences(a, b, bits, f"{where}[{i}]")]
    if isinstance(recorded, torch.Tensor) and isinstance(found, torch.Tensor):
        return _tensor(recorded, found, bits, where)
    if isinstance(recorded, float) and isinstance(found, float) and not bits:
        same = abs(found - recorded) <= ABSOLUTE + RELATIVE * abs(recorded)
    else:
        same = type(recorded) is type(found) and recorded == found
    return [] if same else [f"{where}: {found!r}, recorded is {recorded!r}"]


def _tensor(recorded: torch.Tensor, found: torch.Tensor, bits: bool, where: str) -> list[str]:
    kinds = [f"{tensor.dtype} {list(tensor.shape)}" for tensor in (recorded, found)]
    if kinds[0] != kinds[1]:
        return [f"{where}: {kinds[1]}, recorded is {kinds[0]}"]
    if bits or not recorded.is_floating_point():
        raw = [tensor.contiguous().flatten().view(torch.uint8) for tensor in (recorded, found)]
        same = torch.equal(*raw)
    else:
        same = torch.allclose(found, recorded, rtol=RELATIVE, atol=ABSOLUTE)
    gap = float((found.double() - recorded.double()).abs().max()) if recorded.numel() else 0.0
    return [] if same else [f"{where}: another tensor, by {gap:.2g} at most"]


def require_same(recorded: Any, found: Any, way: How, name: str) -> None:
    """AssertionError with the kind of comparison and the differences."""
    lines = differences(recorded, found, way.bits, name)
    more = [f"... and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    advice = "Is it meant? CONTRIBUTING.md, house rules, says what such a change brings."
    assert not lines, "\n".join([f"{len(lines)} differences, {way}. {advice}", *lines[:SHOWN], *more])
