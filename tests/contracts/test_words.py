"""Nothing in the repository names the machine it was made on, or how it was made."""

from __future__ import annotations

import re

from source_tree import ROOT, files, name_of

# joined from parts, so that this file does not match itself
FOREIGN = [
    "/" + r"work/\w",
    "/" + r"tmp/v\b",
    "/" + r"root/\w",
    "/" + r"home/(?!runner)\w",
    "shared/(?:DES" + "IGN|LES" + "SON|res" + "earch|peers|proto" + "types)",
    r"\b(?:DES" + "IGN|LES" + "SON|INTER" + r"FACES)\.md",
    r"\bissues? " + r"[A-D]\b",
    r"\bthe " + r"lead\b(?! to)",
    r"\b(?:chat" + "gpt|cla" + r"ude|copi" + r"lot)\b",
    r"\bas an " + r"ai\b|\blanguage model " + "wrote",
]
OLD_RUNS = ROOT / "tests" / "old_runs"  # run folders as they were written, which tests read and resume
TEXT = {".py", ".md", ".toml", ".txt", ".cfg", ".ini", ".yml", ".yaml", ".json", ".svg", ".sh", ""}


def foreign(text: str) -> list[str]:
    """The parts of a text that do not belong here."""
    return [match.group(0) for word in FOREIGN for match in re.finditer(word, text, re.IGNORECASE)]


def test_nothing_names_a_workplace():
    found = []
    for path in files():
        if path.suffix in TEXT and path.name != "LICENSE":
            text = path.read_text(encoding="utf-8", errors="replace")
            found += [f"{name_of(path)}: {word}" for word in foreign(text)]
    assert not found, "\n".join(found)


def test_the_check_can_fail():
    assert foreign("see /" + "work/main") and foreign("DES" + "IGN.md says")
    assert not foreign("work in progress, runs/pole/settings.json")


def test_only_text_and_pictures_are_kept():
    """No archives, weights or notebooks: files that a diff cannot show do not belong in the repository.

    Old runs are the exception: they are small, and nobody edits them.
    """
    pictures = {".png", ".gif", ".svg", ".jpg", ".webp"}
    known = TEXT | pictures | {".typed"}
    of_runs = {".jsonl", ".lock", ".safetensors"}
    kept = [path for path in files() if path.suffix not in known and path.parent != ROOT]
    assert not [name_of(p) for p in kept if not (OLD_RUNS in p.parents and p.suffix in of_runs)]
    heavy = [name_of(path) for path in files() if path.stat().st_size > 2_000_000]
    assert not heavy
    days = [folder for folder in OLD_RUNS.iterdir() if folder.is_dir()]
    assert all(sum(path.stat().st_size for path in files(under=day)) < 2_000_000 for day in days)
