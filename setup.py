"""The description on an index page: README.md with its links into the repository made absolute.

Everything else of the package stands in pyproject.toml.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
HOME = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]["Homepage"]


def absolute(match: re.Match[str]) -> str:
    """``[text](path)`` or ``![text](path)`` with an address in place of the path."""
    text, path = match.groups()
    kind = "raw" if text.startswith("!") else "blob"
    return f"{text}({HOME}/{kind}/main/{path})"


readme = (HERE / "README.md").read_text(encoding="utf-8")
setup(
    long_description=re.sub(r"(!?\[[^\]]*\])\((?!https?:|#)([^)\s]+)\)", absolute, readme),
    long_description_content_type="text/markdown",
)
