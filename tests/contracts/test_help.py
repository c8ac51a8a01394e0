"""Each option documents its effect, its default and, if it has one, its range."""

from __future__ import annotations

import argparse

import pytest

from tightrope.cli import options
from tightrope.cli.flags import Parser, settings_fields
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.settings.fields import range_text

PARSERS = {
    **{f"train --algorithm {name}": options.training_parser("train", name) for name in ALGORITHM_SETTINGS},
    "evaluate": options.evaluate_parser(),
    "record": options.record_parser(),
    "resume": options.resume_parser(),
}
OPTIONS = [
    pytest.param(action, id=f"{command} {action.option_strings[0]}")
    for command, parser in PARSERS.items()
    for action in parser._actions
    if action.option_strings and not isinstance(action, argparse._HelpAction)
]


@pytest.mark.parametrize("action", OPTIONS)
def test_every_option_states_its_default(action: argparse.Action):
    """A switch that is off by default needs no default text; every option with a value does."""
    text = action.help or ""
    assert len(text) > 10, "no help"
    if action.nargs != 0 or isinstance(action, argparse.BooleanOptionalAction):
        assert "default" in text, text


@pytest.mark.parametrize("algorithm", ALGORITHM_SETTINGS)
def test_every_setting_is_an_option_with_its_range(algorithm: str):
    parser: Parser = PARSERS[f"train --algorithm {algorithm}"]
    shown = {action.dest: action.help or "" for action in parser._actions}
    for kind in (TrainSettings, ALGORITHM_SETTINGS[algorithm]):
        for name, field in settings_fields(kind).items():
            assert name in shown, f"{name} is no option"
            assert field.metadata["doc"].replace("%", "%%") in shown[name]
            assert range_text(field.metadata) in shown[name]


@pytest.mark.parametrize("command", PARSERS)
def test_help_can_be_printed(command: str):
    """A stray percent sign in a help text would end --help with an error."""
    text = PARSERS[command].format_help()
    assert "usage: tightrope" in text
    assert max(map(len, text.splitlines())) <= 110
